"""Base class of all models: conditional densities that are Gaussian mixtures (BME 2.2).

    p(x | r) = sum_i g_i(r) p_i(x | r)                                              (BME 10)
    p_i(x | r) = N(x; f_i(r), c_i(r) O_i)                                           (BME 12)

The gates g_i are positive and sum to 1. The scalar c_i(r) >= 1 inflates the noise O_i of an expert
by the uncertainty of its weights at the input r; in the paper c_i is 1.
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

from hmt_ros.body.learned_file import (
    MAX_INPUTS,
    MAX_VALUES,
    Arrays,
    check_covariances,
    check_header,
    header,
    parameters_of,
    read_model,
    require,
    write_model,
)
from hmt_ros.core import elementary
from hmt_ros.experts.training_pairs import finite_matrix
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import cholesky, log_sum_exp, solve_triangular
from hmt_ros.inference.random_numbers import standard_normals

if TYPE_CHECKING:
    from typing_extensions import Self


# Maximum number of outputs of a model; a pose has forty.
MAX_OUTPUTS = 1000


@dataclass(frozen=True, eq=False)
class Components:
    """The mixtures at n inputs.

    Attributes:
        log_weights: (n, M) logarithms of the gates g, which sum to 1.
        means: (n, M, D) means f.
        inflation: (n, M) factors c.
        noise: (M, D, D) covariances O.
    """

    log_weights: Array
    means: Array
    inflation: Array
    noise: Array

    def log_density(self, targets: Array) -> Array:
        """log p(x | r), (n,), for targets (n, D), one for each input."""
        return np.asarray(
            log_sum_exp(self.log_weights + self.component_log_densities(targets), axis=1)
        )

    def component_log_densities(self, targets: Array) -> Array:
        """log N(x; f_i(r), c_i(r) O_i), (n, M)."""
        result = np.empty_like(self.log_weights)
        for i, factor in enumerate(cholesky(self.noise)):
            z = solve_triangular(factor, (targets - self.means[:, i]).T)
            log_det = 2.0 * elementary.log(np.diagonal(factor)).sum()
            size = len(factor) * elementary.log(2.0 * np.pi * self.inflation[:, i])
            result[:, i] = -0.5 * ((z * z).sum(0) / self.inflation[:, i] + size + log_det)
        return result


class ConditionalDensity(ABC):
    """A model of p(x | r) with inputs r (p,) and targets x (D,).

    Follows the conventions of scikit-learn estimators: the constructor stores its arguments
    unchanged, learned attributes end in an underscore, `get_params` and `set_params` exist.

    Attributes:
        kinds: Mapping from the name of a model in files to its class.
    """

    kind: ClassVar[str]
    kinds: ClassVar[dict[str, type[ConditionalDensity]]] = {}

    n_inputs_: int
    n_outputs_: int

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if 'kind' in cls.__dict__:
            cls.kinds[cls.kind] = cls

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Learns from inputs (N, p) and targets (N, D), optionally with weights (N,).

        Raises:
            ValueError: shapes are wrong, values are not finite, there are too few samples, or the
                model cannot be trained here, such as a network outside hmt_learning.
        """
        raise ValueError(f'{type(self).__name__} predicts only: it learns in hmt_learning')

    @abstractmethod
    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p)."""

    @abstractmethod
    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the components' means with respect to the input."""

    @abstractmethod
    def support(self, inputs: ArrayLike) -> Array:
        """Similarity (n,) of inputs (n, p) to the training data, from 0 to 1.

        It is the largest kernel value at the input. If it is near 0, the means are no better than a
        constant.
        """

    @abstractmethod
    def _learned(self) -> Arrays:
        """The learned arrays, for a file."""

    @abstractmethod
    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restores the model from the arrays of `_learned`."""

    def predict_arrays(self, inputs: ArrayLike) -> tuple[Array, Array, Array]:
        """The mixtures at inputs (n, p).

        Returns:
            Weights (n, M), means (n, M, D), covariances (n, M, D, D).
        """
        found = self.components(inputs)
        covariances = found.inflation[:, :, None, None] * found.noise
        return elementary.exp(found.log_weights), found.means, covariances

    def predict(self, inputs: ArrayLike) -> list[GaussianMixture]:
        """A mixture for each of the inputs (n, p); the order of components is kept."""
        return [GaussianMixture(*one) for one in zip(*self.predict_arrays(inputs), strict=True)]

    def log_density(self, inputs: ArrayLike, targets: ArrayLike) -> Array:
        """log p(x | r), (n,), of targets (n, D) at inputs (n, p)."""
        found = self.components(inputs)
        targets = finite_matrix(targets, 'targets', f'(n, {self.n_outputs_})')
        require(
            targets.shape == found.means.shape[::2],
            f'targets have shape {targets.shape}, wanted {found.means.shape[::2]}: one row for '
            'each input',
        )
        return found.log_density(targets)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The constructor's arguments; `deep` is accepted for scikit-learn and ignored."""
        return {name: getattr(self, name) for name in self._parameter_names()}

    def set_params(self, **parameters: Any) -> Self:
        """Changes some of the constructor's arguments.

        Raises:
            ValueError: an argument does not exist.
        """
        known = self._parameter_names()
        for name, value in parameters.items():
            require(
                name in known,
                f'{type(self).__name__} has no parameter {name!r}, wanted some of '
                f'{", ".join(known)}',
            )
            setattr(self, name, value)
        return self

    def to_arrays(self) -> Arrays:
        """The whole model as arrays, for its own file or as part of another file.

        Raises:
            ValueError: the model has not been trained.
        """
        self._check_learned()
        shape = np.array([self.n_inputs_, self.n_outputs_])
        return header(self.kind, self._stored_parameters()) | {'shape': shape} | self._learned()

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The model that `to_arrays` stored.

        Raises:
            ValueError, KeyError, TypeError, IndexError: the kind or the version differs, or arrays
                are missing or wrong.
        """
        check_header(arrays, cls.kind)
        inputs, outputs = (int(n) for n in arrays['shape'])
        require(
            1 <= inputs <= MAX_INPUTS and 1 <= outputs <= MAX_OUTPUTS,
            f'{inputs} inputs and {outputs} outputs, wanted 1 to {MAX_INPUTS} and 1 to '
            f'{MAX_OUTPUTS}',
        )
        model = cls._constructed(arrays)
        model.n_inputs_, model.n_outputs_ = inputs, outputs
        model._set_learned(arrays)
        model._check_components()
        return model

    def save(self, path: str | Path, card: Mapping[str, Any] | None = None) -> Path:
        """Writes the model into an .npz file and returns its path.

        Args:
            card: training data, licence and method, serialisable as JSON.
        """
        self._check_learned()
        example = standard_normals(np.random.default_rng(0), (self.n_inputs_,))
        return write_model(path, self, stored_model, card or {}, example)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a model that `save` wrote.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not a model, has an unsupported version or a different kind, or
                is invalid.
        """
        return read_model(path, cls.kind, cls.from_arrays)

    def answer(self, given: Array) -> GaussianMixture:
        """The mixture at one input (p,)."""
        return self.predict(given[None])[0]

    def _check_components(self) -> None:
        """Raise ValueError if predictions are inconsistent, invalid or too large."""
        inputs, d = np.eye(2, self.n_inputs_), self.n_outputs_
        found = self.components(inputs)
        m, parts = found.log_weights.shape[-1], [*vars(found).values()]
        shapes = [x.shape for x in parts]
        require(shapes == [(2, m), (2, m, d), (2, m), (m, d, d)], 'its predictions do not fit')
        require(m * d * max(d, self.n_inputs_) <= MAX_VALUES, 'its predictions are too large')
        parts += [self.jacobians(inputs), self.support(inputs)]
        require(all(np.isfinite(x).all() for x in parts), 'its predictions are not finite')
        check_covariances('noise', found.noise)

    def _stored_parameters(self) -> dict[str, Any]:
        """The constructor's arguments that are serialisable as JSON."""
        return self.get_params()

    @classmethod
    def _constructed(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Construct the model of a file, before its learned arrays are set."""
        return cls(**parameters_of(arrays))

    def _check_learned(self) -> None:
        fault = f'this {type(self).__name__} has not learned yet; call fit first'
        require(hasattr(self, 'n_inputs_'), fault)

    def _checked(self, inputs: ArrayLike) -> Array:
        """Inputs as a matrix (n, p) with as many columns as in training."""
        self._check_learned()
        inputs = finite_matrix(inputs, 'inputs', f'(n, {self.n_inputs_})')
        require(
            inputs.shape[1] == self.n_inputs_,
            f'inputs have {inputs.shape[1]} columns, wanted {self.n_inputs_} as in training; '
            'describe them as the training data were',
        )
        return inputs

    @classmethod
    def _parameter_names(cls) -> list[str]:
        return [name for name in inspect.signature(cls.__init__).parameters if name != 'self']


def stored_model(arrays: Mapping[str, NDArray[Any]]) -> ConditionalDensity:
    """Build the model that `ConditionalDensity.to_arrays` stored; the arrays name its class.

    Raises:
        ValueError, KeyError, TypeError, IndexError: the kind is unknown, or arrays are missing or
            wrong.
    """
    kind, kinds = str(arrays['kind']), ConditionalDensity.kinds
    require(kind in kinds, f'its kind is none of {sorted(kinds)}')
    return kinds[kind].from_arrays(arrays)
