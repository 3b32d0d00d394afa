"""Smoothing while observations arrive: a window of fixed lag.

The window holds the newest poses. What came before it is a density of its first state, a mixture
that is filtered in closed form. Of all pairs of its components i and modes k of the likelihood the
next one has the component

    w_i w_k N(x; A m_i, A S_i A' + Q) N(C x; mu_k, S_k)

where C takes the pose out of the state. The window is smoothed with that density in the place of
the first likelihood, so that a new image costs the same however long the sequence is. A pose is
final before it is older than the newest one by more than the lag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.gaussian_pairs import pair_log_densities
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.reduction import led, merged_if_alike
from hmt_ros.smoothing.embedded_network import EmbeddedNetwork, embedded_network
from hmt_ros.smoothing.likelihood import MixtureLikelihood
from hmt_ros.smoothing.mixture_smoother import SAME_MOTION, MixtureSmoother, intervals_of
from hmt_ros.smoothing.mode_sequence import KnownModes, ModeSequence
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture

SECOND_NS = 10**9
# Components with a share below exp(-25) are given up, and those are merged whose means lie within
# this many standard deviations, and whose sizes are alike.
NEGLIGIBLE = 25.0
MERGE_DISTANCE = 0.6
MERGE_LOG_DETERMINANT = 0.5
# Intervals between poses tremble by this share of their length.
TREMBLE = 0.1


@dataclass(frozen=True, eq=False)
class FinalPose:
    """The density of a pose that will not be revised.

    Attributes:
        stamp_ns: its time.
        mixture: its marginal, a component for each trajectory of the window.
        velocities: (M, d) of the components, per second; None: unknown.
        identities: (M,) of the trajectories.
    """

    stamp_ns: int
    mixture: GaussianMixture
    velocities: Array | None
    identities: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class WindowUpdate:
    """What a new observation changes.

    Attributes:
        trajectories: the mixture over the poses in the window.
        final: poses that have become final, oldest first.
    """

    trajectories: TrajectoryMixture
    final: tuple[FinalPose, ...]


class SlidingWindow:
    """Smooths likelihood mixtures as they arrive.

    Keeps the window's mixtures, the density of the state at its beginning, and the trajectories
    found last. The same observations in the same order give the same numbers.

    Args:
        smoother: how a window is smoothed.
        fixed_lag: time by which a pose is older than the newest one at most when it is final, s:
            the next one, expected as long after the last as that after the one before, would make
            it older. 0 is filtering; infinite: nothing is final before the end.
        seed: of all randomness.
        first_identity: of the first trajectory.

    Attributes:
        next_identity: that no trajectory has had.

    Raises:
        ValueError: a lag that is negative or not a number.
    """

    def __init__(
        self,
        smoother: MixtureSmoother,
        fixed_lag: float = 0.5,
        seed: int = 0,
        *,
        first_identity: int = 1,
    ) -> None:
        if not fixed_lag >= 0:
            raise ValueError(f'fixed_lag must be a time that is not negative, saw {fixed_lag} s')
        self.smoother, self.fixed_lag, self.seed = smoother, fixed_lag, seed
        self.first_identity = first_identity
        self.reset()

    def reset(self) -> None:
        """Forgets everything; the next observation is the first."""
        self.next_identity = self.first_identity
        self._stamps: list[int] = []
        self._mixtures: list[GaussianMixture] = []
        # The same of each mixture, and the network of all of them: they stay while it moves on.
        self._likelihoods: list[MixtureLikelihood] = []
        self._lasting: list[float] = []
        self._network: EmbeddedNetwork | None = None
        self._first: GaussianMixture | None = None
        self._last: TrajectoryMixture | None = None
        # Poses of the window, the oldest, that are final already.
        self._final = 0

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """Times of the poses in the window."""
        return tuple(self._stamps)

    def step(self, stamp_ns: int, mixture: GaussianMixture, lasting: float = 1.0) -> WindowUpdate:
        """Takes the likelihood of the next pose.

        Args:
            stamp_ns: its time, after that of the one before.
            mixture: its likelihood; weights need not sum to 1.
            lasting: factor on the covariances of the result, because errors last, see `counted`;
                of the poses of a window the mean counts.

        Raises:
            ValueError: a mixture that can not be smoothed, or a stamp that does not increase; the
                window is as it was.
        """
        dynamics = self.smoother.dynamics
        likelihood = MixtureLikelihood.of([mixture])
        if mixture.dimension != dynamics.dimension:
            raise ValueError(
                f'the mixture has {mixture.dimension} variables, the dynamics {dynamics.dimension}'
            )
        if self._stamps and stamp_ns <= self._stamps[-1]:
            raise ValueError(
                f'stamps must increase, saw {stamp_ns} ns after {self._stamps[-1]} ns; reset the '
                'window to go back'
            )
        mixture = mixture[mixture.weights > 0]
        if self._first is None:
            self._first = first_state(mixture, dynamics)
        if self._network is None:
            self._network = embedded_network([mixture], dynamics, np.empty(0))
        else:
            interval = (int(stamp_ns) - self._stamps[-1]) * 1e-9
            self._network = self._network.followed_by(
                mixture, self._mixtures[-1], dynamics, interval
            )
        self._stamps.append(int(stamp_ns))
        self._mixtures.append(mixture)
        self._likelihoods.append(likelihood)
        self._lasting.append(lasting)
        for number in range(1, self._final + 1):
            self._advance(number)
        found = self._smooth()
        self._final = self._number_of_final()
        if self._final:
            found = replace(found, final_until_ns=self._stamps[self._final - 1])
        self._last = found
        return WindowUpdate(found, _final_poses(found, range(self._final)))

    def _number_of_final(self) -> int:
        """How many poses of the window, the oldest, are not to be revised."""
        stamps = self._stamps
        if self.fixed_lag == math.inf:
            return 0
        lag = round(self.fixed_lag * SECOND_NS)
        if lag == 0:
            return len(stamps)
        if len(stamps) < 2:
            return 0
        # Until the next pose comes they would grow too old; stamps tremble.
        interval = stamps[-1] - stamps[-2]
        until = stamps[-1] + interval - lag - round(TREMBLE * interval)
        return sum(stamp < until for stamp in stamps[:-1])

    def finish(self) -> tuple[FinalPose, ...]:
        """The poses that are still open, as final as they will be, and forgets everything."""
        last = self._last
        if last is None or last.stamps_ns is None:
            return ()
        until = last.final_until_ns
        stamps = enumerate(last.stamps_ns)
        result = _final_poses(last, [t for t, stamp in stamps if until is None or stamp > until])
        self.reset()
        return result

    def _advance(self, number: int) -> None:
        """Takes the oldest pose out: the density of the state moves on to the next one.

        Args:
            number: of the next one among the poses of the trajectories found last.
        """
        assert self._first is not None
        assert self._network is not None
        interval = (self._stamps[1] - self._stamps[0]) * 1e-9
        followed = None
        if self._last is not None and self._last.times > number:
            followed = (self._last.weights, self._last.states[:, number])
        self._first = filtered_state(
            self._first,
            self._mixtures[1],
            self.smoother.dynamics,
            interval,
            self.smoother.max_trajectories,
            followed,
            self.smoother.points,
        )
        del self._stamps[0], self._mixtures[0], self._likelihoods[0], self._lasting[0]
        self._network = self._network.later()

    def _smooth(self) -> TrajectoryMixture:
        assert self._first is not None
        assert self._network is not None
        smoother, dynamics = self.smoother, self.smoother.dynamics
        intervals = intervals_of(self._stamps, len(self._stamps), dynamics.step)
        known = None
        if len(self._mixtures) > 1:
            known = KnownModes(
                self._network.later(), MixtureLikelihood.joined(self._likelihoods[1:])
            )
        mixtures = tuple(self._mixtures[1:])
        sequence = ModeSequence(mixtures, dynamics, intervals, self._first, known)
        found = smoother.smooth_sequence(sequence, self.seed, self._stamps)
        found = found.widened(sum(self._lasting) / len(self._lasting))
        return replace(found, identities=self._identities(found))

    def _identities(self, found: TrajectoryMixture) -> tuple[int, ...]:
        """Of the trajectories of a window: the heaviest first, each that of what it continues.

        It continues the nearest trajectory of the window before that no heavier one continues, if
        no point of it is farther from it than `SAME_MOTION`; else it is a new motion.
        """
        numbers = np.zeros(len(found), dtype=np.int64)
        distances, before = self._distances(found)
        for i in np.argsort(-found.weights, kind='stable'):
            j = int(np.argmin(distances[i])) if len(before) else -1
            if j >= 0 and distances[i, j] <= SAME_MOTION:
                numbers[i] = before[j]
                distances[:, j] = np.inf
            else:
                numbers[i] = self.next_identity
                self.next_identity += 1
        return tuple(int(number) for number in numbers)

    def _distances(self, found: TrajectoryMixture) -> tuple[Array, tuple[int, ...]]:
        """Distances (M, L) from the L trajectories found last, and their identities.

        Of the point that is farthest away in the mean over the times that both windows have.
        """
        last = self._last
        common = 0 if last is None else len({*self._stamps} & {*(last.stamps_ns or ())})
        if last is None or not common:
            return np.empty((len(found), 0)), ()
        now, before = self._points(found.means[:, :common]), self._points(last.means[:, -common:])
        away = np.linalg.norm(now[:, None] - before, axis=-1)
        return away.mean(2).max(2), last.identities

    def _points(self, poses: Array) -> Array:
        """Points (M, T, P, 3) of poses (M, T, d)."""
        chosen = self.smoother.points or _variables
        points = chosen(poses.reshape(-1, poses.shape[2]))
        return points.reshape(*poses.shape[:2], *points.shape[1:])


def _variables(poses: Array) -> Array:
    """The variables (N, d, 1) of poses (N, d), each as a point on a line."""
    return poses[..., None]


def _final_poses(found: TrajectoryMixture, indices: Sequence[int]) -> tuple[FinalPose, ...]:
    """The poses at some indices."""
    stamps, velocities = found.stamps_ns, found.velocities
    assert stamps is not None
    return tuple(
        FinalPose(
            stamps[t],
            found.marginal(t, alone=len(indices) == 1),
            None if velocities is None else velocities[:, t],
            found.identities,
        )
        for t in indices
    )


def first_state(mixture: GaussianMixture, dynamics: LinearGaussianDynamics) -> GaussianMixture:
    """The density of the first state: its likelihood times what the dynamics know of it."""
    n, d = dynamics.state_dimension, dynamics.dimension
    precisions = np.zeros((len(mixture), n, n))
    precisions[:, :d, :d] = np.linalg.inv(mixture.covariances)
    pull = np.zeros((len(mixture), n))
    pull[:, :d] = np.einsum('kij,kj->ki', precisions[:, :d, :d], mixture.means)
    pull += dynamics.initial_precision @ dynamics.initial_mean
    covariances = np.linalg.inv(precisions + dynamics.initial_precision)
    covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
    means = np.einsum('kij,kj->ki', covariances, pull)
    log = np.log(mixture.weights)
    known = dynamics.initial_precision[:d, :d]
    if known.any():
        spread = np.asarray(np.linalg.inv(known), dtype=np.float64)
        pairs = np.stack([np.arange(len(mixture)), np.zeros(len(mixture), dtype=int)], axis=1)
        log = log + pair_log_densities(
            mixture.means, mixture.covariances, dynamics.initial_mean[None, :d], spread[None], pairs
        )
    return GaussianMixture(np.exp(log - logsumexp(log)), means, covariances)


def filtered_state(
    state: GaussianMixture,
    mixture: GaussianMixture,
    dynamics: LinearGaussianDynamics,
    interval: float,
    count: int,
    followed: tuple[Array, Array] | None = None,
    points: Callable[[Array], Array] | None = None,
) -> GaussianMixture:
    """The density of the next state given its likelihood, with at most `count` components.

        N(x; A m_i, A S_i A' + Q) N(C x; mu_k, S_k) w_i w_k, for all pairs i, k

    Pairs that tell the same are merged. Of the others those are kept that are apart, then those
    that the trajectories of the window follow, and then the heaviest.

    Args:
        state: before.
        mixture: the likelihood of the pose.
        dynamics: of the state.
        interval: s.
        count: components at most.
        followed: weights (M,) of trajectories and their states (M, n) at the new time.
        points: maps poses (N, d) to points (N, P, 3), m: half of the components, the heaviest such,
            have some point `SAME_MOTION` apart. None: none have to.
    """
    d = dynamics.dimension
    means, covariances = dynamics.predict(state.means, state.covariances, interval)
    pairs = np.indices((len(state), len(mixture))).reshape(2, -1).T
    log = pair_log_densities(
        means[:, :d], covariances[:, :d, :d], mixture.means, mixture.covariances, pairs
    )
    log += np.log(state.weights)[pairs[:, 0]] + np.log(mixture.weights)[pairs[:, 1]]
    order = np.argsort(-log, kind='stable')
    several = order[: 4 * count]
    several = several[log[several] > log[order[0]] - NEGLIGIBLE]
    if points is not None:
        # Of every mode the best pair, however light: the rest is what leads there otherwise.
        _, first = np.unique(pairs[order, 1], return_index=True)
        several = np.union1d(first, np.arange(len(several)))
        several = order[several]
    order = several
    i, k = pairs[order].T
    gain = np.linalg.solve(
        covariances[i][:, :d, :d] + mixture.covariances[k], covariances[i][:, :d, :]
    ).swapaxes(1, 2)
    fused = means[i] + np.einsum('pij,pj->pi', gain, mixture.means[k] - means[i][:, :d])
    # Joseph's form, (1 - G C) S (1 - G C)' + G R G', keeps them positive definite.
    before = covariances[i]
    kept = before - gain @ before[:, :d]
    spread = kept + (gain @ mixture.covariances[k] - kept[:, :, :d]) @ gain.swapaxes(1, 2)
    weights = np.exp(log[order] - logsumexp(log[order]))
    found = GaussianMixture(weights, fused, 0.5 * (spread + spread.swapaxes(1, 2)))
    found = merged_if_alike(found, MERGE_DISTANCE, MERGE_LOG_DETERMINANT)
    if len(found) <= count:
        return found.normalised()
    apart: Index = np.empty(0, dtype=np.intp)
    if points is not None:
        apart = led(found, points(found.means[:, :d]), SAME_MOTION, count // 2)[1]
    score = found.weights.copy()
    if followed is not None:
        each = found.component_log_densities(followed[1])
        share = np.exp(each - logsumexp(each, axis=1, keepdims=True))
        score += followed[0] @ share
    score[apart] = np.inf
    chosen = np.sort(np.argsort(-score, kind='stable')[:count])
    return found[chosen].normalised()
