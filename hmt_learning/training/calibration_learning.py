"""Calibration of experts on held-out motions.

Each motion is left out once. The temperature T of the gates and the added covariance E maximise the
likelihood of the motions left out; then the factor s is chosen so that regions cover their nominal
probability (`hmt_ros.experts.calibrated_experts`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from hmt_ros.experts.calibrated_experts import CalibratedExperts, Calibration
from hmt_ros.experts.conditional_density import Components
from hmt_ros.experts.gates import log_softmax
from hmt_ros.experts.training_pairs import checked_pairs
from hmt_ros.inference.arrays import Array, Index

if TYPE_CHECKING:
    from typing_extensions import Self

LEFT_OUT = 500  # maximum number of held-out samples of a fold
TEMPERATURES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
ITERATIONS = 6
COVERED = 0.9  # nominal probability of the region used for the factor
LIGHT = 0.02  # minimum relative weight of a component in a region
MAX_FACTOR = 4.0


class LearningCalibration(CalibratedExperts):
    """Trainable `CalibratedExperts`; files store them as that class."""

    def fit(
        self,
        inputs: ArrayLike,
        targets: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        groups: ArrayLike | None = None,
    ) -> Self:
        """Fits and calibrates the experts on inputs (N, p) and targets (N, D).

        Args:
            groups: (N,) index of the group of each sample, such as its motion. Neighbouring
                groups are left out together. None makes each sample a group.

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


def folds_of(groups: NDArray[Any], folds: int) -> Index:
    """Fold (N,) of each sample; each fold has two runs of neighbouring groups."""
    names, which = np.unique(groups, return_inverse=True)
    runs = np.arange(len(names)) * min(2 * folds, len(names)) // len(names)
    return (runs % folds)[which].astype(np.intp)


def calibration(left_out: list[tuple[Components, Array]]) -> Calibration:
    """The calibration that maximises the likelihood of held-out samples.

    Args:
        left_out: Predicted mixtures and targets (n, D) of the held-out samples, for each fold.
    """
    candidates = [_added_noise(left_out, temperature) for temperature in TEMPERATURES]
    found = max(candidates, key=lambda one: one[0])[1]
    squares = np.concatenate([_squared_distances(found.of(c), z) for c, z in left_out])
    # Quantile of the chi-squared distribution with D degrees of freedom.
    wanted = float(2.0 * gammaincinv(left_out[0][1].shape[1] / 2.0, COVERED))
    factor = float(np.clip(np.quantile(squares, COVERED) / wanted, 1.0, MAX_FACTOR))
    return replace(found, factor=factor)


def _added_noise(
    left_out: list[tuple[Components, Array]], temperature: float
) -> tuple[float, Calibration]:
    """Log likelihood per sample, and E by expectation maximisation at a temperature."""
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
    # The likelihood belongs to the state before the last iteration.
    return likelihood, latest


def _squared_distances(found: Components, targets: Array) -> Array:
    """Squared Mahalanobis distance (n,) of each target to the nearest component above LIGHT."""
    squares = np.empty_like(found.log_weights)
    for i, noise in enumerate(found.noise):
        offsets = targets - found.means[:, i]
        away = np.einsum('ni,ni->n', offsets, np.linalg.solve(noise, offsets.T).T)
        squares[:, i] = away / found.inflation[:, i]
    light = np.exp(found.log_weights - found.log_weights.max(1, keepdims=True)) < LIGHT
    return np.asarray(np.where(light, np.inf, squares).min(1))
