"""Experts of one network: gates, means and widths of all from the same layers [Bishop 1994].

    p(x | r) = sum_i g_i(r) N(x; f_i(r), c_i(r) O_i)                       (BME 10 and 12)

A kernel model keeps samples, and grows with them; the size of a network does not depend on them, so
that it can learn from all motions, seen from everywhere. Here c_i may be below 1: an expert itself
predicts how certain it is.

Learning needs JAX and Optax (`network_learning`), prediction neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.gates import log_softmax
from hmt_ros.experts.model_file import Arrays
from hmt_ros.experts.network_learning import (
    Descent,
    Layers,
    first_layers,
    layer_outputs,
    learned_network,
)
from hmt_ros.experts.training_pairs import Standardisation, checked_pairs
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.clustering import k_means, squared_distances

if TYPE_CHECKING:
    from typing_extensions import Self

# Limits of log sqrt(c).
WIDTHS = 2.0
# Least number of samples; clusters that give the support of an input, and samples for them.
FEWEST, CENTRES, FOR_CENTRES = 20, 200, 20_000
# Factor a on the distances of means, and exponent b of densities in the responsibilities.
DISTANCE, SHARPNESS = 5.0, 0.5


class NetworkExperts(ConditionalDensity):
    """Experts that share the layers of one network.

    Args:
        units, layers: Width of the layers, and number of those that add to the first.
        jitter: Standard deviation of the noise on inputs while learning, in theirs.

    Attributes:
        noise_: (M, D, D) O.
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

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Learns from samples; see `ConditionalDensity.fit`.

        Raises:
            ValueError: as there, or JAX or Optax is missing.
        """
        pairs = checked_pairs(inputs, targets, sample_weight, at_least=FEWEST, what='to learn from')
        self.n_inputs_, self.n_outputs_ = pairs.inputs.shape[1], pairs.targets.shape[1]
        of_inputs = Standardisation.of(pairs.inputs, pairs.weights)
        of_targets = Standardisation.of(pairs.targets, pairs.weights, 'common')
        x = of_inputs.apply(pairs.inputs).astype(np.float32)
        y = of_targets.apply(pairs.targets).astype(np.float32)
        found = self._descended(x, y, pairs.weights / pairs.weights.sum())
        factors = _triangular(found.pop('factors').astype(np.float64), np)
        noise = np.linalg.inv(factors.transpose(0, 2, 1) @ factors) * of_targets.scale[0] ** 2
        noise = 0.5 * (noise + noise.transpose(0, 2, 1))
        self.set_parts(Layers(**found), of_inputs, of_targets, noise, *self._clusters(x))
        return self

    def set_parts(
        self,
        layers: Layers,
        of_inputs: Standardisation,
        of_targets: Standardisation,
        noise: Array,
        centres: Array,
        spacing: float,
    ) -> None:
        """Takes the results of learning.

        Args:
            layers: with the outputs gates (M), log widths (M) and means (M D).
            of_inputs, of_targets: before and after the layers; targets have one scale.
            noise: (M, D, D) O.
            centres, spacing: (C, p) clusters of the inputs, and the spread of one.
        """
        self._layers, self._of_inputs, self._of_targets = layers, of_inputs, of_targets
        self.noise_, self._centres, self._spacing = noise, centres, spacing

    def _descended(self, x: Any, y: Any, share: Array) -> dict[str, Any]:
        m, d, jitter = self.n_experts, self.n_outputs_, np.float32(self.jitter)

        def drawn(step: int) -> tuple[Any, Any]:
            rng = np.random.default_rng([self.seed, step])
            rows = rng.choice(len(x), self.batch, p=share)
            noise = rng.standard_normal((self.batch, x.shape[1]), dtype=np.float32)
            return x[rows] + jitter * noise, y[rows]

        def terms(p: Any, seen: Any, true: Any) -> tuple[Any, Any, Any]:
            import jax
            import jax.numpy as jnp

            gates, means, widths = _read(layer_outputs(p, seen), m, d)
            widths = jnp.clip(widths, -WIDTHS, WIDTHS)
            off = true[:, None] - means
            whitened = jnp.einsum('mij,nmj->nmi', _triangular(p['factors'], jnp), off)
            logs = jnp.diagonal(p['factors'], axis1=1, axis2=2).sum(1)
            density = logs - d * widths - 0.5 * (whitened**2).sum(2) * jnp.exp(-2.0 * widths)
            distance = jnp.sqrt((off * off).mean(2) + 1e-6)
            return jax.nn.log_softmax(gates), density, distance

        first = first_layers(x.shape[1], self.units, self.layers, m * (2 + d), self.seed)
        first['factors'] = np.zeros((m, d, d), np.float32)
        descent = Descent(self.steps, self.rate, DISTANCE, SHARPNESS)
        return learned_network(first, terms, d, drawn, descent)

    def _clusters(self, x: Any) -> tuple[Array, float]:
        """Clusters of inputs, and their spread."""
        rng = np.random.default_rng(self.seed)
        some = x[np.sort(rng.permutation(len(x))[:FOR_CENTRES])].astype(np.float64)
        centres, own = k_means(some, min(CENTRES, len(some)), rng, iterations=5)
        spread = float(np.sqrt(((some - centres[own]) ** 2).sum(1).mean()))
        return centres, max(spread, 1e-9)

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p)."""
        of_targets = self._of_targets
        seen = self._of_inputs.apply(self._checked(inputs)).astype(np.float32)
        out = self._layers.outputs(seen).astype(np.float64)
        gates, means, widths = _read(out, self.n_experts, self.n_outputs_)
        return Components(
            log_softmax(gates),
            means * of_targets.scale + of_targets.centre,
            np.exp(2.0 * np.clip(widths, -WIDTHS, WIDTHS)),
            self.noise_,
        )

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the components' means with respect to the input."""
        seen = self._of_inputs.apply(self._checked(inputs)).astype(np.float32)
        slopes = self._layers.jacobians(seen, slice(2 * self.n_experts, None)).astype(np.float64)
        slopes = slopes.reshape(len(seen), self.n_experts, self.n_outputs_, self.n_inputs_)
        result: Array = self._of_targets.scale[0] * slopes / self._of_inputs.scale
        return result

    def support(self, inputs: ArrayLike) -> Array:
        """exp(-(d / 2 s)^2 / 2), (n,): d to the nearest cluster of inputs, s the spread of one."""
        seen = self._of_inputs.apply(self._checked(inputs))
        away = squared_distances(seen, self._centres).min(1)
        result: Array = np.exp(-0.5 * away / (2.0 * self._spacing) ** 2)
        return result

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
        a = {name: np.asarray(value) for name, value in arrays.items()}
        self.set_parts(
            Layers.from_arrays(a),
            Standardisation(a['input_centre'], a['input_scale']),
            Standardisation(a['target_centre'], a['target_scale']),
            a['noise'].astype(np.float64),
            a['centres'].astype(np.float64),
            float(a['spacing']),
        )


def _read(out: Any, m: int, d: int) -> tuple[Any, Any, Any]:
    """Gates, means (n, M, D) and log widths from outputs of the last layer (n, M (2 + D))."""
    return out[:, :m], out[:, 2 * m :].reshape(len(out), m, d), out[:, m : 2 * m]


def _triangular(factors: Any, np_: Any) -> Any:
    """Lower triangular matrices (M, D, D) with positive diagonals."""
    d = factors.shape[1]
    return np_.tril(factors, -1) + np_.exp(np_.diagonal(factors, axis1=1, axis2=2))[
        :, :, None
    ] * np_.eye(d)
