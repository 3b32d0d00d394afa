"""Learning of a network of experts by stochastic gradient descent.

    loss = -log sum_i g_i p_i / n + a sum_i q_i d_i,     q_i ~ g_i p_i^b

The first term is the log density of the mixture [Bishop 1994] per number of a target, n in total.
It mainly improves means with small deviations; the second term, over the experts responsible for a
target, improves means with large ones: d_i is the distance of a mean from the target. No gradients
pass through q. The learning rate of Adam falls as a cosine.

Learning needs JAX and Optax, prediction neither. The same seed, steps and machine give the same
bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.experts.network_experts import (
    LEAK_SLOPE,
    LOG_WIDTH_LIMIT,
    Layers,
    NetworkExperts,
    read_outputs,
)
from hmt_ros.experts.training_pairs import Standardisation, checked_pairs
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.clustering import k_means
from msg_tools.files.new_folder import new_file

if TYPE_CHECKING:
    from typing_extensions import Self


# Number of warm-up steps of the learning rate, and of steps between two checkpoints.
RISING, MARK = 300, 500
# Final learning rate, relative to the highest.
END = 0.005
NEEDED = 'a network needs JAX and Optax to learn, which are missing: pip install jax optax'

# Minimum number of samples; number of clusters for the support of an input, and of their samples.
MIN_SAMPLES, CENTRES, FOR_CENTRES = 20, 200, 20_000
# Factor a on the distances of means, and exponent b of densities in the responsibilities.
DISTANCE, SHARPNESS = 5.0, 0.5

# Log gates, log densities and distances, all (N, K), from parameters, inputs and targets.
Terms = Callable[[Any, Any, Any], tuple[Any, Any, Any]]


@dataclass(frozen=True)
class Descent:
    """Settings of gradient descent.

    Attributes:
        steps: Number of steps.
        rate: Highest learning rate of Adam.
        distance_weight: Factor a on the distances.
        sharpness: Exponent b of the densities in q.
        told: Callback after each step, with its number and the loss.
        resume: Checkpoint file; training resumes from it if it exists.
        settings: Text that identifies the training; a checkpoint with another one is rejected.
    """

    steps: int
    rate: float
    distance_weight: float
    sharpness: float
    told: Callable[[int, float], None] | None = None
    resume: Path | None = None
    settings: str = ''


def learned_network(
    parameters: dict[str, Any],
    terms: Terms,
    size: int,
    drawn: Callable[[int], tuple[Any, Any]],
    descent: Descent,
) -> dict[str, Any]:
    """Trains the parameters of a network.

    Args:
        size: dimension n of a target.

    Raises:
        ValueError: JAX or Optax is missing, or the checkpoint is of another training.
    """
    check_tools()
    import jax
    import optax

    s = descent

    def loss(p: Any, x: Any, y: Any) -> Any:
        gates, density, distance = terms(p, x, y)
        mass = jax.scipy.special.logsumexp(gates + density, axis=1)
        answer = jax.lax.stop_gradient(jax.nn.softmax(gates + s.sharpness * density, axis=1))
        return (-mass / size + s.distance_weight * (answer * distance).sum(1)).mean()

    rise = optax.linear_schedule(0.0, s.rate, RISING)
    fall = optax.cosine_decay_schedule(s.rate, max(s.steps - RISING, 1), END)
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adam(optax.join_schedules([rise, fall], [RISING]), b2=0.99),
    )

    def step(p: Any, state: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
        value, slope = jax.value_and_grad(loss)(p, x, y)
        change, state = optimiser.update(slope, state, p)
        return optax.apply_updates(p, change), state, value

    compiled_step = jax.jit(step)
    state = optimiser.init(parameters)
    leaves, shape = jax.tree.flatten((parameters, state))
    begun = 0
    if s.resume is not None and s.resume.exists():
        begun, leaves = _taken_up(s.resume, leaves, s.settings)
    parameters, state = jax.tree.unflatten(shape, leaves)
    for number, (x, y) in _ahead(drawn, range(begun, s.steps)):
        parameters, state, value = compiled_step(parameters, state, x, y)
        if s.told is not None:
            s.told(number + 1, float(value))
        if s.resume is not None and (number + 1) % MARK == 0:
            _mark(s.resume, number + 1, jax.tree.leaves((parameters, state)), s.settings)
    return {name: np.asarray(value) for name, value in parameters.items()}


def tools_are_there() -> bool:
    """Whether JAX and Optax are installed."""
    return all(find_spec(name) is not None for name in ('jax', 'optax'))


def check_tools() -> None:
    """Raises ValueError if JAX or Optax is missing."""
    if not tools_are_there():
        raise ValueError(NEEDED)


def first_layers(inputs: int, units: int, layers: int, outputs: int, seed: int) -> dict[str, Any]:
    """Random initial weights of the layers."""
    rng, f32 = np.random.default_rng([seed, -1 % 2**32]), np.float32

    def normal(*shape: int) -> Any:
        return rng.standard_normal(shape, dtype=f32)

    return {
        'first': normal(inputs, units) * f32(np.sqrt(2.0 / inputs)),
        'first_bias': np.zeros(units, f32),
        'hidden': normal(layers, units, units) * f32(1.0 / np.sqrt(units)),
        'hidden_biases': np.zeros((layers, units), f32),
        'last': normal(units, outputs) * f32(0.2 / np.sqrt(units)),
        # Experts with equal initial weights would stay equal.
        'last_bias': 0.3 * normal(outputs),
    }


def layer_outputs(p: Any, x: Any) -> Any:
    """Outputs (N, O) of layers at whitened inputs (N, p), in JAX; see `Layers.outputs`."""
    from jax.nn import leaky_relu

    h = leaky_relu(x @ p['first'] + p['first_bias'], LEAK_SLOPE)
    for weights, bias in zip(p['hidden'], p['hidden_biases'], strict=True):
        h = h + leaky_relu(h @ weights + bias, LEAK_SLOPE)
    return h @ p['last'] + p['last_bias']


def _ahead(drawn: Callable[[int], Any], steps: range) -> Iterator[tuple[int, Any]]:
    """Steps with their random draws; each is drawn in a thread during the step before."""
    with ThreadPoolExecutor(1) as beside:
        waiting = beside.submit(drawn, steps[0]) if steps else None
        for step in steps:
            assert waiting is not None
            found = waiting.result()
            waiting = beside.submit(drawn, step + 1)
            yield step, found


def _mark(path: Path, step: int, leaves: list[Any], settings: str) -> None:
    arrays: dict[str, Any] = {f'leaf{i}': np.asarray(leaf) for i, leaf in enumerate(leaves)}
    with new_file(path) as file:
        np.savez(file, **arrays, step=step, settings=settings)


def _taken_up(path: Path, leaves: list[Any], settings: str) -> tuple[int, list[Any]]:
    with np.load(path, allow_pickle=False) as content:
        if str(content['settings']) != settings:
            raise ValueError(
                f'{path} records a training with other settings, {content["settings"]}: remove '
                f'it, or wanted {settings}'
            )
        return int(content['step']), [content[f'leaf{i}'] for i in range(len(leaves))]


class LearningNetwork(NetworkExperts):
    """Trainable `NetworkExperts`; files store them as that class."""

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Fits the experts to samples; see `ConditionalDensity.fit`.

        Raises:
            ValueError: as `ConditionalDensity.fit`, or JAX or Optax is missing.
        """
        pairs = checked_pairs(
            inputs, targets, sample_weight, at_least=MIN_SAMPLES, what='to learn from'
        )
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

            gates, means, widths = read_outputs(layer_outputs(p, seen), m, d)
            widths = jnp.clip(widths, -LOG_WIDTH_LIMIT, LOG_WIDTH_LIMIT)
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
        """Cluster centres of the inputs, and their root mean square distance from the inputs."""
        rng = np.random.default_rng(self.seed)
        some = x[np.sort(rng.permutation(len(x))[:FOR_CENTRES])].astype(np.float64)
        centres, own = k_means(some, min(CENTRES, len(some)), rng, iterations=5)
        spread = float(np.sqrt(((some - centres[own]) ** 2).sum(1).mean()))
        return centres, max(spread, 1e-9)


def _triangular(factors: Any, np_: Any) -> Any:
    """Lower triangular matrices (M, D, D) with positive diagonals."""
    d = factors.shape[1]
    return np_.tril(factors, -1) + np_.exp(np_.diagonal(factors, axis1=1, axis2=2))[
        :, :, None
    ] * np_.eye(d)
