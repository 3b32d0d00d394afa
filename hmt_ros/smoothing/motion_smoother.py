"""Smoothing of motions: states from the evidence of the images (VMS 5, in closed form).

    E(X) = |x_1 - m_1|^2_(P_1) / 2 + sum_t |x_(t+1) - A x_t|^2_(l_t Q) / 2
           + sum_t |x_t - z_t|^2_(R_t) / 2

z_t and R_t are the mean and covariance of the motion's modes in an image (`motions`), N(m_1, P_1)
is the prediction of the first state from the motion's past. l_t scales the noise of the motion
prior; it is the smallest of 1, 4, 16, 64 that keeps the states close to the motion's modes. An
image whose modes are far from the states is an outlier and gets a low weight. A prediction from the
past that is far from all modes of its motion is ignored. E is quadratic with a block-tridiagonal
Hessian; states are clipped to the limits.
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
from hmt_ros.inference.error_model import JOINT_COVARIANCE_RATIO, CueErrors
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
    SAME_MOTION_DISTANCE,
    SECOND_NS,
    MotionEvidence,
    evidence_of_motions,
    grouped,
    path_distances,
)
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture
from hmt_ros.smoothing.trajectory_refinement import limits_of_states

# Number of paths drawn from the chain of modes.
PATH_SAMPLES = 96
# Values of l, and the median distance from the modes above which the next value is tried, m.
NOISE_FACTORS, MAX_MEDIAN_DISTANCE = (1.0, 4.0, 16.0, 64.0), 0.05
# Distance between an image's modes and the states above which the image is an outlier, m, and
# maximum number of passes that reduce weights of outliers.
WRONG_DISTANCE, MAX_WRONG_PASSES = 0.15, 3
# Distance from all motions above which a mode is a stray, m.
STRAY_DISTANCE = 0.05
# Minimum weight of a motion in a window of several images, and of a motion whose resting points are
# fixed.
MIN_WEIGHT, MIN_RESTING_WEIGHT = 0.03, 0.1


class ImageModes(NamedTuple):
    """The output of a filter for one image.

    Attributes:
        stamp_ns: stamp of the image, ns.
        link: posterior weights and ancestry of the K modes.
        mixture: the undiscounted likelihood of the image, K components; weights are not used.
        errors: model of the errors that persist from image to image.
    """

    stamp_ns: int
    link: Link
    mixture: GaussianMixture
    errors: CueErrors


class WindowImage(NamedTuple):
    """An image of a window.

    Attributes:
        modes: the modes of the image.
        counted: the likelihood, with covariances that account for persistent errors.
        points: (K, P, 3) points of the modes, m.
        persistence_ratio: factor on the posterior variance, for errors that persist from image to
            image.
        alone: factor on the covariances of modes that belong to no motion.
    """

    modes: ImageModes
    counted: GaussianMixture
    points: Array
    persistence_ratio: float
    alone: float


class FirstStates(NamedTuple):
    """Gaussian prediction of the first states of M motions of a window.

    Attributes:
        means, covariances: (M, n) and (M, n, n) means and covariances of the states.
        noise_factor: (M,) noise factor l of each motion's predecessor.
    """

    means: Array
    covariances: Array
    noise_factor: Array


class Past(NamedTuple):
    """Prediction for the first image of a window, from earlier images.

    Attributes:
        shares: (K, M) probability that a mode of the image continues each of M earlier motions.
        first: predicted first state of each of these motions.
        places: (M, P, 3) points of the motions in the previous image, m.
    """

    shares: Array
    first: FirstStates
    places: Array


class ChainPrior(NamedTuple):
    """Prior of the states, as input of the compiled core.

    Attributes:
        before, after, forth, which: fields of `Couplings`.
        shares: (T-1,) 1 / l.
        known: (n, n) P_1^-1.
        pull: (n,) P_1^-1 m_1.
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
        states: (T, n) smoothed states.
        factor: Cholesky factor of the precision of the states.
        log_joint: log p(X, R) with Gaussian likelihoods of the images.
        noise_factor: noise factor l.
        precision_factors: (T,) factor on the precision of each image's evidence.
        fresh: whether the prediction from the past is ignored.
    """

    states: Array
    factor: BlockCholesky
    log_joint: float
    noise_factor: float
    precision_factors: Array
    fresh: bool


class SmoothedMotions(NamedTuple):
    """The motions of a window.

    Attributes:
        trajectories: the M trajectories.
        shares: T arrays (K_t, M), probability that a mode belongs to each motion.
        evidence: evidence of the images; outlier images have larger covariances.
        noise_factor: (M,) noise factor l.
        fresh: (M,) whether the prediction from the past is ignored for a motion.
        first: prediction from the past; None: no past.
    """

    trajectories: TrajectoryMixture
    shares: list[Array]
    evidence: MotionEvidence
    noise_factor: Array
    fresh: Mask
    first: FirstStates | None


@dataclass(frozen=True, eq=False)
class MotionSmoother:
    """Smooths the modes of a filter's chain.

    Attributes:
        dynamics: dynamics of the state.
        lower, upper: (d,) limits of the pose at every time; None: no limits.
        points: maps poses (N, d) to points (N, P, 3), m, for the comparison of motions; None: the
            variables of the pose are compared.
        max_motions: maximum number of motions.
        resting: model of points that can rest on the ground; None: not used.
        seed: random seed for drawing paths.

    Raises:
        ValueError: a setting is out of range.
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
        """Prepare an image of a window; `before_ns`: previous stamp, or None for the first image.

        Raises:
            ValueError: the modes can not be smoothed, or the stamp does not increase.
        """
        if before_ns is not None and modes.stamp_ns <= before_ns:
            raise ValueError(
                f'stamps must increase, saw {modes.stamp_ns} ns after {before_ns} ns; begin again '
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
        alone = JOINT_COVARIANCE_RATIO / modes.errors.share(dt)
        return WindowImage(modes, counted, points, modes.errors.persistence_ratio(dt), alone)

    def smooth(self, sequence: Sequence[ImageModes]) -> TrajectoryMixture:
        """The trajectories of a whole sequence; see `motions`."""
        return self.motions(sequence).trajectories

    def motions(self, sequence: Sequence[ImageModes]) -> SmoothedMotions:
        """The motions of a whole sequence.

        Raises:
            ValueError: there are no images, stamps do not increase, or modes can not be smoothed.
        """
        if not sequence:
            raise ValueError('no images to smooth')
        stamps = [None, *(modes.stamp_ns for modes in sequence)]
        images = [self.image(modes, before) for modes, before in zip(sequence, stamps)]
        return self.smoothed(images)

    def smoothed(self, images: Sequence[WindowImage], past: Past | None = None) -> SmoothedMotions:
        """Estimate the motions in the images of a window."""
        stamps = [image.modes.stamp_ns for image in images]
        links = [image.modes.link for image in images]
        nodes, weights = drawn_paths(links, PATH_SAMPLES, self.seed)
        points = [image.points for image in images]
        before = None if past is None else past.places[past.shares[nodes[:, 0]].argmax(1)]
        distances = path_distances(nodes, points, stamps, before)
        least = MIN_WEIGHT if len(images) > 1 else 0.0
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
            self._states(intervals, couplings, evidence, first, m, masses[m] >= MIN_RESTING_WEIGHT)
            for m in range(len(masses))
        ]
        precision_factors = np.array([one.precision_factors for one in found])
        evidence = evidence._replace(
            covariances=evidence.covariances / precision_factors[:, :, None, None]
        )
        low, high = self.limits()
        d = self.dynamics.dimension
        states = np.clip([one.states for one in found], low, high)
        trajectories = TrajectoryMixture(
            weights=masses / masses.sum(),
            states=states,
            factors=tuple(one.factor for one in found),
            inflation=np.full(
                len(masses), np.sqrt(np.mean([image.persistence_ratio for image in images]))
            ),
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
        noise_factor = np.array([one.noise_factor for one in found])
        fresh = np.array([one.fresh for one in found])
        return SmoothedMotions(trajectories, shares, evidence, noise_factor, fresh, first)

    def _with_weights_in_time(
        self, found: TrajectoryMixture, images: Sequence[WindowImage], shares: Sequence[Array]
    ) -> TrajectoryMixture:
        """Add weights at each time: sums over the modes nearest to each trajectory."""
        smoothed = backward_weights([image.modes.link for image in images])
        every = self.points_of(found.means).swapaxes(0, 1)
        weights, strays = np.zeros((found.times, len(found))), []
        for t, (image, own, places) in enumerate(zip(images, smoothed, every, strict=True)):
            away = mean_distances(image.points[:, None], places)
            nearest = away.min(1, keepdims=True)
            parts = np.where(
                away <= nearest + SAME_MOTION_DISTANCE / 2, shares[t] + 1e-6 * found.weights, 0
            )
            stray = nearest[:, 0] > STRAY_DISTANCE
            parts *= np.where(stray, 0.0, own / parts.sum(1))[:, None]
            weights[t], alone = parts.sum(0), np.flatnonzero(stray & (own > 0.0))
            modes = image.modes.mixture[alone]
            strays.append(GaussianMixture(own[alone], modes.means, image.alone * modes.covariances))
        return replace(found, weights_in_time=weights, strays=tuple(strays))

    def _first(self, past: Past, nodes: Index, weights: Array, labels: Index) -> FirstStates:
        """Predict the first state of each motion as an average over the motion's paths."""
        shares = np.zeros((int(labels.max()) + 1, past.shares.shape[1]))
        np.add.at(shares, labels, weights[:, None] * past.shares[nodes])
        shares /= shares.sum(1, keepdims=True)
        means = product(shares, past.first.means)
        offsets = past.first.means - means[:, None]
        covariances = np.einsum('mk,kij->mij', shares, past.first.covariances)
        covariances += product((offsets * shares[:, :, None]).swapaxes(1, 2), offsets)
        return FirstStates(means, covariances, past.first.noise_factor[shares.argmax(1)])

    def _states(
        self,
        intervals: Array,
        couplings: Couplings,
        evidence: MotionEvidence,
        first: FirstStates | None,
        m: int,
        held: bool,
    ) -> MotionStates:
        """Compute the states of motion m; `held`: whether to fix the motion's resting points."""
        dynamics, d = self.dynamics, self.dynamics.dimension
        means, precisions = evidence.means[m], inverse(evidence.covariances[m])
        places, precision_factors = self.points_of(means), np.ones(len(means))
        at, known, least = dynamics.initial_mean, dynamics.initial_precision, NOISE_FACTORS[0]
        fresh = first is None
        if first is not None and self.points is not None:
            before = self.points_of(first.means[m, :d])
            fresh = bool(mean_distances(before, places).min() > WRONG_DISTANCE)
        if first is not None and not fresh:
            at, known = first.means[m], inverse(first.covariances[m])
            least = first.noise_factor[m] / NOISE_FACTORS[1]
        known = 0.5 * (known + known.T)
        pull_of_first = product(known, at)
        for noise_factor in (x for x in NOISE_FACTORS if x >= least):
            noise = np.full(len(intervals), noise_factor)
            prior = ChainPrior(*couplings[:4], 1.0 / noise, known, pull_of_first)
            states, factor = _conditioned(prior, precisions, means)
            away = self._away(states, places)
            if self.points is None or np.median(away) <= MAX_MEDIAN_DISTANCE:
                break
        for _ in range(MAX_WRONG_PASSES):
            wrong = away > WRONG_DISTANCE
            if self.points is None or not wrong.any():
                break
            precision_factors = np.where(wrong, (MAX_MEDIAN_DISTANCE / away) ** 2, 1.0)
            states, factor = _conditioned(
                prior, precisions * precision_factors[:, None, None], means
            )
            away = self._away(states, places)
        precisions = precisions * precision_factors[:, None, None]
        pull = product(precisions, means[:, :, None])[:, :, 0]
        seen = 0.5 * ((means * pull).sum() - log_determinant(precisions).sum())
        seen += 0.5 * product(at, pull_of_first) + couplings.constant(noise)
        gained = 0.5 * (product(states[0], pull_of_first) + (states[:, :d] * pull).sum())
        if held and self.resting is not None and len(states) > 1:
            # Covariances ignore resting points, because whether a point rests is one decision for
            # all images.
            poses = np.clip(states, *self.limits())[:, :d]
            resting = self.resting.along(poses, evidence.covariances[m], intervals)
            if resting is not None:
                states = _conditioned(prior, precisions, means, resting)[0]
        return MotionStates(
            states, factor, float(gained - seen), noise_factor, precision_factors, fresh
        )

    def _away(self, states: Array, places: Array) -> Array:
        """Mean distances (T,) between the points of states (T, n) and points (T, P, 3), m."""
        poses = np.clip(states, *self.limits())[:, : self.dynamics.dimension]
        return np.asarray(mean_distances(self.points_of(poses), places))

    def past_after(self, found: SmoothedMotions, count: int, after: ImageModes) -> Past:
        """Predict the next image from the images that leave a window.

        Args:
            found: the motions of the window.
            count: number of images that leave the window.
            after: modes of the image that follows the leaving images.
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
            extra_noise = found.noise_factor[:, None, None] - 1.0
            covariances = covariances + extra_noise * dynamics.transition(interval)[1]
            covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
        shares = (
            found.shares[count]
            if count < len(stamps)
            else product(after.link.origins, found.shares[-1])
        )
        places = self.points_of(found.trajectories.means[:, count - 1])
        return Past(shares, FirstStates(means, covariances, found.noise_factor), places)


def _shares(nodes: Index, weights: Array, labels: Index, count: int, masses: Array) -> Array:
    """Return probabilities (K, M) that a mode of an image belongs to each motion."""
    result = np.zeros((count, len(masses)))
    np.add.at(result, (nodes, labels), weights)
    result[~result.any(1)] = masses
    return np.asarray(result / result.sum(1, keepdims=True))


def _conditioned(
    prior: ChainPrior, precisions: Array, means: Array, resting: RestingTable | None = None
) -> tuple[Array, BlockCholesky]:
    """Return states (T, n) given Gaussians over poses, and the Cholesky factor of their precision.

    Args:
        precisions, means: (T, d, d) and (T, d) of the Gaussians over poses.

    Raises:
        NotPositiveDefiniteError: the precision of the states is not positive definite.
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
