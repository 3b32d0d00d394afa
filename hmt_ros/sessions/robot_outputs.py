"""Outputs for robots: forecasts of the pose, and the space that a robot must keep out of.

Both are computed from the last image that showed the person. While the track is lost or no image
arrives, the space grows as fast as people move. It becomes free only when an image shows that
nobody is in view. All times are based on stamps, so that the same images give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.keep_out import Capsules, keep_out_capsules, reach_after
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.linear_algebra import product
from hmt_ros.sessions.fixed_frame import FixedFrame
from hmt_ros.sessions.focal_length import with_depth_error
from hmt_ros.tracking.prediction import Forecaster
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.keep_out import KeepOut, KeepOutState
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, TrackState

# Maximum time from the newest image to a forecast, s, as the person may be anywhere afterwards.
MAX_FORECAST_TIME = 10.0
# Maximum number of forecasts per image; after a long gap the earliest forecasts are omitted.
MAX_FORECASTS = 100


@dataclass(frozen=True, eq=False)
class LastSeen:
    """State of a track at the last image that showed the person; immutable.

    Attributes:
        stamp_ns, frame_id: stamp of the image, ns, and frame of the camera.
        body: body of the track.
        posterior: posterior over poses, in the frame of the camera.
        forecaster: forecaster of the track.
        fixed: frame of the outputs; None: the frame of the camera.
        probability: probability that the capsules contain the person.
        focal_length_sigma: relative standard deviation of the focal length; `posterior` already
            includes this error.
    """

    stamp_ns: int
    frame_id: str
    body: Body
    posterior: GaussianMixture
    forecaster: Forecaster
    fixed: FixedFrame | None
    probability: float
    focal_length_sigma: float = 0.0

    @cached_property
    def capsules(self) -> Capsules:
        """Capsules that contain the person, in the frame of the outputs."""
        held = keep_out_capsules(self.body, self.posterior, self.probability)
        if self.fixed is None:
            return held
        rotation, translation = self.fixed.camera
        return Capsules(
            product(held.starts, rotation.T) + translation,
            product(held.ends, rotation.T) + translation,
            held.radii,
        )


@dataclass(frozen=True)
class _NewestResult:
    """Result of the newest image; replaced as a whole, so that any thread may read it."""

    state: KeepOutState = KeepOutState.UNKNOWN
    stamp_ns: int = 0
    frame_id: str = ''
    track_id: int = 0
    existence: float = math.nan
    seen: LastSeen | None = None
    reason: str = ''


class RobotOutputs:
    """Makes the outputs for robots.

    `keep_out` and `forecast` are thread-safe; the estimating thread calls the other methods.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forgets all images."""
        self._told, self._forecast_until = _NewestResult(), 0

    def update(
        self,
        stamp_ns: int,
        frame_id: str,
        state: KeepOutState,
        track_id: int,
        existence: float,
        seen: LastSeen | None = None,
        reason: str = '',
    ) -> None:
        """Sets the result of the newest image.

        Args:
            stamp_ns, frame_id: stamp of the image, ns, and frame of the outputs.
            existence: probability that a person is in view; NaN: unknown.
            seen: state of the track, if the image shows the person; None: the last state is kept.
            reason: reason for the state, see `KeepOut`.
        """
        before = self._told.seen
        if state is KeepOutState.NOBODY:
            before = None
        elif state is KeepOutState.UNKNOWN and before is not None:
            # The track was dropped, but its person may still be there.
            state = KeepOutState.LOST
        self._told = _NewestResult(
            state, stamp_ns, frame_id, track_id, existence, seen or before, reason
        )

    def keep_out(self, probability: float, silence: float | None = None) -> KeepOut:
        """Return the space that robots must keep out of.

        Args:
            probability: probability that is reported if there are no capsules.
            silence: time since the outputs for the newest image were published, s; None: they are
                published now.
        """
        told = self._told
        seen, state, stamp, reason = told.seen, told.state, told.stamp_ns, told.reason
        if silence is not None:
            state, reason = KeepOutState.STALE, f'no image was answered for {silence:.1f} s'
            stamp += round(silence * SECOND_NS) if told.stamp_ns else 0
        none = Capsules(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
        held, unseen = none, math.nan
        if seen is not None:
            unseen = (stamp - seen.stamp_ns) / SECOND_NS
            held = seen.capsules.grown(reach_after(unseen))
            probability = seen.probability
        return KeepOut(
            stamp,
            told.frame_id,
            state,
            held.starts,
            held.ends,
            held.radii,
            told.track_id,
            told.existence,
            unseen,
            probability,
            reason,
        )

    def forecast(self, stamp_ns: int) -> PoseMixture:
        """Return the forecast of the pose at a time after the newest image.

        Raises:
            ValueError: nobody is tracked, or the time is before the newest image or more than
                `MAX_FORECAST_TIME` after it.
        """
        told = self._told
        seen = told.seen
        if seen is None:
            raise ValueError('nobody is tracked')
        if not told.stamp_ns <= stamp_ns <= told.stamp_ns + MAX_FORECAST_TIME * SECOND_NS:
            raise ValueError(
                f'the newest image is of {told.stamp_ns} ns; wanted a time from then to '
                f'{MAX_FORECAST_TIME:g} s later, saw {stamp_ns} ns'
            )
        mixture = with_depth_error(seen.forecaster.at(stamp_ns), seen.focal_length_sigma)
        body, frame = seen.body, seen.frame_id
        if seen.fixed is not None:
            mixture, _ = seen.fixed.placed(body, mixture)
            body = body.levelled(np.eye(3))
            frame = seen.fixed.optical
        tracking = told.state is KeepOutState.TRACKING
        return PoseMixture.of_body(
            body,
            mixture,
            MixtureKind.FORECAST,
            stamp_ns,
            frame,
            state=TrackState.TRACKING if tracking else TrackState.LOST,
            track_id=told.track_id,
            existence_probability=told.existence,
            identities=seen.forecaster.modes.identities,
        )

    def due(self, rate: float, horizon: float) -> Iterable[int]:
        """Return the forecast times, ns, that have come within the horizon since the last call.

        Args:
            rate: number of forecast times per second; 0: no forecasts.
            horizon: maximum time from an image to a forecast, s.
        """
        told = self._told
        if rate <= 0.0 or told.seen is None:
            return ()
        # Exact fractions: times since 1970 in ns are too large for products of floats.
        every = SECOND_NS / Fraction(rate).limit_denominator(1000)
        until = told.stamp_ns + round(horizon * SECOND_NS)
        last = int(until // every)
        first = int(max(self._forecast_until, told.stamp_ns) // every) + 1
        first = max(first, last + 1 - MAX_FORECASTS)
        self._forecast_until = max(until, self._forecast_until)
        return (math.ceil(k * every) for k in range(first, last + 1))
