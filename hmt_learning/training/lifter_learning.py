"""Learning of the lifter, a mixture of experts, from landmark tracks; and its scores.

The distance in the loss (`network_learning`) is the mean distance of the joints from their true
positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp, ndtr

from hmt_learning.training.keypoint_tracks import JOINTS, KeypointTracks, keypoint_tracks
from hmt_learning.training.keypoint_training import WindowSettings, training_windows
from hmt_learning.training.network_learning import (
    Descent,
    check_tools,
    first_layers,
    layer_outputs,
    learned_network,
)
from hmt_learning.training.training_set import PoseSequence
from hmt_ros.body import Body
from hmt_ros.experts.lifter import LOG_SIGMA_LIMITS, MEAN_SCALE, USUAL_LOG_SIGMA, Lifter, Network
from hmt_ros.inference.arrays import Array

# Number of windows for the scores of a lifter.
SCORED_WINDOWS = 2000
# Joints for the reported mean distance from the truth, relative to the pelvis.
SCORED = tuple(i for i, name in enumerate(JOINTS) if not name.endswith(('toe', 'hand', 'pelvis')))
PELVIS = JOINTS.index('pelvis')
# Added to the scale of each input.
MIN_SCALE = 0.1


@dataclass(frozen=True)
class LearningSettings:
    """Settings for the training of a lifter.

    Attributes:
        units, layers: Width of the layers shared by all experts, and number of residual layers.
        rate: Highest learning rate of Adam.
        distance_weight: Factor a on the distances, 1/m.
        sharpness: Exponent b of the densities in q.
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
    taught: Lifter | None = None,
) -> Lifter:
    """Trains a lifter.

    Args:
        body: body with the usual lengths.
        told: callback after each step, with its number and the loss.
        resume: checkpoint file; training resumes from it if it exists.
        taught: trained lifter to start from; None starts from random weights.

    Raises:
        ValueError: JAX or Optax is missing, the checkpoint is of another training, or `taught` has
            another network.
    """
    check_tools()
    import jax
    import jax.numpy as jnp

    s = settings

    def drawn(step: int) -> tuple[Any, Any]:
        return training_windows(tracks, s.batch, np.random.default_rng([s.seed, step]), windows)

    inputs, joints = drawn(s.steps)
    k, j = s.experts, len(JOINTS)
    mean, scale = inputs.mean(0), inputs.std(0) + np.float32(MIN_SCALE)
    middle = joints.mean(0)
    first = first_layers(inputs.shape[1], s.units, s.layers, k * (1 + 6 * j), s.seed)
    if taught is not None:
        before = taught.network
        known = {name: np.asarray(getattr(before, name), np.float32) for name in first}
        sizes = {name: value.shape for name, value in first.items()}
        if {name: value.shape for name, value in known.items()} != sizes or taught.joints != JOINTS:
            raise ValueError(f'the lifter to continue from has another network: wanted {sizes}')
        first, mean, scale, middle = known, before.mean, before.scale, before.middle

    def terms(p: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
        out = layer_outputs(p, (x - mean) / scale)
        means = MEAN_SCALE * out[:, k : k * (1 + 3 * j)].reshape(-1, k, j, 3) + middle
        spreads = out[:, k * (1 + 3 * j) :].reshape(-1, k, j, 3)
        spreads = jnp.clip(spreads + USUAL_LOG_SIGMA, *LOG_SIGMA_LIMITS)
        off = means - y[:, None]
        density = -(0.5 * (off * jnp.exp(-spreads)) ** 2 + spreads).sum((2, 3))
        distance = jnp.sqrt((off * off).sum(3) + 1e-6).mean(2)
        return jax.nn.log_softmax(out[:, :k]), density, distance

    descent = Descent(s.steps, s.rate, s.distance_weight, s.sharpness, told, resume, str(asdict(s)))
    found = learned_network(first, terms, 3 * j, drawn, descent)
    return Lifter(Network(mean=mean, scale=scale, middle=middle, **found), JOINTS, body, notes)


@dataclass(frozen=True)
class LifterScores:
    """Scores of a lifter on test windows.

    Attributes:
        heaviest, best: Mean distance of the scored joints from the truth, relative to the pelvis,
            for the heaviest expert and for the best one, m.
        log_density: Mean log density of the truth, nats per coordinate.
        within: Share of the true coordinates in the central 90 % of their marginal mixture.
    """

    heaviest: float
    best: float
    log_density: float
    within: float


def lifter_scores(lifter: Lifter, inputs: Any, joints: Any) -> LifterScores:
    """Scores a lifter on windows: inputs (N, p) and joints (N, J, 3)."""
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
        float(distance[rows, gates.argmax(1)].mean()),
        float(distance.min(1).mean()),
        float(density.mean()),
        float(_within(gates, off / deviations).mean()),
    )


def _within(gates: Array, off: Array, share: float = 0.9) -> Array:
    """Whether true coordinates lie in the central share of their marginals (N, J, 3)."""
    below = np.einsum('nk,nkji->nji', np.exp(gates), ndtr(-off))
    return np.asarray(np.abs(below - 0.5) <= 0.5 * share)


def scores_on(
    body: Body, tested: list[PoseSequence], lifter: Lifter, windows: WindowSettings
) -> dict[str, str]:
    """Scores on motions of other people, as text for each kind of keypoints."""
    tracks = keypoint_tracks(body, tested, [1.0] * len(tested), variants=1)
    known = replace(
        windows,
        cut=0.0,
        causal=0.0,
        gravity_spread=0.0,
        lengths_spread=0.0,
        lengths=1.0,
        near=0.0,
        recombined=0.0,
        asynchronous=0.0,
        seated=0.0,
    )
    kinds = {
        'clean keypoints': replace(known, noise=0.0),
        'a detector that errs': known,
        'the same, causal': replace(known, causal=1.0),
        'the same, lengths unknown': replace(known, causal=1.0, lengths=0.0),
        'causal, near, legs out of view': replace(known, causal=1.0, near=1.0),
    }
    result = {}
    for name, kind in kinds.items():
        drawn = training_windows(tracks, SCORED_WINDOWS, np.random.default_rng(0), kind, 0)
        s = lifter_scores(lifter, *drawn)
        result[name] = (
            f'{1e3 * s.heaviest:.0f} mm heaviest, {1e3 * s.best:.0f} best, '
            f'{s.log_density:.2f} nats, {100 * s.within:.0f} % within 90'
        )
    return result
