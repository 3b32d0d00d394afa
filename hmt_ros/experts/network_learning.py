"""Learning of a network of experts by stochastic gradient descent.

    loss = -log sum_i g_i p_i / n + a sum_i q_i d_i,     q_i ~ g_i p_i^b

The first part is the mixture density [Bishop 1994], of n numbers. Alone it improves means of small
deviation; the second part, over the experts responsible for a target, improves the means where
deviations are large: d_i is the distance of a mean from the target. q does not pass gradients. The
rate of Adam falls as a cosine.

JAX and Optax do the work; prediction needs neither. The same seed, steps and machine give the same
bytes.

`Layers` have units that leak; each layer is added to the last.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Index

if TYPE_CHECKING:
    from typing_extensions import Self


# Steps until the rate has risen, and between two marks of a training that can be taken up again.
RISING, MARK = 300, 500
# At the end the rate is this share of the highest one.
END = 0.005
NEEDED = 'a network needs JAX and Optax to learn, which are missing: pip install jax optax'

# From parameters, inputs and targets: log gates, log densities and distances, all (N, K).
Terms = Callable[[Any, Any, Any], tuple[Any, Any, Any]]


@dataclass(frozen=True)
class Descent:
    """How a network learns.

    Attributes:
        rate: Learning rate of Adam, at its highest.
        distance_weight: Factor a.
        sharpness: Exponent b of the densities in q.
        told: Is called after each step, with its number and the loss.
        resume: File in which the training is marked now and then, and taken up if it is there.
        settings: Text that tells one training from another.
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
    """The parameters that have learned.

    Args:
        size: number of numbers in a target, n.

    Raises:
        ValueError: JAX or Optax is missing, or the file to take up is of another training.
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
    """Raises ValueError where JAX or Optax is missing."""
    if not tools_are_there():
        raise ValueError(NEEDED)


def first_layers(inputs: int, units: int, layers: int, outputs: int, seed: int) -> dict[str, Any]:
    """Weights of layers before learning."""
    rng, f32 = np.random.default_rng([seed, -1 % 2**32]), np.float32

    def normal(*shape: int) -> Any:
        return rng.standard_normal(shape, dtype=f32)

    return {
        'first': normal(inputs, units) * f32(np.sqrt(2.0 / inputs)),
        'first_bias': np.zeros(units, f32),
        'hidden': normal(layers, units, units) * f32(1.0 / np.sqrt(units)),
        'hidden_biases': np.zeros((layers, units), f32),
        'last': normal(units, outputs) * f32(0.2 / np.sqrt(units)),
        # Experts that begin as one stay one.
        'last_bias': 0.3 * normal(outputs),
    }


def layer_outputs(p: Any, x: Any) -> Any:
    """Outputs (N, O) of layers at whitened inputs (N, p), in JAX; see `Layers.outputs`."""
    from jax.nn import leaky_relu

    h = leaky_relu(x @ p['first'] + p['first_bias'], LEAK)
    for weights, bias in zip(p['hidden'], p['hidden_biases'], strict=True):
        h = h + leaky_relu(h @ weights + bias, LEAK)
    return h @ p['last'] + p['last_bias']


def _ahead(drawn: Callable[[int], Any], steps: range) -> Iterator[tuple[int, Any]]:
    """Steps with their random draws, made beside the step before."""
    with ThreadPoolExecutor(1) as beside:
        waiting = beside.submit(drawn, steps[0]) if steps else None
        for step in steps:
            assert waiting is not None
            found = waiting.result()
            waiting = beside.submit(drawn, step + 1)
            yield step, found


def _mark(path: Path, step: int, leaves: list[Any], settings: str) -> None:
    arrays: dict[str, Any] = {f'leaf{i}': np.asarray(leaf) for i, leaf in enumerate(leaves)}
    partial = path.with_suffix('.part')
    with partial.open('wb') as file:
        np.savez(file, **arrays, step=step, settings=settings)
    partial.replace(path)


def _taken_up(path: Path, leaves: list[Any], settings: str) -> tuple[int, list[Any]]:
    with np.load(path, allow_pickle=False) as content:
        if str(content['settings']) != settings:
            raise ValueError(
                f'{path} marks a training with other settings, {content["settings"]}: remove it, '
                f'or wanted {settings}'
            )
        return int(content['step']), [content[f'leaf{i}'] for i in range(len(leaves))]


LEAK = 0.1  # slope of a unit below 0

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True)
class Layers:
    """Layers of H units, after which come O numbers.

    Attributes:
        first, first_bias: (p, H), (H,).
        hidden, hidden_biases: (M, H, H), (M, H).
        last, last_bias: (H, O), (O,).
    """

    first: Floats
    first_bias: Floats
    hidden: Floats
    hidden_biases: Floats
    last: Floats
    last_bias: Floats

    def outputs(self, inputs: Floats) -> Floats:
        """The numbers (N, O) at inputs (N, p) that are whitened."""
        units = _leaky(inputs @ self.first + self.first_bias)
        for weights, bias in zip(self.hidden, self.hidden_biases, strict=True):
            units = units + _leaky(units @ weights + bias)
        result: Floats = units @ self.last + self.last_bias
        return result

    def jacobians(self, inputs: Floats, which: slice | Index) -> Floats:
        """Derivatives (N, o, p) of some of the numbers by inputs (N, p) that are whitened."""
        before = inputs @ self.first + self.first_bias
        units = _leaky(before)
        slopes = _slopes(before)[:, :, None] * self.first.T
        for weights, bias in zip(self.hidden, self.hidden_biases, strict=True):
            before = units @ weights + bias
            units = units + _leaky(before)
            slopes = slopes + _slopes(before)[:, :, None] * (weights.T @ slopes)
        result: Floats = self.last[:, which].T @ slopes
        return result

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays for a file: in half precision, except single rows."""
        return {
            name: np.asarray(value, dtype=np.float16 if value.ndim > 1 else np.float32)
            for name, value in vars(self).items()
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The layers that `to_arrays` stored.

        Raises:
            KeyError, ValueError: arrays are missing or do not fit.
        """
        names = cls.__dataclass_fields__
        return cls(**{name: np.asarray(arrays[name], dtype=np.float32) for name in names})


def _leaky(x: Floats) -> Floats:
    """Outputs of leaky units."""
    result: Floats = np.maximum(x, np.float32(LEAK) * x)
    return result


def _slopes(x: Floats) -> Floats:
    return np.where(x > 0, np.float32(1.0), np.float32(LEAK))
