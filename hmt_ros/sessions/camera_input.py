"""Images and calibration of one camera as they come in: checked, in the order of their stamps."""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Camera
from hmt_ros.sessions.handled import HandlingLog
from msg_tools.messages.camera_info import CameraInfoError, camera_from_info
from msg_tools.messages.images import ImageError, decode_image

CAMERA_INFO, IMAGE = 'camera_info', 'image'
FRAME_ID = 'camera_optical_frame'  # where neither image nor camera_info names a frame


class InTime(Enum):
    """How the stamp of an image relates to those before."""

    NEXT = 'next'
    SKIPPED = 'skipped'
    JUMP = 'jump'


class WaitingImage(NamedTuple):
    """An image that has come.

    Attributes:
        image: (H, W, 3) BGR.
        stamp_ns: of the image.
        frame_id: of the image, may be empty.
    """

    image: NDArray[np.uint8]
    stamp_ns: int
    frame_id: str


class CameraInput:
    """What comes from a camera, and what of it waits.

    Args:
        log: is told what can not be used, and counts images.
        restarted: what starts anew when time jumps back or the calibration changes, 'the track'.

    Attributes:
        camera: None: no calibrated camera_info has come.
        waiting: images, the oldest first.
        newest: stamp of the last image, ns; None: there was none.
    """

    def __init__(self, log: HandlingLog, restarted: str) -> None:
        self._log, self._restarted = log, restarted
        self._frame = ''
        self.camera: Camera | None = None
        self.waiting: deque[WaitingImage] = deque()
        self.newest: int | None = None

    def take_camera_info(self, message: Any) -> bool:
        """Takes a sensor_msgs/CameraInfo; whether it replaces another calibration."""
        try:
            camera = camera_from_info(message)
        except CameraInfoError as error:
            self._log.fault('camera_info', str(error))
            return False
        self._frame = str(message.header.frame_id)
        known, self.camera = self.camera, camera
        if known is None or camera == known:
            return False
        self._log.note('calibration', f'camera_info changes: {self._restarted} starts anew')
        return True

    def judge_stamp(self, stamp: int, reset_on_time_jump: bool) -> InTime:
        """Whether an image comes in time; it is counted, and told where it does not."""
        self._log.counts['received'] += 1
        newest = self.newest
        if newest is None or stamp > newest:
            return InTime.NEXT
        text = f'image of {stamp} ns comes after one of {newest} ns'
        if stamp == newest:
            self._log.skip('time stands still', f'{text}, wanted stamps that increase')
            return InTime.SKIPPED
        if not reset_on_time_jump:
            self._log.skip(
                'time jumps back',
                f'{text}: skipped; with reset_on_time_jump {self._restarted} would start anew',
            )
            return InTime.SKIPPED
        self._log.note('time jumps back', f'{text}: {self._restarted} starts anew')
        return InTime.JUMP

    def take_image(self, message: Any, stamp: int) -> None:
        """Takes a sensor_msgs/Image or CompressedImage that comes in time; it waits."""
        try:
            picture = decode_image(message)
        except ImageError as error:
            self._log.skip('image', str(error))
            return
        self.newest = stamp
        self.waiting.append(WaitingImage(picture, stamp, str(message.header.frame_id)))

    def fits(self, waiting: WaitingImage) -> bool:
        """Whether an image has the size that the camera gives; it is skipped otherwise."""
        assert self.camera is not None
        height, width = waiting.image.shape[:2]
        if (width, height) == (self.camera.width, self.camera.height):
            return True
        self._log.skip(
            'size of the image',
            f'image has {width}x{height} pixels, wanted the {self.camera.width}x'
            f'{self.camera.height} of camera_info',
        )
        return False

    def frame_of(self, waiting: WaitingImage) -> str:
        """The optical frame of an image."""
        return waiting.frame_id or self._frame or FRAME_ID

    def drop_excess(self, queue_size: int) -> list[WaitingImage]:
        """Drops the oldest images where too many wait.

        Returns:
            Those that did not wait for a camera: the owner knows what for.
        """
        known = []
        while len(self.waiting) > queue_size:
            dropped = self.waiting.popleft()
            self._log.counts['dropped'] += 1
            if self.camera is None:
                # An uncalibrated camera_info has been told already.
                self._log.fault(
                    'camera_info',
                    f'image of {dropped.stamp_ns} ns is dropped: it waited for a calibrated '
                    'camera_info',
                )
            else:
                known.append(dropped)
        return known

    def forget_images(self) -> None:
        """Time begins anew; images that still wait are dropped."""
        self._log.counts['dropped'] += len(self.waiting)
        self.waiting.clear()
        self.newest = None
