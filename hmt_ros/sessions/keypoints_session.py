"""A detector of keypoints behind its topics: images in, keypoints of one person out.

- Every image that can be used gets one keypoints, one keypoints_3d and, with `publish_mask`, one
  mask, all with its stamp and frame. Messages without names, and a mask of zeros, say that nobody
  was seen.
- What can not be used is skipped. The first fault of each kind is logged; all are counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.camera_session import IMAGE
from hmt_ros.sessions.declared_parameters import (
    NEXT_CONFIGURE,
    ImageNodeParameters,
    check_choices,
    parameter_field,
)
from hmt_ros.sessions.image_inputs import KEYPOINTS, KEYPOINTS_3D, MASK
from hmt_ros.sessions.session import PublishedTopic, Session, SessionState
from msg_tools.messages import keypoints
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.images import ImageError, image_message
from msg_tools.messages.keypoints import keypoints_message, positions_message

TOPICS = {
    KEYPOINTS: PublishedTopic(keypoints.KEYPOINTS_2D),
    KEYPOINTS_3D: PublishedTopic(keypoints.KEYPOINTS_3D),
    MASK: PublishedTopic('sensor_msgs/msg/Image'),
}


@dataclass(frozen=True)
class KeypointsParameters(ImageNodeParameters):
    """All parameters of the keypoints node.

    Attributes:
        detector: Detector of keypoints; 'mediapipe' is MediaPipe Pose, 'mediapipe+movenet' asks
            MoveNet Thunder as well, at five times the cost.
        publish_mask: If true, the node also publishes the mask of the person.
    """

    detector: str = parameter_field(USUAL_DETECTOR, NEXT_CONFIGURE)
    publish_mask: bool = parameter_field(False, NEXT_CONFIGURE)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, detector=tuple(DETECTORS))


@dataclass(frozen=True)
class KeypointsState(SessionState):
    """State of the detection: its status is 'waiting', 'nobody' or 'detecting'.

    Of the counts 'detected' are images with or without somebody, 'empty' those without.

    Attributes:
        landmarks: number of those that were found in the last image.
    """

    landmarks: int = 0

    def summary(self) -> str:
        """The present detection in a few words."""
        return f'{self.landmarks} landmarks'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('images without a person', str(self.counts['empty'])),
            ('landmarks', str(self.landmarks)),
        ]


class KeypointsSession(Session[KeypointsParameters, KeypointsState]):
    """Detects the keypoints of one person; see `Session` for arguments and attributes."""

    TOPICS = TOPICS
    COUNTED = IMAGE
    UNIT = 'image'
    DONE = 'detected'
    ESTIMATE = 'the sequence'

    def _set_up(self) -> None:
        kind = DETECTORS[self.parameters.detector]
        self._detector = kind.make(with_mask=self.parameters.publish_mask)
        self.restart()

    def restart(self) -> None:
        """See `Session`."""
        # The detector sees by the stamps that a new sequence begins.
        self._landmarks: int | None = None
        super().restart()

    def _take(self, source: str, message: Any, stamp: int) -> None:
        try:
            image = self.decode_image(message)
            found = self._detector.detect(image, stamp)
        except ImageError as error:
            self._log.skip('image', str(error))
            return
        self._landmarks = 0 if found is None else len(found.names)
        self._log.counts['detected'] += 1
        self._log.counts['empty'] += found is None
        self._publish_found(
            NO_KEYPOINTS if found is None else found, stamp, str(message.header.frame_id)
        )

    def _publish_found(self, found: Keypoints, stamp: int, frame_id: str) -> None:
        messages = self._messages
        if self._wanted(KEYPOINTS):
            self._publish(KEYPOINTS, stamp, keypoints_message(messages, found, stamp, frame_id))
        if self._wanted(KEYPOINTS_3D):
            self._publish(KEYPOINTS_3D, stamp, positions_message(messages, found, stamp, frame_id))
        mask = self._detector.mask
        if mask is not None and self._wanted(MASK):
            picture = np.where(mask, np.uint8(255), np.uint8(0))
            self._publish(MASK, stamp, image_message(messages, picture, stamp, frame_id))

    def _present_state(self) -> KeypointsState:
        landmarks = self._landmarks
        if landmarks is None:
            return KeypointsState('waiting', 'an image', **self._totals())
        status = 'detecting' if landmarks else 'nobody'
        return KeypointsState(status, '', **self._totals(), landmarks=landmarks)
