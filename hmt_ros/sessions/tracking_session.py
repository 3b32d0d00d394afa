"""The common part of sessions that track one person or several: starts, transforms, answers.

- With `gravity_frame` or `fixed_frame` an image waits for the transforms of its stamp, or for an
  image or a transform that is `input_timeout` younger, and never so long that it would be dropped.
  Where they do not come, the gravity known before holds, and the camera is taken to go on as
  before.
- A camera_info with another calibration, and ~/reset, start the tracks anew.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, TypeVar

from hmt_ros.sessions.camera_frames import CameraFrames
from hmt_ros.sessions.camera_session import CameraSession, WaitingImage
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.handled import Fault, Output
from hmt_ros.sessions.session import NeededInput, SessionState
from hmt_ros.sessions.track_start import TrackStart, prepare_start
from hmt_ros.sessions.transform_buffer import TF_STATIC, TRANSFORMS
from hmt_ros.sessions.warm_up import warm_up_tracking
from msg_tools.messages.headers import time_ns

Parameters = TypeVar('Parameters', bound=FilterParameters)
State = TypeVar('State', bound=SessionState)


class TrackingSession(CameraSession[Parameters, State]):
    """Tracks the people before one camera; see `Session` for arguments and attributes.

    Attributes:
        start: of the tracks.
        frames: that transforms lead to from the camera.
        answered: number of images whose results went to the robot.
    """

    DONE = 'tracked'

    def _set_up(self) -> None:
        super()._set_up()
        p = self.parameters
        self.start = prepare_start(p)
        self.frames = CameraFrames(p.gravity_frame, p.fixed_frame, floor=p.floor_in_gravity_frame)
        self.answered = 0

    def prepare(self) -> None:
        """See `Session`."""
        warm_up_tracking()

    def restart(self, start: TrackStart | None = None) -> None:
        """Drops the tracks; new ones start with the images that follow.

        Args:
            start: of the new tracks; None: by the parameters.

        Raises:
            ValueError: the parameters name a file that can not be used; the tracks go on.
        """
        self.start = prepare_start(self.parameters) if start is None else start
        super().restart()

    @abstractmethod
    def stale(self, silence: float, answered: int) -> list[Output]:
        """Messages for a robot where no image is answered; may be called by any thread.

        Args:
            silence: time since the newest image was answered, s.
            answered: number of images that were answered; if it has risen, there are no messages.
        """

    def needed_inputs(self) -> list[NeededInput]:
        """Inputs that are needed at present; may be called by any thread."""
        needed = super().needed_inputs()
        if self.frames.wanted and not self.frames.heard:
            needed.append(NeededInput(TRANSFORMS))
        return needed

    def _take(self, source: str, message: Any, stamp: int) -> None:
        if source not in TRANSFORMS:
            super()._take(source, message, stamp)
        elif self.frames.wanted:
            for text in self.frames.take(message, static=source == TF_STATIC):
                self._log.note(Fault.TRANSFORM, text)

    def _stamp_of(self, source: str, message: Any) -> int:
        if source not in TRANSFORMS:
            return super()._stamp_of(source, message)
        return max((time_ns(each.header.stamp) for each in message.transforms), default=0)

    def _forget_inputs(self, stamp: int) -> None:
        super()._forget_inputs(stamp)
        self.frames.forget_after(stamp)

    def _start_anew(self) -> None:
        try:
            self.restart()
        except ValueError as error:
            self._log.fault(Fault.START, f'{error}; {self.ESTIMATE} starts as the time before')
            self._start_again()

    def _start_again(self) -> None:
        self.restart(self.start)

    def _waits_for_inputs(self) -> bool:
        return super()._waits_for_inputs() or self.frames.wanted

    def _is_ready(self, waiting: WaitingImage) -> bool:
        return super()._is_ready(waiting) and self._has_transforms(self.frames, waiting)

    def _look_at_frames(self, waiting: WaitingImage) -> None:
        """Looks up gravity and the pose of the camera at an image in the transforms."""
        for kind, text in self.frames.look(waiting.frame_id, waiting.stamp_ns):
            self._log.note(kind, text)
