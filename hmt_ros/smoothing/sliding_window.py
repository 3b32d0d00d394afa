"""Smoothing while observations arrive: a window of fixed lag.

The window contains the newest images. The evidence of earlier images is kept as a state for each
motion (`Past`), so that the cost per image does not depend on the length of the sequence. A pose
becomes final at the latest when its age relative to the newest pose is the lag plus the time
between two smoothings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import mean_distances
from hmt_ros.inference.mode_chain import Link
from hmt_ros.smoothing.motion_smoother import (
    ImageModes,
    MotionSmoother,
    Past,
    SmoothedMotions,
    WindowImage,
)
from hmt_ros.smoothing.motions import SAME_MOTION_DISTANCE, SECOND_NS
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture

# Assumed relative jitter of the intervals between poses.
INTERVAL_JITTER = 0.1


@dataclass(frozen=True, eq=False)
class FinalPose:
    """A pose that will not be revised.

    Attributes:
        stamp_ns: time of the pose, ns.
        trajectories: the M trajectories over the window that contains the pose.
        t: index of the pose in the window.
    """

    stamp_ns: int
    trajectories: TrajectoryMixture
    t: int

    @cached_property
    def mixture(self) -> GaussianMixture:
        """Density of the pose, K components: one for each trajectory, then the strays."""
        return self.trajectories.marginal(self.t)

    @property
    def velocities(self) -> Array | None:
        """Velocities (K, d) per second, 0 for strays; None if unknown."""
        velocities = self.trajectories.velocities
        if velocities is None:
            return None
        result = np.zeros_like(self.mixture.means)
        result[: len(velocities)] = velocities[:, self.t]
        return result

    @property
    def identities(self) -> tuple[int, ...]:
        """Identities (K,) of the trajectories; 0 for strays."""
        own = self.trajectories.identities
        return own + (0,) * (len(self.mixture) - len(own))


@dataclass(frozen=True, eq=False)
class WindowUpdate:
    """Result of a new observation.

    Attributes:
        trajectories: the mixture over the poses in the window; None: the window was not smoothed.
        final: poses that have become final, oldest first.
    """

    trajectories: TrajectoryMixture | None
    final: tuple[FinalPose, ...]


class SlidingWindow:
    """Smooths the modes of images as they arrive.

    Keeps the images of the window and the motions of the last smoothing. Deterministic: the same
    images in the same order give the same numbers.

    Args:
        fixed_lag: maximum age of a pose relative to the newest pose, s. A pose becomes final if it
            would exceed this age at the next image, expected after the same interval. 0: filtering;
            infinite: no pose is final before the end.
        every: minimum time between two smoothings, s; poses become final only in a smoothing.

    Attributes:
        next_identity: next unused identity.

    Raises:
        ValueError: the lag is negative or not a number.
    """

    def __init__(
        self,
        smoother: MotionSmoother,
        fixed_lag: float = 0.5,
        *,
        first_identity: int = 1,
        every: float = 0.0,
    ) -> None:
        if not fixed_lag >= 0:
            raise ValueError(f'fixed_lag must be a time that is not negative, saw {fixed_lag} s')
        self.smoother, self.fixed_lag = smoother, fixed_lag
        self.first_identity, self.every = first_identity, every
        self.reset()

    def reset(self) -> None:
        """Clear the window; the next image starts a new sequence."""
        self.next_identity = self.first_identity
        self._images: list[WindowImage] = []
        self._past: Past | None = None
        self._found: SmoothedMotions | None = None
        self._last: TrajectoryMixture | None = None
        # Number of final images, which are the oldest in the window.
        self._final = 0

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """Times of the images in the window."""
        return tuple(image.modes.stamp_ns for image in self._images)

    @property
    def links(self) -> tuple[Link, ...]:
        """The chain of the filter's modes in the window; see `backward_weights`."""
        return tuple(image.modes.link for image in self._images)

    def step(self, modes: ImageModes) -> WindowUpdate:
        """Add the modes of the next image.

        Raises:
            ValueError: the modes can not be smoothed, or the stamp does not increase; the window is
                unchanged.
        """
        stamp, stamps = int(modes.stamp_ns), self.stamps_ns
        image = self.smoother.image(modes, stamps[-1] if stamps else None)
        before = len(self._images[-1].modes.link.weights) if self._images else None
        if before is not None and modes.link.origins.shape[1:] != (before,):
            raise ValueError(
                f'origins have shape {modes.link.origins.shape}, wanted a column for each of '
                f'{before} modes of the image before'
            )
        self._drop_final_images(image)
        self._images.append(image)
        if not self._is_due((stamp - stamps[-1]) / SECOND_NS if stamps else 0.0):
            return WindowUpdate(None, ())
        found = self._smooth()
        self._final = self._number_of_final()
        if self._final:
            found = replace(found, final_until_ns=self.stamps_ns[self._final - 1])
        self._last = found
        return WindowUpdate(found, _final_poses(found, range(self._final)))

    def _drop_final_images(self, newest: WindowImage) -> None:
        """Remove final images from the window before the newest one is added."""
        if self._final:
            assert self._found is not None
            after = [*self._images, newest][self._final].modes
            self._past = self.smoother.past_after(self._found, self._final, after)
            del self._images[: self._final]
            self._final = 0

    def _is_due(self, interval: float) -> bool:
        """Whether to smooth the window now; `interval` is the time since the previous pose, s."""
        if self._last is None or self._last.stamps_ns is None:
            return True
        since = (self.stamps_ns[-1] - self._last.stamps_ns[-1]) / SECOND_NS
        return since >= self.every - INTERVAL_JITTER * interval

    def _number_of_final(self) -> int:
        """Return the number of final poses, which are the oldest of the window."""
        stamps = self.stamps_ns
        if self.fixed_lag == math.inf:
            return 0
        lag = round(self.fixed_lag * SECOND_NS)
        if lag == 0:
            return len(stamps)
        if len(stamps) < 2:
            return 0
        # Count poses that would be too old at the next image; the margin allows for jitter of
        # stamps.
        interval = stamps[-1] - stamps[-2]
        until = stamps[-1] + interval - lag - round(INTERVAL_JITTER * interval)
        return sum(stamp < until for stamp in stamps[:-1])

    def finish(self) -> tuple[FinalPose, ...]:
        """Return the remaining poses, which are now final, and clear the window."""
        last, stamps = self._last, self.stamps_ns
        if last is None or last.stamps_ns is None:
            return ()
        until = last.final_until_ns
        if last.stamps_ns[-1] != stamps[-1]:
            last = self._smooth()
        open_ones = [t for t, stamp in enumerate(stamps) if until is None or stamp > until]
        result = _final_poses(last, open_ones)
        self.reset()
        return result

    def _smooth(self) -> TrajectoryMixture:
        self._found = self.smoother.smoothed(self._images, self._past)
        found = self._found.trajectories
        return replace(found, identities=self._identities(found))

    def _identities(self, found: TrajectoryMixture) -> tuple[int, ...]:
        """Return identities of trajectories, inherited from predecessors in order of weight.

        A predecessor is a trajectory of the last smoothing that is closer than
        `SAME_MOTION_DISTANCE` and has no heavier successor. Among several, the one with the
        smallest ratio of distance to weight is chosen. A trajectory without a predecessor gets a
        new identity.
        """
        numbers = np.zeros(len(found), dtype=np.int64)
        away, before = self._distances(found)
        for i in np.argsort(-found.weights, kind='stable'):
            j = int(np.argmin(away[i])) if len(before) else -1
            if j >= 0 and away[i, j] < np.inf:
                numbers[i] = before[j]
                away[:, j] = np.inf
            else:
                numbers[i] = self.next_identity
                self.next_identity += 1
        return tuple(int(number) for number in numbers)

    def _distances(self, found: TrajectoryMixture) -> tuple[Array, tuple[int, ...]]:
        """Return distances (M, L) from the last smoothing's L trajectories, and their identities.

        A distance is the mean over points and common times, divided by the weight of the earlier
        trajectory. It is infinite if the mean exceeds `SAME_MOTION_DISTANCE`.
        """
        last = self._last
        common = 0 if last is None else len({*self.stamps_ns} & {*(last.stamps_ns or ())})
        if last is None or not common:
            return np.empty((len(found), 0)), ()
        now, before = (
            self.smoother.points_of(means)
            for means in (found.means[:, :common], last.means[:, -common:])
        )
        away = mean_distances(now[:, None], before).mean(2)
        return np.where(away <= SAME_MOTION_DISTANCE, away / last.weights, np.inf), last.identities


def _final_poses(found: TrajectoryMixture, indices: Sequence[int]) -> tuple[FinalPose, ...]:
    """The final poses at the given indices."""
    assert found.stamps_ns is not None
    return tuple(FinalPose(found.stamps_ns[t], found, t) for t in indices)
