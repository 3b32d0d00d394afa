"""The states of motions: smoothed along what the images say of each (VMS 5, in closed form).

    E(X) = |x_1 - m_1|^2_(P_1) / 2 + sum_t |x_(t+1) - A x_t|^2_(l_t Q) / 2
           + sum_t |x_t - z_t|^2_(R_t) / 2

z_t and R_t are the motion's modes in an image (`motions`), N(m_1, P_1) is the state predicted by
the motions that its paths come from. l_t is how much livelier the motion is than the prior of
people's motion: the least of 1, 4, 16, 64 with which the states stay with the modes whose motion
they are. An image whose modes are far from the states is wrong, and counts little. A motion whose
past is far from all its modes begins without it. E is a parabola with a block-tridiagonal Hessian;
states beyond limits are moved onto them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.resting_points import RestingPoints, RestingTable
from hmt_ros.core import condition_chain
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.block_tridiagonal import BlockCholesky, NotPositiveDefiniteError
from hmt_ros.inference.error_model import TOGETHER, CueErrors
from hmt_ros.inference.linear_algebra import (
    inverse,
    log_determinant,
    mean_distances,
    product,
    solve,
)
from hmt_ros.inference.linear_gaussian_dynamics import Couplings, LinearGaussianDynamics
from hmt_ros.inference.mode_chain import Link, backward_weights, drawn_paths
from hmt_ros.smoothing.motions import (
    SAME_MOTION,
    SECOND_NS,
    MotionEvidence,
    evidence_of_motions,
    grouped,
    path_distances,
)
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture
from hmt_ros.smoothing.trajectory_refinement import limits_of_states

# Paths that are drawn from the chain.
PATHS = 96
# Values of l, and the median distance from the modes, m, from which on the next is tried.
LIVELIER, ASTRAY = (1.0, 4.0, 16.0, 64.0), 0.05
# Distance from which on the modes of an image are taken for wrong, m, and looks at that.
WRONG, WRONG_PASSES = 0.15, 3
# Distance from all motions from which on a mode is a stray, m.
STRAY = 0.05
# Least weight of a motion of more than one image, and of one whose resting feet are held.
LEAST, LEAST_HELD = 0.03, 0.1


class ImageModes(NamedTuple):
    """What a filter says of an image.

    Attributes:
        stamp_ns: of the image.
        link: posterior weights and ancestry of its K modes.
        mixture: the likelihood of the image, undiscounted; K components. Their weights in it do
            not count.
        errors: how its errors last.
    """

    stamp_ns: int
    link: Link
    mixture: GaussianMixture
    errors: CueErrors


class WindowImage(NamedTuple):
    """An image of a window.

    Attributes:
        modes: of the image.
        counted: the likelihood with the covariances that count for changes.
        points: (K, P, 3) of the modes, m.
        lasting: factor on the variance that is left after it, because its errors last.
        alone: factor on the covariances of modes that nothing but the images so far tells of.
    """

    modes: ImageModes
    counted: GaussianMixture
    points: Array
    lasting: float
    alone: float


class FirstStates(NamedTuple):
    """What the past tells of the first states of M motions of a window.

    Attributes:
        means, covariances: (M, n) and (M, n, n).
        liveliness: (M,) l of the motion that each continues.
    """

    means: Array
    covariances: Array
    liveliness: Array


class Past(NamedTuple):
    """What is known of the first image of a window from the images before.

    Attributes:
        shares: (K, M) probability that each mode of the image continues each of M motions.
        first: states that these motions predict.
        places: (M, P, 3) where they were in the last image, m.
    """

    shares: Array
    first: FirstStates
    places: Array


class ChainPrior(NamedTuple):
    """What states are before images speak, for the core.

    Attributes:
        before, after, forth, which: of `Couplings`.
        shares: (T-1,) 1 / l.
        known: (n, n) P_1.
        pull: (n,) P_1 m_1.
    """

    before: Array
    after: Array
    forth: Array
    which: Index
    shares: Array
    known: Array
    pull: Array


class MotionStates(NamedTuple):
    """The states of a motion.

    Attributes:
        states: (T, n).
        factor: of their precision.
        log_joint: log p(X, R), images as Gaussians.
        liveliness: l.
        trust: (T,) share that each image counts with.
        fresh: whether the motion begins without the past.
    """

    states: Array
    factor: BlockCholesky
    log_joint: float
    liveliness: float
    trust: Array
    fresh: bool


class SmoothedMotions(NamedTuple):
    """The motions of a window.

    Attributes:
        trajectories: M of them.
        shares: T arrays (K_t, M), probability that each mode belongs to each motion.
        evidence: of the images; wrong ones have larger covariances.
        liveliness: (M,) l.
        fresh: (M,) whether a motion begins without the past.
        first: of the past; None: nothing is known.
    """

    trajectories: TrajectoryMixture
    shares: list[Array]
    evidence: MotionEvidence
    liveliness: Array
    fresh: Mask
    first: FirstStates | None


@dataclass(frozen=True, eq=False)
class MotionSmoother:
    """Smooths the modes of a filter's chain.

    Attributes:
        dynamics: of the state.
        lower, upper: (d,) limits of the pose at every time; None: none.
        points: maps poses (N, d) to points (N, P, 3), m, by which motions are told apart; None: the
            variables of the pose.
        max_motions: motions at most.
        resting: points that may rest on the ground; None: not used.
        seed: of the paths that are drawn.

    Raises:
        ValueError: settings out of range.
    """

    dynamics: LinearGaussianDynamics
    lower: ArrayLike | None = None
    upper: ArrayLike | None = None
    points: Callable[[Array], Array] | None = None
    max_motions: int = 8
    resting: RestingPoints | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_motions < 1:
            raise ValueError(f'max_motions must be at least 1, saw {self.max_motions}')
        self.limits()

    def limits(self) -> tuple[Array, Array]:
        """Limits (n,) of the states."""
        low = -np.inf if self.lower is None else self.lower
        high = np.inf if self.upper is None else self.upper
        return limits_of_states(low, high, self.dynamics.dimension, self.dynamics.state_dimension)

    def points_of(self, poses: Array) -> Array:
        """Points (..., P, 3) of poses (..., d)."""
        flat = poses.reshape(-1, poses.shape[-1])
        found = flat[..., None] if self.points is None else self.points(flat)
        return np.asarray(found.reshape(*poses.shape[:-1], *found.shape[1:]))

    def image(self, modes: ImageModes, before_ns: int | None) -> WindowImage:
        """An image of a window after one at `before_ns`; None: the first.

        Raises:
            ValueError: modes that can not be smoothed, a stamp that does not increase.
        """
        if before_ns is not None and modes.stamp_ns <= before_ns:
            raise ValueError(
                f'stamps must increase, saw {modes.stamp_ns} ns after {before_ns} ns; begin anew '
                'to go back'
            )
        mixture, link = modes.mixture, modes.link
        if mixture.dimension != self.dynamics.dimension:
            raise ValueError(
                f'the modes have {mixture.dimension} variables, the dynamics '
                f'{self.dynamics.dimension}'
            )
        total = float(link.weights.sum())
        if not (len(mixture) == len(link.weights) > 0 and abs(total - 1.0) < 1e-6):
            raise ValueError(
                f'{len(mixture)} modes have {len(link.weights)} weights that sum to {total:g}, '
                'wanted one for each, sum 1'
            )
        mixture.cholesky()
        dt = np.inf if before_ns is None else (modes.stamp_ns - before_ns) / SECOND_NS
        counted = replace(mixture, covariances=mixture.covariances / modes.errors.of_changes(dt))
        points = self.points_of(mixture.means)
        alone = TOGETHER / modes.errors.share(dt)
        return WindowImage(modes, counted, points, modes.errors.lasting(dt), alone)

    def smooth(self, sequence: Sequence[ImageModes]) -> TrajectoryMixture:
        """The trajectories of a whole sequence; see `motions`."""
        return self.motions(sequence).trajectories

    def motions(self, sequence: Sequence[ImageModes]) -> SmoothedMotions:
        """The motions of a whole sequence.

        Raises:
            ValueError: no images, stamps that do not increase, modes that can not be smoothed.
        """
        if not sequence:
            raise ValueError('no images to smooth')
        stamps = [None, *(modes.stamp_ns for modes in sequence)]
        images = [self.image(modes, before) for modes, before in zip(sequence, stamps)]
        return self.smoothed(images)

    def smoothed(self, images: Sequence[WindowImage], past: Past | None = None) -> SmoothedMotions:
        """The motions of the images of a window."""
        stamps = [image.modes.stamp_ns for image in images]
        links = [image.modes.link for image in images]
        nodes, weights = drawn_paths(links, PATHS, self.seed)
        points = [image.points for image in images]
        before = None if past is None else past.places[past.shares[nodes[:, 0]].argmax(1)]
        distances = path_distances(nodes, points, stamps, before)
        least = LEAST if len(images) > 1 else 0.0
        labels = grouped(weights, *distances, self.max_motions, least)
        counted = [image.counted for image in images]
        known = None if self.points is None else points
        evidence = evidence_of_motions(nodes, weights, labels, counted, known)
        masses: Array = np.bincount(labels, weights).astype(np.float64)
        shares = [
            _shares(nodes[:, t], weights, labels, len(link.weights), masses)
            for t, link in enumerate(links)
        ]
        first = None if past is None else self._first(past, nodes[:, 0], weights, labels)
        intervals = np.diff(stamps) / SECOND_NS
        couplings = self.dynamics.couplings(intervals)
        found = [
            self._states(intervals, couplings, evidence, first, m, masses[m] >= LEAST_HELD)
            for m in range(len(masses))
        ]
        trust = np.array([one.trust for one in found])
        evidence = evidence._replace(covariances=evidence.covariances / trust[:, :, None, None])
        low, high = self.limits()
        d = self.dynamics.dimension
        states = np.clip([one.states for one in found], low, high)
        trajectories = TrajectoryMixture(
            weights=masses / masses.sum(),
            states=states,
            factors=tuple(one.factor for one in found),
            inflation=np.full(len(masses), np.sqrt(np.mean([image.lasting for image in images]))),
            log_joint=np.array([one.log_joint for one in found]),
            free_energy=np.empty(0),
            dimension=d,
            stamps_ns=tuple(stamps),
            lower=low[:d],
            upper=high[:d],
            disagreements=evidence.disagreements,
        )
        if self.points is not None:
            trajectories = self._with_weights_in_time(trajectories, images, shares)
        liveliness = np.array([one.liveliness for one in found])
        fresh = np.array([one.fresh for one in found])
        return SmoothedMotions(trajectories, shares, evidence, liveliness, fresh, first)

    def _with_weights_in_time(
        self, found: TrajectoryMixture, images: Sequence[WindowImage], shares: Sequence[Array]
    ) -> TrajectoryMixture:
        """The trajectories with the weights of the modes that each is nearest to, at each time."""
        smoothed = backward_weights([image.modes.link for image in images])
        every = self.points_of(found.means).swapaxes(0, 1)
        weights, strays = np.zeros((found.times, len(found))), []
        for t, (image, own, places) in enumerate(zip(images, smoothed, every, strict=True)):
            away = mean_distances(image.points[:, None], places)
            nearest = away.min(1, keepdims=True)
            parts = np.where(away <= nearest + SAME_MOTION / 2, shares[t] + 1e-6 * found.weights, 0)
            stray = nearest[:, 0] > STRAY
            parts *= np.where(stray, 0.0, own / parts.sum(1))[:, None]
            weights[t], alone = parts.sum(0), np.flatnonzero(stray & (own > 0.0))
            modes = image.modes.mixture[alone]
            strays.append(GaussianMixture(own[alone], modes.means, image.alone * modes.covariances))
        return replace(found, weights_in_time=weights, strays=tuple(strays))

    def _first(self, past: Past, nodes: Index, weights: Array, labels: Index) -> FirstStates:
        """The first state of each motion, by its paths there."""
        shares = np.zeros((int(labels.max()) + 1, past.shares.shape[1]))
        np.add.at(shares, labels, weights[:, None] * past.shares[nodes])
        shares /= shares.sum(1, keepdims=True)
        means = product(shares, past.first.means)
        offsets = past.first.means - means[:, None]
        covariances = np.einsum('mk,kij->mij', shares, past.first.covariances)
        covariances += product((offsets * shares[:, :, None]).swapaxes(1, 2), offsets)
        return FirstStates(means, covariances, past.first.liveliness[shares.argmax(1)])

    def _states(
        self,
        intervals: Array,
        couplings: Couplings,
        evidence: MotionEvidence,
        first: FirstStates | None,
        m: int,
        held: bool,
    ) -> MotionStates:
        """The states of motion m; `held`: points that rest are."""
        dynamics, d = self.dynamics, self.dynamics.dimension
        means, precisions = evidence.means[m], inverse(evidence.covariances[m])
        places, trust = self.points_of(means), np.ones(len(means))
        at, known, least = dynamics.initial_mean, dynamics.initial_precision, LIVELIER[0]
        fresh = first is None
        if first is not None and self.points is not None:
            before = self.points_of(first.means[m, :d])
            fresh = bool(mean_distances(before, places).min() > WRONG)
        if first is not None and not fresh:
            at, known = first.means[m], inverse(first.covariances[m])
            least = first.liveliness[m] / LIVELIER[1]
        known = 0.5 * (known + known.T)
        pull_of_first = product(known, at)
        for liveliness in (x for x in LIVELIER if x >= least):
            noise = np.full(len(intervals), liveliness)
            prior = ChainPrior(*couplings[:4], 1.0 / noise, known, pull_of_first)
            states, factor = _conditioned(prior, precisions, means)
            away = self._away(states, places)
            if self.points is None or np.median(away) <= ASTRAY:
                break
        for _ in range(WRONG_PASSES):
            wrong = away > WRONG
            if self.points is None or not wrong.any():
                break
            trust = np.where(wrong, (ASTRAY / away) ** 2, 1.0)
            states, factor = _conditioned(prior, precisions * trust[:, None, None], means)
            away = self._away(states, places)
        precisions = precisions * trust[:, None, None]
        pull = product(precisions, means[:, :, None])[:, :, 0]
        seen = 0.5 * ((means * pull).sum() - log_determinant(precisions).sum())
        seen += 0.5 * product(at, pull_of_first) + couplings.constant(noise)
        gained = 0.5 * (product(states[0], pull_of_first) + (states[:, :d] * pull).sum())
        if held and self.resting is not None and len(states) > 1:
            # Covariances ignore what rests: rest is a decision, the same from image to image.
            poses = np.clip(states, *self.limits())[:, :d]
            resting = self.resting.along(poses, evidence.covariances[m], intervals)
            if resting is not None:
                states = _conditioned(prior, precisions, means, resting)[0]
        return MotionStates(states, factor, float(gained - seen), liveliness, trust, fresh)

    def _away(self, states: Array, places: Array) -> Array:
        """Mean distances (T,) of the points of states (T, n) from others (T, P, 3), m."""
        poses = np.clip(states, *self.limits())[:, : self.dynamics.dimension]
        return np.asarray(mean_distances(self.points_of(poses), places))

    def advanced(self, found: SmoothedMotions, count: int, after: ImageModes) -> Past:
        """What the first images of a window tell of the one after them.

        Args:
            found: motions of the window.
            count: images that are left behind.
            after: the image after these.
        """
        dynamics, evidence = self.dynamics, found.evidence
        d = dynamics.dimension
        stamps = found.trajectories.stamps_ns
        assert stamps is not None
        times = [*stamps[:count], after.stamp_ns]
        if found.first is None:
            means = np.zeros((len(found.fresh), dynamics.state_dimension))
            covariances = dynamics.states(evidence.covariances[:, 0])
        else:
            means, covariances = found.first.means, found.first.covariances
        for t in range(count):
            seen, spread = evidence.means[:, t], evidence.covariances[:, t]
            gains = solve(covariances[:, :d, :d] + spread, covariances[:, :d])
            gains = gains.swapaxes(1, 2)
            means = means + product(gains, (seen - means[:, :d])[:, :, None])[:, :, 0]
            covariances = covariances - product(gains, covariances[:, :d])
            if t == 0:
                means[found.fresh] = dynamics.initial_mean
                means[found.fresh, :d] = seen[found.fresh]
                covariances[found.fresh] = dynamics.states(spread[found.fresh])
            interval = (times[t + 1] - times[t]) / SECOND_NS
            means, covariances = dynamics.predict(means, covariances, interval)
            livelier = found.liveliness[:, None, None] - 1.0
            covariances = covariances + livelier * dynamics.transition(interval)[1]
            covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
        shares = (
            found.shares[count]
            if count < len(stamps)
            else product(after.link.origins, found.shares[-1])
        )
        places = self.points_of(found.trajectories.means[:, count - 1])
        return Past(shares, FirstStates(means, covariances, found.liveliness), places)


def _shares(nodes: Index, weights: Array, labels: Index, count: int, masses: Array) -> Array:
    """Probability (K, M) that each mode of an image belongs to each motion; unvisited: as any."""
    result = np.zeros((count, len(masses)))
    np.add.at(result, (nodes, labels), weights)
    result[~result.any(1)] = masses
    return np.asarray(result / result.sum(1, keepdims=True))


def _conditioned(
    prior: ChainPrior, precisions: Array, means: Array, resting: RestingTable | None = None
) -> tuple[Array, BlockCholesky]:
    """States (T, n) given Gaussians over poses, and the factor of their precision.

    Args:
        precisions, means: (T, d, d) and (T, d) of the Gaussians.

    Raises:
        NotPositiveDefiniteError: the precision of the states is not.
    """
    (times, d), n = means.shape, len(prior.pull)
    columns, states = np.empty((times * n, 2 * n)), np.empty((times, n))
    held = RestingTable.none(times, d) if resting is None else resting
    done = condition_chain(prior, precisions, means, held, columns, states)
    if done < len(columns):
        raise NotPositiveDefiniteError(
            f'the precision of {times} states is not positive definite: pivot {done + 1} of '
            f'{len(columns)}'
        )
    return states, BlockCholesky(columns, times, n, last_first=True)
