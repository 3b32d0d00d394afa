"""What VMS shows of its sequence, on a clip that the tracker follows: from its modes to its optima.

The modes of the likelihoods of `TIMES` images make the network; `PATHS` paths through it are
refined, and the free energy is minimised from their optima, as in the paper (VMS 4 to 7). Errors of
images count as independent, as they do there; `smoother_node` counts what is new of an image alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from benchmarks.runs import Seen
from hmt_ros.body import Body
from hmt_ros.body.mirror import free_limits, without_turns
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.energy import Derivatives
from hmt_ros.sessions.image_evidence import Evidence
from hmt_ros.sessions.smoother_session import MERGED
from hmt_ros.smoothing.embedded_network import EmbeddedNetwork, Paths
from hmt_ros.smoothing.likelihood import counted
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.trajectory_refinement import RefinedTrajectories, limits_of_states, refine
from hmt_ros.smoothing.variational_mixture import VariationalMixture, minimise_free_energy

Array = NDArray[np.float64]

# Images, and how many images of the clip lie between two of them (VMS 7: every second or third).
TIMES, EVERY = 47, 2
PATHS = 64
# Of the descent of the free energy.
SAMPLES, ITERATIONS = 16, 15


@dataclass(frozen=True, eq=False)
class ClipTrajectories:
    """Images of a clip, smoothed step by step.

    Attributes:
        body: of the person, as the tracker has it at last.
        stamps: (T,) ns.
        sequence: the modes of the likelihoods.
        paths: `PATHS` of them, the best between each pair of ends and, where these are fewer, more.
        starts: (P, T, n) states along them.
        refined: the optimum that each of them leads to.
        visiting: T arrays (K_1, K_t), how probably the paths from each first mode visit a mode.
        start_energies: (P,) -log p of the observations along the paths.
        lower, upper: (d,) limits of poses.
    """

    body: Body
    stamps: tuple[int, ...]
    sequence: ModeSequence
    paths: Paths
    starts: Array
    refined: RefinedTrajectories
    visiting: tuple[Array, ...]
    start_energies: Array
    lower: Array
    upper: Array

    @property
    def seconds(self) -> Array:
        """Times (T,) from the first image on, s."""
        return (np.array(self.stamps) - self.stamps[0]) * 1e-9

    @cached_property
    def distinct(self) -> RefinedTrajectories:
        """The optima without repetitions, the most probable first."""
        return self.refined.without_duplicates()

    def joints(self, states: Array) -> Array:
        """Joints (..., J, 3) at states (..., n), camera frame, m."""
        d = self.sequence.dynamics.dimension
        flat = states[..., :d].reshape(-1, d)
        return self.body.joint_positions(flat).reshape(*states.shape[:-1], -1, 3)


def clip_trajectories(
    seen: Sequence[Seen], *, independent: bool = True, through_modes: bool = False
) -> ClipTrajectories:
    """Network, paths and optima of what the tracker says of some images.

    Args:
        seen: of T images.
        independent: whether errors of images count as independent; else as `smoother_node` does.
        through_modes: whether paths through every single mode are among the starts.

    Raises:
        ValueError: there are fewer than two images.
    """
    if len(seen) < 2:
        raise ValueError(f'wanted at least 2 images with a likelihood, saw {len(seen)}')
    body, dynamics = seen[-1].body, motion_prior(seen[-1].body)
    stamps = [one.stamp for one in seen]
    intervals = np.diff(stamps) * 1e-9
    lower, upper = free_limits(body)
    mixtures = _evidence(seen, body, independent)
    sequence = ModeSequence(mixtures, dynamics, intervals)
    paths = sequence.paths(PATHS, through_modes=through_modes)
    starts = sequence.states(paths)
    refined = refine(starts, sequence.prior, sequence.likelihood, lower, upper)
    return ClipTrajectories(
        body,
        tuple(stamps),
        sequence,
        paths,
        starts,
        refined,
        visiting_probabilities(sequence.network, paths),
        _observed(sequence, starts),
        lower,
        upper,
    )


def _evidence(seen: Sequence[Seen], body: Body, independent: bool) -> tuple[GaussianMixture, ...]:
    """Likelihoods, on angles that go on from image to image."""
    whole: list[GaussianMixture] = []
    for one in seen:
        mixture = one.likelihood
        before = whole[-1].means if whole else mixture.means[[int(mixture.weights.argmax())]]
        whole.append(replace(mixture, means=without_turns(body, mixture.means, before)))
    if independent:
        return tuple(counted(mixture, 1.0) for mixture in whole)
    distance, befores = MERGED, [None, *(x.stamp for x in seen)]
    return tuple(
        Evidence(x.stamp, mixture, x.errors, None).since(before, body.rates, distance)
        for x, mixture, before in zip(seen, whole, befores)
    )


def _observed(sequence: ModeSequence, states: Array) -> Array:
    """-log p (P,) of the observations along trajectories (P, T, n), nats."""
    count, times, _ = states.shape
    poses = states[:, :, : sequence.dynamics.dimension].reshape(count * times, -1)
    at = np.tile(np.arange(times), count)
    value = sequence.likelihood.energy(poses, at, derivatives=Derivatives.NONE).value
    result: Array = value.reshape(count, times).sum(1)
    return result


def pose_covariance(found: ClipTrajectories, images: int) -> Array:
    """Covariance (T d, T d) of the first T poses at the optimum of these images alone (VMS 7).

    The optimum is the one next to the best one of all images; velocities are integrated out. Metres
    and radians stand beside each other, as in the paper.
    """
    whole = found.sequence
    part = ModeSequence(whole.mixtures[:images], whole.dynamics, whole.intervals[: images - 1])
    start = found.distinct.states[:1, :images]
    refined = refine(start, part.prior, part.likelihood, found.lower, found.upper)
    d, n = whole.dynamics.dimension, start.shape[2]
    units = np.zeros((images, d, images, n))
    for t in range(images):
        units[t, :, t, :d] = np.eye(d)
    columns = refined.factors[0].solve(units.reshape(images * d, images, n))
    return np.asarray(columns[:, :, :d].reshape(images * d, images * d))


def descent(found: ClipTrajectories) -> VariationalMixture:
    """The descent of the free energy from the distinct optima, weighed by their height (VMS 6)."""
    prior, distinct = found.sequence.prior, found.distinct
    low, high = limits_of_states(
        found.lower, found.upper, prior.dimension, distinct.states.shape[2]
    )
    heights = np.exp(-distinct.energies - logsumexp(-distinct.energies))
    return minimise_free_energy(
        heights, distinct.states, distinct.factors, prior,
        found.sequence.likelihood, low=low, high=high, samples=SAMPLES, max_iterations=ITERATIONS,
    )  # fmt: skip


def visiting_probabilities(network: EmbeddedNetwork, paths: Paths) -> tuple[Array, ...]:
    """How probably the paths from each source visit each node (VMS fig. 2), T arrays (K_1, K_t).

    Of the paths that start from the same first node, the sum of the probabilities of those through
    a node over that of all. Rows of sources without paths are zero.
    """
    sources = len(network.nodes[0])
    weights = np.zeros(len(paths))
    for source in range(sources):
        at = paths.nodes[:, 0] == source
        if at.any():
            weights[at] = np.exp(paths.log_values[at] - logsumexp(paths.log_values[at]))
    result = []
    for t, nodes in enumerate(network.nodes):
        table = np.zeros((sources, len(nodes)))
        np.add.at(table, (paths.nodes[:, 0], paths.nodes[:, t]), weights)
        result.append(table)
    return tuple(result)
