"""Experts from one network, whose layers give all gates, means and widths [Bishop 1994].

    p(x | r) = sum_i g_i(r) N(x; f_i(r), c_i(r) O_i)                       (BME 10 and 12)

A kernel model stores samples and grows with them. The size of a network is constant, so it can
learn from all motions in views from all directions. Here c_i can be below 1, because each expert
predicts its own uncertainty.

`hmt_learning.training.network_learning` trains the network. `Layers` have leaky rectified units and
residual connections.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.learned_file import Arrays, check_positive, require
from hmt_ros.core import elementary
from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.gates import log_softmax
from hmt_ros.experts.training_pairs import Standardisation
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.clustering import squared_distances
from hmt_ros.inference.linear_algebra import product

if TYPE_CHECKING:
    from typing_extensions import Self

# Maximum of |log sqrt(c)|.
LOG_WIDTH_LIMIT = 2.0
LEAK_SLOPE = 0.1  # slope of a unit below 0
# Limits of a file: number of layers, size of whitened inputs, size of the outputs at such inputs.
MAX_LAYERS, MAX_INPUT, MAX_OUTPUT = 100, np.float32(100.0), 1e15

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True)
class Layers:
    """Layers of H units, followed by O outputs.

    Attributes:
        first, first_bias: (p, H) weights and (H,) biases of the first layer.
        hidden, hidden_biases: (M, H, H) weights and (M, H) biases of M hidden layers.
        last, last_bias: (H, O) weights and (O,) biases of the outputs.
    """

    first: Floats
    first_bias: Floats
    hidden: Floats
    hidden_biases: Floats
    last: Floats
    last_bias: Floats

    def outputs(self, inputs: Floats) -> Floats:
        """Outputs (N, O) at whitened inputs (N, p)."""
        return np.asarray(product(self.features(inputs), self.last) + self.last_bias)

    def features(self, inputs: Floats) -> Floats:
        """Activations (N, H) of the last layer of units at whitened inputs (N, p)."""
        units = _leaky(product(inputs, self.first) + self.first_bias)
        for weights, bias in zip(self.hidden, self.hidden_biases, strict=True):
            units = units + _leaky(product(units, weights) + bias)
        return units

    def jacobians(self, inputs: Floats, which: slice | Index) -> Floats:
        """Derivatives (N, o, p) of selected outputs with respect to whitened inputs (N, p)."""
        before = product(inputs, self.first) + self.first_bias
        units = _leaky(before)
        slopes = _slopes(before)[:, :, None] * self.first.T
        for weights, bias in zip(self.hidden, self.hidden_biases, strict=True):
            before = product(units, weights) + bias
            units = units + _leaky(before)
            slopes = slopes + _slopes(before)[:, :, None] * product(weights.T, slopes)
        return np.asarray(product(self.last[:, which].T, slopes))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays for a file: matrices in half precision, vectors in single precision."""
        return {
            name: np.asarray(value, dtype=np.float16 if value.ndim > 1 else np.float32)
            for name, value in vars(self).items()
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], p: int) -> Self:
        """The layers with p inputs that `to_arrays` stored.

        Raises:
            KeyError, ValueError: arrays are missing, do not fit, or allow too large outputs.
        """
        own = {name: np.asarray(arrays[name], np.float32) for name in cls.__dataclass_fields__}
        m = len(own['hidden'])
        require(m <= MAX_LAYERS, f'it has {m} hidden layers, wanted at most {MAX_LAYERS}')
        # A network with the absolute weights, evaluated at the largest inputs, bounds all outputs.
        bound = cls(**{name: np.abs(values) for name, values in own.items()})
        largest = bound.outputs(np.full((1, p), MAX_INPUT)).max()
        require(largest <= MAX_OUTPUT, f'its outputs may be larger than {MAX_OUTPUT:g}')
        return cls(**own)


class NetworkExperts(ConditionalDensity):
    """Experts that share the layers of one network.

    Args:
        units, layers: Number of units per layer, and number of residual layers after the first
            layer.
        jitter: Standard deviation of the input noise in training, relative to the inputs'
            deviation.

    Attributes:
        noise_: (M, D, D) covariances O.
    """

    kind = 'network_experts'

    noise_: Array

    def __init__(
        self,
        n_experts: int = 5,
        units: int = 320,
        layers: int = 2,
        steps: int = 8000,
        batch: int = 512,
        rate: float = 1e-3,
        jitter: float = 0.3,
        seed: int = 0,
    ) -> None:
        self.n_experts = n_experts
        self.units = units
        self.layers = layers
        self.steps = steps
        self.batch = batch
        self.rate = rate
        self.jitter = jitter
        self.seed = seed

    def set_parts(
        self,
        layers: Layers,
        of_inputs: Standardisation,
        of_targets: Standardisation,
        noise: Array,
        centres: Array,
        spacing: float,
    ) -> None:
        """Set the results of training.

        Args:
            layers: layers whose outputs are gates (M), log widths (M) and means (M D).
            of_inputs, of_targets: standardisations; all target columns share one scale.
            noise: (M, D, D) covariances O.
            centres, spacing: (C, p) centres of clusters of inputs, and the spread of a cluster.
        """
        self._layers, self._of_inputs, self._of_targets = layers, of_inputs, of_targets
        self.noise_, self._centres, self._spacing = noise, centres, spacing

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p)."""
        of_targets = self._of_targets
        seen = self._of_inputs.apply(self._checked(inputs)).astype(np.float32)
        out = self._layers.outputs(seen).astype(np.float64)
        gates, means, widths = read_outputs(out, self.n_experts, self.n_outputs_)
        return Components(
            log_softmax(gates),
            means * of_targets.scale + of_targets.centre,
            elementary.exp(2.0 * np.clip(widths, -LOG_WIDTH_LIMIT, LOG_WIDTH_LIMIT)),
            self.noise_,
        )

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the components' means with respect to the input."""
        seen = self._of_inputs.apply(self._checked(inputs)).astype(np.float32)
        slopes = self._layers.jacobians(seen, slice(2 * self.n_experts, None)).astype(np.float64)
        slopes = slopes.reshape(len(seen), self.n_experts, self.n_outputs_, self.n_inputs_)
        return np.asarray(self._of_targets.scale[0] * slopes / self._of_inputs.scale)

    def support(self, inputs: ArrayLike) -> Array:
        """exp(-(d / 2 s)^2 / 2), (n,), with distance d to the nearest cluster and spread s."""
        seen = self._of_inputs.apply(self._checked(inputs))
        away = squared_distances(seen, self._centres).min(1)
        return np.asarray(elementary.exp(-0.5 * away / (2.0 * self._spacing) ** 2))

    def _learned(self) -> Arrays:
        return {
            **self._layers.to_arrays(),
            'input_centre': self._of_inputs.centre,
            'input_scale': self._of_inputs.scale,
            'target_centre': self._of_targets.centre,
            'target_scale': self._of_targets.scale,
            'noise': self.noise_.astype(np.float32),
            'centres': self._centres.astype(np.float16),
            'spacing': np.array(self._spacing),
        }

    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        a, m = dict(arrays), len(arrays['noise'])
        require(m == self.n_experts, f'it has {m} experts, and says otherwise')
        check_positive('spacing', a['spacing'])
        self.set_parts(
            Layers.from_arrays(a, self.n_inputs_),
            Standardisation(a['input_centre'], a['input_scale']),
            Standardisation(a['target_centre'], a['target_scale']),
            a['noise'].astype(np.float64),
            a['centres'].astype(np.float64),
            float(a['spacing']),
        )


def read_outputs(out: Any, m: int, d: int) -> tuple[Any, Any, Any]:
    """Gates, means (n, M, D) and log widths from outputs of the last layer (n, M (2 + D))."""
    return out[:, :m], out[:, 2 * m :].reshape(len(out), m, d), out[:, m : 2 * m]


def _leaky(x: Floats) -> Floats:
    """Outputs of leaky units."""
    return np.asarray(np.maximum(x, np.float32(LEAK_SLOPE) * x))


def _slopes(x: Floats) -> Floats:
    return np.where(x > 0, np.float32(1.0), np.float32(LEAK_SLOPE))
