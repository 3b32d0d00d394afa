"""Conditional densities that are mixtures of Gaussians, whatever learned them.

    p(x | r) = sum_i g_i(r) N(x; f_i(r), c_i(r) O_i)

What every model here predicts, how it is evaluated, and how it is kept in a file. The scalar
c_i(r) >= 1 is what the uncertainty of an expert's weights adds to its noise O_i at the input r.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from hmt_ros.experts.model_file import (
    FAULTS,
    Arrays,
    check_header,
    damaged,
    header,
    parameters_of,
    read_arrays,
    shape_of,
    write_arrays,
)
from hmt_ros.experts.training_pairs import checked_inputs, finite_matrix
from hmt_ros.inference import GaussianMixture

if TYPE_CHECKING:
    from typing_extensions import Self

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Components:
    """The mixtures at n inputs.

    Attributes:
        log_weights: (n, M) of weights that sum to 1.
        means: (n, M, D).
        inflation: (n, M) c.
        noise: (M, D, D) O.
    """

    log_weights: Array
    means: Array
    inflation: Array
    noise: Array

    def log_density(self, targets: Array) -> Array:
        """log p(x | r), (n,), of one target (n, D) per input."""
        result: Array = logsumexp(self.log_weights + self.component_log_densities(targets), axis=1)
        return result

    def component_log_densities(self, targets: Array) -> Array:
        """log N(x; f_i(r), c_i(r) O_i), (n, M)."""
        result = np.empty_like(self.log_weights)
        for i, factor in enumerate(np.linalg.cholesky(self.noise)):
            z = solve_triangular(
                factor, (targets - self.means[:, i]).T, lower=True, check_finite=False
            )
            log_det = 2.0 * np.log(np.diagonal(factor)).sum()
            size = len(factor) * np.log(2.0 * np.pi * self.inflation[:, i])
            result[:, i] = -0.5 * ((z * z).sum(0) / self.inflation[:, i] + size + log_det)
        return result


class ConditionalDensity(ABC):
    """A model of p(x | r) with inputs r (p,) and targets x (D,).

    Constructor arguments are kept as they are and learned attributes end in an underscore, as
    scikit-learn does; `get_params` and `set_params` are those of its estimators.
    """

    kind: ClassVar[str]

    n_inputs_: int
    n_outputs_: int

    @abstractmethod
    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Learns from inputs (N, p) and targets (N, D), with weights (N,) or without.

        Raises:
            ValueError: wrong shapes, values that are not finite, too few samples.
        """

    @abstractmethod
    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p), without their covariances multiplied out."""

    @abstractmethod
    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the components' means by the input."""

    @abstractmethod
    def support(self, inputs: ArrayLike) -> Array:
        """How far the inputs (n, p) are supported by training data: (n,) from 0 to 1.

        The value of the kernel that fires most; near 0 the means are no better than a constant.
        """

    @abstractmethod
    def _learned(self) -> Arrays:
        """Learned arrays, for a file."""

    @abstractmethod
    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Takes the arrays of `_learned` back."""

    def predict_arrays(self, inputs: ArrayLike) -> tuple[Array, Array, Array]:
        """The mixtures at inputs (n, p).

        Returns:
            Weights (n, M), means (n, M, D), covariances (n, M, D, D).
        """
        found = self.components(inputs)
        covariances = found.inflation[:, :, None, None] * found.noise
        return np.exp(found.log_weights), found.means, covariances

    def predict(self, inputs: ArrayLike) -> list[GaussianMixture]:
        """A mixture for each of the inputs (n, p); components keep their order."""
        return [GaussianMixture(*one) for one in zip(*self.predict_arrays(inputs), strict=True)]

    def log_density(self, inputs: ArrayLike, targets: ArrayLike) -> Array:
        """log p(x | r), (n,), of targets (n, D) at inputs (n, p)."""
        found = self.components(inputs)
        targets = finite_matrix(targets, 'targets', f'(n, {self.n_outputs_})')
        if targets.shape != found.means.shape[::2]:
            raise ValueError(
                f'targets have shape {targets.shape}, wanted {found.means.shape[::2]}: '
                'one row for each input'
            )
        return found.log_density(targets)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The constructor's arguments; no model here holds another, so `deep` changes nothing."""
        return {name: getattr(self, name) for name in self._parameter_names()}

    def set_params(self, **parameters: Any) -> Self:
        """Changes some of the constructor's arguments.

        Raises:
            ValueError: an argument that does not exist.
        """
        known = self._parameter_names()
        for name, value in parameters.items():
            if name not in known:
                raise ValueError(
                    f'{type(self).__name__} has no parameter {name!r}, wanted some of '
                    f'{", ".join(known)}'
                )
            setattr(self, name, value)
        return self

    def to_arrays(self) -> Arrays:
        """The whole model as arrays, for a file of its own or as part of another.

        Raises:
            ValueError: it has not learned yet.
        """
        self._check_learned()
        shape = np.array([self.n_inputs_, self.n_outputs_])
        return header(self.kind, self.get_params()) | {'shape': shape} | self._learned()

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], where: str = 'model') -> Self:
        """The model that `to_arrays` gave.

        Raises:
            ValueError: arrays of another kind or version, or arrays that are missing or wrong.
        """
        check_header(arrays, cls.kind, where)
        try:
            model = cls(**parameters_of(arrays))
            model.n_inputs_, model.n_outputs_ = shape_of(arrays)
            model._set_learned(arrays)
            model.components(np.zeros((1, model.n_inputs_)))
        except FAULTS as fault:
            raise damaged(where, fault) from fault
        return model

    def save(self, path: str | Path) -> Path:
        """Writes the model into an .npz file and returns its path."""
        return write_arrays(path, self.to_arrays())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a model that `save` wrote.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not such a file, another version, another kind of model.
        """
        return cls.from_arrays(read_arrays(path, cls.kind), str(path))

    def _check_learned(self) -> None:
        if not hasattr(self, 'n_inputs_'):
            raise ValueError(f'this {type(self).__name__} has not learned yet; call fit first')

    def _checked(self, inputs: ArrayLike) -> Array:
        self._check_learned()
        return checked_inputs(inputs, self.n_inputs_)

    @classmethod
    def _parameter_names(cls) -> list[str]:
        return [name for name in inspect.signature(cls.__init__).parameters if name != 'self']
