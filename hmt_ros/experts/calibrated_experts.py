"""Experts whose gates and covariances are calibrated on motions that they have not learned from.

    p(x | r) ~ sum_i g_i(r)^(1 / T) N(x; f_i(r), c_i(r) s (O_i + E))

The frames of one motion are alike, so a model is too certain about any other motion: in many
dimensions its gates decide too sharply, and its covariances are those of the motions it knows. Each
motion is left out once. The temperature T of the gates and the added covariance E maximise the
likelihood of the motions left out; the factor s then makes regions as wide as they claim to be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from hmt_ros.experts.conditional_density import Components, ConditionalDensity, stored_model
from hmt_ros.experts.gates import log_softmax
from hmt_ros.experts.model_file import Arrays, nested, parameters_of, part
from hmt_ros.experts.training_pairs import checked_pairs
from hmt_ros.inference.arrays import Array, Index

if TYPE_CHECKING:
    from typing_extensions import Self


FOLDS = 3
LEFT_OUT = 500  # maximum number of samples of a fold that are left out
TEMPERATURES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
ITERATIONS = 6
COVERED = 0.9  # probability of the region that should cover that share of the samples left out
LIGHT = 0.02  # components with less weight than this do not count for a region
LARGEST_FACTOR = 4.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """Changes the mixtures of a model.

    Attributes:
        temperature: Temperature T of the gates, at least 1.
        added: (D, D) added covariance E, positive semidefinite.
        factor: Factor s of the covariances, at least 1.

    Raises:
        ValueError: a value is out of its range.
    """

    temperature: float
    added: Array
    factor: float

    def __post_init__(self) -> None:
        size = len(self.added)
        if self.added.shape != (size, size) or not np.isfinite(self.added).all():
            raise ValueError(f'added must be finite and (D, D), saw {self.added.shape}')
        for name in ('temperature', 'factor'):
            if not 1.0 <= getattr(self, name) < np.inf:
                raise ValueError(f'{name} must be at least 1, saw {getattr(self, name)}')

    def of(self, found: Components) -> Components:
        """The calibrated mixtures."""
        return replace(
            found,
            log_weights=log_softmax(found.log_weights / self.temperature),
            noise=self.factor * (found.noise + self.added),
        )


class CalibratedExperts(ConditionalDensity):
    """A model whose gates and covariances are calibrated on motions left out.

    Args:
        folds: Number of parts of the motions; each part is left out once.
    """

    kind = 'calibrated_experts'

    calibration_: Calibration

    def __init__(self, model: ConditionalDensity, folds: int = FOLDS) -> None:
        self.model = model
        self.folds = folds

    def fit(
        self,
        inputs: ArrayLike,
        targets: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        groups: ArrayLike | None = None,
    ) -> Self:
        """Learns from inputs (N, p) and targets (N, D).

        Args:
            groups: (N,) number of the group of each sample, such as its motion. Neighbouring
                numbers are left out together. None takes the order of the samples.

        Raises:
            ValueError: shapes are wrong, values are not finite, or there are too few samples.
        """
        pairs = checked_pairs(inputs, targets, sample_weight, at_least=2, what='to leave one out')
        if self.folds < 2:
            raise ValueError(f'folds is {self.folds}, wanted at least 2')
        if groups is None:
            labels = np.arange(len(pairs))
        else:
            labels = np.asarray(groups)
            if labels.shape != (len(np.asarray(inputs)),):
                raise ValueError(f'groups have shape {labels.shape}, wanted one for each input')
            if sample_weight is not None:
                labels = labels[np.asarray(sample_weight) > 0]
        fold = folds_of(labels, self.folds)
        rng = np.random.default_rng(0)
        left_out = []
        for number in np.unique(fold):
            inside = fold != number
            if not inside.any():
                raise ValueError('groups has one group only, wanted two at least to leave one out')
            some = pairs[np.flatnonzero(inside)]
            self.model.fit(some.inputs, some.targets, some.weights)
            rows = rng.permutation(np.flatnonzero(~inside))[:LEFT_OUT]
            found = self.model.components(pairs.inputs[rows])
            left_out.append((found, pairs.targets[rows]))
        self.calibration_ = calibration(left_out)
        self.model.fit(pairs.inputs, pairs.targets, pairs.weights)
        self.n_inputs_, self.n_outputs_ = self.model.n_inputs_, self.model.n_outputs_
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p)."""
        self._check_learned()
        return self.calibration_.of(self.model.components(inputs))

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the components' means with respect to the input."""
        return self.model.jacobians(inputs)

    def support(self, inputs: ArrayLike) -> Array:
        """Support (n,) of the inputs (n, p) by training data; that of the model."""
        return self.model.support(inputs)

    def _stored_parameters(self) -> dict[str, Any]:
        return {'folds': self.folds}

    @classmethod
    def _constructed(cls, arrays: Mapping[str, NDArray[Any]], where: str) -> Self:
        own = part('model', arrays)
        # Files could nest models without end.
        if str(own['kind']) == cls.kind:
            raise ValueError('a calibrated model inside a calibrated model')
        return cls(stored_model(own, where), **parameters_of(arrays))

    def _learned(self) -> Arrays:
        found = self.calibration_
        return {
            'temperature': np.array(found.temperature),
            'added': found.added,
            'factor': np.array(found.factor),
        } | nested('model', self.model.to_arrays())

    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.calibration_ = Calibration(
            float(arrays['temperature']),
            np.asarray(arrays['added'], dtype=np.float64),
            float(arrays['factor']),
        )


def folds_of(groups: NDArray[Any], folds: int) -> Index:
    """Fold (N,) of each sample: each fold gets two runs of neighbouring groups."""
    names, which = np.unique(groups, return_inverse=True)
    runs = np.arange(len(names)) * min(2 * folds, len(names)) // len(names)
    return (runs % folds)[which].astype(np.intp)


def calibration(left_out: list[tuple[Components, Array]]) -> Calibration:
    """The calibration with the highest likelihood of samples that were left out.

    Args:
        left_out: Mixtures and targets (n, D) of the samples left out, for each fold.
    """
    candidates = [_added_noise(left_out, temperature) for temperature in TEMPERATURES]
    found = max(candidates, key=lambda one: one[0])[1]
    squares = np.concatenate([_squared_distances(found.of(c), z) for c, z in left_out])
    # Quantile of the chi-squared distribution with D degrees of freedom.
    wanted = float(2.0 * gammaincinv(left_out[0][1].shape[1] / 2.0, COVERED))
    factor = float(np.clip(np.quantile(squares, COVERED) / wanted, 1.0, LARGEST_FACTOR))
    return replace(found, factor=factor)


def _added_noise(
    left_out: list[tuple[Components, Array]], temperature: float
) -> tuple[float, Calibration]:
    """The log likelihood, and E by expectation maximisation for a temperature."""
    size = left_out[0][1].shape[1]
    found = Calibration(temperature, np.zeros((size, size)), 1.0)
    likelihood = -np.inf
    for _ in range(ITERATIONS):
        scatter, own, total, count = np.zeros((size, size)), np.zeros((size, size)), 0.0, 0
        for components, targets in left_out:
            changed = found.of(components)
            log = changed.log_weights + changed.component_log_densities(targets)
            total += float(np.logaddexp.reduce(log, axis=1).sum())
            count += len(targets)
            shares = np.exp(log_softmax(log))
            for i in np.flatnonzero(shares.sum(0) > 1e-6).tolist():
                offsets = targets - changed.means[:, i]
                scatter += (shares[:, i] / changed.inflation[:, i] * offsets.T) @ offsets
                own += shares[:, i].sum() * components.noise[i]
        likelihood = total / count
        values, vectors = np.linalg.eigh((scatter - own) / count)
        latest, found = found, replace(found, added=(vectors * np.maximum(values, 0)) @ vectors.T)
    # The likelihood is that of the state before the last iteration.
    return likelihood, latest


def _squared_distances(found: Components, targets: Array) -> Array:
    """Squared Mahalanobis distance (n,) of each target to the nearest component that counts."""
    squares = np.empty_like(found.log_weights)
    for i, noise in enumerate(found.noise):
        offsets = targets - found.means[:, i]
        away = np.einsum('ni,ni->n', offsets, np.linalg.solve(noise, offsets.T).T)
        squares[:, i] = away / found.inflation[:, i]
    light = np.exp(found.log_weights - found.log_weights.max(1, keepdims=True)) < LIGHT
    return np.asarray(np.where(light, np.inf, squares).min(1))
