"""Smoothing while observations arrive: a window of fixed lag.

The window holds the newest poses, and the probable paths through their modes, which are filtered
one by one (`path_hypotheses`). The states of these paths at its first time stand for all images
before: the window is smoothed with their density in the place of the first likelihood, so that a
new image costs the same however long the sequence is. A pose is final before it is older than the
newest one by more than the lag, and the time between two smoothings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.smoothing.likelihood import MixtureLikelihood
from hmt_ros.smoothing.mixture_smoother import MixtureSmoother, intervals_of
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.path_hypotheses import SAME_MOTION, FilteredPaths
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture

SECOND_NS = 10**9
# Intervals between poses vary by this share of their length.
TREMBLE = 0.1


@dataclass(frozen=True, eq=False)
class FinalPose:
    """A pose that will not be revised.

    Attributes:
        stamp_ns: its time.
        trajectories: of the window, M.
        t: its index in the window.
    """

    stamp_ns: int
    trajectories: TrajectoryMixture
    t: int

    @property
    def mixture(self) -> GaussianMixture:
        """Its density, a component for each trajectory of the window."""
        return self.trajectories.marginal(self.t)

    @property
    def velocities(self) -> Array | None:
        """(M, d) per second; None: unknown."""
        velocities = self.trajectories.velocities
        return None if velocities is None else velocities[:, self.t]

    @property
    def identities(self) -> tuple[int, ...]:
        """(M,) of the trajectories."""
        return self.trajectories.identities


@dataclass(frozen=True, eq=False)
class WindowUpdate:
    """Result of a new observation.

    Attributes:
        trajectories: the mixture over the poses in the window; None: it was not smoothed.
        final: poses that have become final, oldest first.
    """

    trajectories: TrajectoryMixture | None
    final: tuple[FinalPose, ...]


class SlidingWindow:
    """Smooths likelihood mixtures as they arrive.

    Keeps the window's mixtures, the paths through them, and the trajectories found last. The same
    observations in the same order give the same numbers.

    Args:
        fixed_lag: time by which a pose is older than the newest one at most when it is final, s:
            the next one, expected after the same interval as the last, would make it older.
            0 is filtering; infinite: nothing is final before the end.
        every: least time between two smoothings, s; poses that become final meanwhile wait for
            the next.

    Attributes:
        next_identity: number that no trajectory has had.

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
        every: float = 0.0,
    ) -> None:
        if not fixed_lag >= 0:
            raise ValueError(f'fixed_lag must be a time that is not negative, saw {fixed_lag} s')
        self.smoother, self.fixed_lag, self.seed = smoother, fixed_lag, seed
        self.first_identity, self.every = first_identity, every
        self.reset()

    def reset(self) -> None:
        """Forgets everything; the next observation is the first."""
        self.next_identity = self.first_identity
        self._stamps: list[int] = []
        self._mixtures: list[GaussianMixture] = []
        # The same of each mixture.
        self._likelihoods: list[MixtureLikelihood] = []
        smoother = self.smoother
        self._paths = FilteredPaths(smoother.dynamics, smoother.max_trajectories, smoother.points)
        self._lasting: list[float] = []
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
        interval = (int(stamp_ns) - self._stamps[-1]) * 1e-9 if self._stamps else 0.0
        self._paths.add(mixture, interval)
        self._stamps.append(int(stamp_ns))
        self._mixtures.append(mixture)
        self._likelihoods.append(likelihood)
        self._lasting.append(lasting)
        for _ in range(self._final):
            self._advance()
        self._final = 0
        if not self._is_due(interval):
            return WindowUpdate(None, ())
        found = self._smooth()
        self._final = self._number_of_final()
        if self._final:
            found = replace(found, final_until_ns=self._stamps[self._final - 1])
        self._last = found
        return WindowUpdate(found, _final_poses(found, range(self._final)))

    def _is_due(self, interval: float) -> bool:
        """Whether the window is smoothed now, an interval after the pose before, s."""
        if self._last is None or self._last.stamps_ns is None:
            return True
        since = (self._stamps[-1] - self._last.stamps_ns[-1]) / SECOND_NS
        return since >= self.every - TREMBLE * interval

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
        last, stamps = self._last, self._stamps
        if last is None or last.stamps_ns is None:
            return ()
        until = last.final_until_ns
        if last.stamps_ns[-1] != stamps[-1]:
            last = self._smooth()
        open_ones = [t for t, stamp in enumerate(stamps) if until is None or stamp > until]
        result = _final_poses(last, open_ones)
        self.reset()
        return result

    def _advance(self) -> None:
        """Takes the oldest pose out."""
        for every in (self._stamps, self._mixtures, self._likelihoods, self._lasting):
            del every[0]
        self._paths.advance()

    def _smooth(self) -> TrajectoryMixture:
        smoother, dynamics = self.smoother, self.smoother.dynamics
        intervals = intervals_of(self._stamps, len(self._stamps), dynamics.step)
        known = MixtureLikelihood.joined(self._likelihoods[1:]) if len(self._stamps) > 1 else None
        first = self._paths.steps[0].states
        sequence = ModeSequence(
            tuple(self._mixtures[1:]), dynamics, intervals, first, known, self._paths
        )
        found = smoother.smooth_sequence(sequence, self.seed, self._stamps)
        found = found.widened(sum(self._lasting) / len(self._lasting))
        return replace(found, identities=self._identities(found))

    def _identities(self, found: TrajectoryMixture) -> tuple[int, ...]:
        """Identities of trajectories, given heaviest first; each has that of its predecessor.

        The predecessor is the nearest trajectory of the window before without a heavier successor,
        if no point of it is farther away than `SAME_MOTION`; without one it is a new motion.
        """
        numbers = np.zeros(len(found), dtype=np.int64)
        away, before = self._distances(found)
        for i in np.argsort(-found.weights, kind='stable'):
            j = int(np.argmin(away[i])) if len(before) else -1
            if j >= 0 and away[i, j] <= SAME_MOTION:
                numbers[i] = before[j]
                away[:, j] = np.inf
            else:
                numbers[i] = self.next_identity
                self.next_identity += 1
        return tuple(int(number) for number in numbers)

    def _distances(self, found: TrajectoryMixture) -> tuple[Array, tuple[int, ...]]:
        """Distances (M, L) from the L trajectories found last, and their identities.

        They are those of the point farthest away, in the mean over the times of both windows.
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
    assert found.stamps_ns is not None
    return tuple(FinalPose(found.stamps_ns[t], found, t) for t in indices)
