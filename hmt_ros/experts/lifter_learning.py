"""Learning of a lifter: gates, means and deviations of its experts, by stochastic gradient descent.

    loss = -log p(y | r) / (3 J) + a sum_i q_i mean_j |f_ij - y_j|,     q_i ~ g_i N_i^b

The first part is the mixture density [Bishop 1994]. Alone it polishes joints that are sure already;
the second part, over the experts that answer for a pose, makes the means good where deviations are
large. q does not pass gradients. The rate of Adam falls as a cosine.

JAX and Optax do the work; who only predicts needs neither. The same seed, steps and machine give
the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp, ndtr

from hmt_ros.body import Body
from hmt_ros.experts.keypoint_training import (
    JOINTS,
    KeypointTracks,
    WindowSettings,
    training_windows,
)
from hmt_ros.experts.lifter import LEAK, MEANS, SPREAD, SPREADS, Lifter, Network
from hmt_ros.inference.arrays import Array

# Joints whose mean distance from the truth is told, from the pelvis.
SCORED = tuple(i for i, name in enumerate(JOINTS) if not name.endswith(('toe', 'hand', 'pelvis')))
PELVIS = JOINTS.index('pelvis')
# Steps until the rate has risen, and between two marks of a training that can be taken up again.
RISING, MARK = 300, 500
# Least scale of an input.
LEAST_SCALE = 0.1
NEEDED = 'training needs JAX and Optax, which are missing: pip install jax optax'


@dataclass(frozen=True)
class LearningSettings:
    """How a lifter learns.

    Attributes:
        experts: Number of experts, K.
        units, layers: Width of the layers that experts share, and number of those that add.
        steps: Number of steps.
        batch: Windows a step.
        rate: Of Adam, at its highest.
        distance_weight: Factor a, 1/m.
        sharpness: Exponent b of the densities in q.
        seed: Of all random choices.
    """

    experts: int = 5
    units: int = 624
    layers: int = 3
    steps: int = 30_000
    batch: int = 1024
    rate: float = 1e-3
    distance_weight: float = 9.0
    sharpness: float = 0.5
    seed: int = 0


def learn_lifter(
    body: Body,
    tracks: KeypointTracks,
    settings: LearningSettings,
    windows: WindowSettings,
    notes: dict[str, Any],
    told: Callable[[int, float], None] | None = None,
    resume: Path | None = None,
) -> Lifter:
    """A lifter that has learned.

    Args:
        body: with the usual lengths.
        tracks: of motions.
        settings: how it learns.
        windows: what it learns from.
        notes: where it comes from, for its file.
        told: is called after each step, with its number and the loss.
        resume: file in which the training is marked now and then, and taken up if it is there.

    Raises:
        ValueError: JAX or Optax is missing, or the file to take up is of another training.
    """
    check_tools()
    import jax
    import jax.numpy as jnp
    import optax

    s = settings

    def drawn(step: int) -> tuple[Any, Any]:
        return training_windows(tracks, s.batch, np.random.default_rng([s.seed, step]), windows)

    inputs, joints = drawn(s.steps)
    mean, scale = inputs.mean(0), inputs.std(0) + np.float32(LEAST_SCALE)
    middle = joints.mean(0)
    k, j = s.experts, len(JOINTS)

    def network(p: Any, x: Any) -> tuple[Any, Any, Any]:
        h = jax.nn.leaky_relu(((x - mean) / scale) @ p['first'] + p['first_bias'], LEAK)
        for weights, bias in zip(p['hidden'], p['hidden_biases'], strict=True):
            h = h + jax.nn.leaky_relu(h @ weights + bias, LEAK)
        out = h @ p['last'] + p['last_bias']
        means = out[:, k : k * (1 + 3 * j)].reshape(-1, k, j, 3)
        spreads = out[:, k * (1 + 3 * j) :].reshape(-1, k, j, 3)
        return (
            jax.nn.log_softmax(out[:, :k]), MEANS * means + middle,
            jnp.clip(spreads + SPREAD, *SPREADS),
        )  # fmt: skip

    def loss(p: Any, x: Any, y: Any) -> Any:
        gates, means, spreads = network(p, x)
        off = means - y[:, None]
        density = -(0.5 * (off * jnp.exp(-spreads)) ** 2 + spreads).sum((2, 3))
        mass = jax.scipy.special.logsumexp(gates + density, axis=1)
        answer = jax.lax.stop_gradient(jax.nn.softmax(gates + s.sharpness * density, axis=1))
        distance = jnp.sqrt((off * off).sum(3) + 1e-6).mean(2)
        return (-mass / (3 * j) + s.distance_weight * (answer * distance).sum(1)).mean()

    rise = optax.linear_schedule(0.0, s.rate, RISING)
    fall = optax.cosine_decay_schedule(s.rate, max(s.steps - RISING, 1), 0.005)
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adam(optax.join_schedules([rise, fall], [RISING]), b2=0.99),
    )

    def step(p: Any, state: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
        value, slope = jax.value_and_grad(loss)(p, x, y)
        change, state = optimiser.update(slope, state, p)
        return optax.apply_updates(p, change), state, value

    compiled_step = jax.jit(step)
    parameters = _first(inputs.shape[1], s)
    state = optimiser.init(parameters)
    leaves, shape = jax.tree.flatten((parameters, state))
    begun = 0
    if resume is not None and resume.exists():
        begun, leaves = _taken_up(resume, leaves, s)
    parameters, state = jax.tree.unflatten(shape, leaves)
    for number, (x, y) in _ahead(drawn, range(begun, s.steps)):
        parameters, state, value = compiled_step(parameters, state, x, y)
        if told is not None:
            told(number + 1, float(value))
        if resume is not None and (number + 1) % MARK == 0:
            _mark(resume, number + 1, jax.tree.leaves((parameters, state)), s)
    found = {name: np.asarray(value) for name, value in parameters.items()}
    return Lifter(Network(mean, scale, middle=middle, **found), JOINTS, body, notes)


def check_tools() -> None:
    """Raises ValueError where JAX or Optax is missing."""
    if any(find_spec(name) is None for name in ('jax', 'optax')):
        raise ValueError(NEEDED)


def _first(inputs: int, s: LearningSettings) -> dict[str, Any]:
    """Weights before learning."""
    rng, f32 = np.random.default_rng([s.seed, -1 % 2**32]), np.float32
    outputs, h = s.experts * (1 + 6 * len(JOINTS)), s.units

    def normal(*shape: int) -> Any:
        return rng.standard_normal(shape, dtype=f32)

    return {
        'first': normal(inputs, h) * f32(np.sqrt(2.0 / inputs)),
        'first_bias': np.zeros(h, f32),
        'hidden': normal(s.layers, h, h) * f32(1.0 / np.sqrt(h)),
        'hidden_biases': np.zeros((s.layers, h), f32),
        'last': normal(h, outputs) * f32(0.2 / np.sqrt(h)),
        # Experts that begin as one stay one.
        'last_bias': 0.3 * normal(outputs),
    }


def _ahead(drawn: Callable[[int], Any], steps: range) -> Iterator[tuple[int, Any]]:
    """Steps with what was drawn for them, drawn beside the step before."""
    with ThreadPoolExecutor(1) as beside:
        waiting = beside.submit(drawn, steps[0]) if steps else None
        for step in steps:
            assert waiting is not None
            found = waiting.result()
            waiting = beside.submit(drawn, step + 1)
            yield step, found


def _mark(path: Path, step: int, leaves: list[Any], s: LearningSettings) -> None:
    arrays: dict[str, Any] = {f'leaf{i}': np.asarray(leaf) for i, leaf in enumerate(leaves)}
    partial = path.with_suffix('.part')
    with partial.open('wb') as file:
        np.savez(file, **arrays, step=step, settings=str(asdict(s)))
    partial.replace(path)


def _taken_up(path: Path, leaves: list[Any], s: LearningSettings) -> tuple[int, list[Any]]:
    with np.load(path, allow_pickle=False) as content:
        if str(content['settings']) != str(asdict(s)):
            raise ValueError(
                f'{path} marks a training with other settings, {content["settings"]}: remove it, '
                f'or wanted {asdict(s)}'
            )
        return int(content['step']), [content[f'leaf{i}'] for i in range(len(leaves))]


@dataclass(frozen=True)
class LifterScores:
    """Scores of a lifter on windows.

    Attributes:
        heaviest, best: Mean distance of the scored joints from the truth, from the pelvis, m, of
            the heaviest expert and of the best one.
        log_density: Mean log density of the truth, nats a number.
        within: Share of the true coordinates in the central 90 % of their marginal mixture.
    """

    heaviest: float
    best: float
    log_density: float
    within: float


def lifter_scores(lifter: Lifter, inputs: Any, joints: Any) -> LifterScores:
    """Scores on windows: inputs (N, p) and joints (N, J, 3)."""
    gates, means, deviations = lifter.network(inputs)
    off = means - joints[:, None]
    each = gates - (0.5 * (off / deviations) ** 2 + np.log(deviations)).sum((2, 3))
    size = off[0, 0].size
    density = logsumexp(each, axis=1) / size - 0.5 * np.log(2.0 * np.pi)
    wanted = joints[:, SCORED] - joints[:, [PELVIS]]
    seen = means[:, :, SCORED] - means[:, :, [PELVIS]]
    distance = np.linalg.norm(seen - wanted[:, None], axis=3).mean(2)
    rows = np.arange(len(gates))
    return LifterScores(
        float(distance[rows, gates.argmax(1)].mean()), float(distance.min(1).mean()),
        float(density.mean()), float(_within(gates, off / deviations).mean()),
    )  # fmt: skip


def _within(gates: Array, off: Array, share: float = 0.9) -> Array:
    """Whether truths are in the central share of marginals, by whitened offsets (N, K, J, 3)."""
    below = np.einsum('nk,nkji->nji', np.exp(gates), ndtr(-off))
    return np.asarray(np.abs(below - 0.5) <= 0.5 * share)
