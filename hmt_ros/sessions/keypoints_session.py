"""Session of the keypoint detector: images in, keypoints of one person or several out.

- With `people` above 0 every usable image gets one message on the topic detections, with all people
  and their identities. Otherwise every image gets one message on the topic keypoints, one on
  keypoints_3d and, with `publish_mask`, one on mask. Messages without names, and a mask of zeros,
  mean that nobody was seen.
- All messages have the stamp and the frame of the image.
- Unusable images are skipped. The first fault of each kind is logged; all are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmt_ros.detectors.detector import Detector
from hmt_ros.detectors.people import PICTURE_TIME, PeopleDetector, SeenPerson
from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.camera_session import IMAGE
from hmt_ros.sessions.declared_parameters import (
    NEXT_CONFIGURE,
    ImageNodeParameters,
    check_choices,
    parameter_field,
)
from hmt_ros.sessions.image_inputs import DETECTIONS, KEYPOINTS, KEYPOINTS_3D, MASK
from hmt_ros.sessions.session import PublishedTopic, Session, SessionState
from msg_tools.messages import keypoints
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    PEOPLE_2D,
    DetectedPerson,
    people_message,
)
from msg_tools.messages.images import ImageError, image_message
from msg_tools.messages.keypoints import keypoints_message, positions_message

MAX_PEOPLE = 20

TOPICS = {
    KEYPOINTS: PublishedTopic(keypoints.KEYPOINTS_2D),
    KEYPOINTS_3D: PublishedTopic(keypoints.KEYPOINTS_3D),
    MASK: PublishedTopic('sensor_msgs/msg/Image'),
    DETECTIONS: PublishedTopic(PEOPLE_2D),
}


@dataclass(frozen=True)
class KeypointsParameters(ImageNodeParameters):
    """All parameters of the keypoints node.

    Attributes:
        detector: Keypoint detector: 'mediapipe' (MediaPipe Pose), or 'mediapipe+movenet', which
            adds MoveNet Thunder at five times the cost.
        publish_mask: If true, the node also publishes the mask of the person.
        people: Maximum number of people whom the node follows and publishes on detections, for
            people_node; 0 follows one person and publishes keypoints.
    """

    detector: str = parameter_field(USUAL_DETECTOR, NEXT_CONFIGURE)
    publish_mask: bool = parameter_field(False, NEXT_CONFIGURE)
    people: int = parameter_field(0, NEXT_CONFIGURE, (0, MAX_PEOPLE))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, detector=tuple(DETECTORS))
        if self.people and self.detector != USUAL_DETECTOR:
            raise ValueError(
                f'detector {self.detector!r} finds one person, but people is {self.people}: wanted '
                f'detector {USUAL_DETECTOR!r}, or people 0'
            )


@dataclass(frozen=True)
class KeypointsState(SessionState):
    """State of the detection: its status is 'waiting', 'nobody' or 'detecting'.

    Keys of `counts`: 'detected' (searched images) and 'empty' (images without a person).

    Attributes:
        landmarks: number of landmarks of all people in the last image.
        people: number of people in the last image; None if the detector finds only one person.
    """

    landmarks: int = 0
    people: int | None = None

    def summary(self) -> str:
        """The present detection in a few words."""
        return f'{self.landmarks} landmarks' if self.people is None else f'{self.people} people'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('images without a person', str(self.counts['empty'])),
            ('landmarks', str(self.landmarks)),
        ]


class KeypointsSession(Session[KeypointsParameters, KeypointsState]):
    """Detects the keypoints of people; see `Session` for arguments and attributes."""

    TOPICS = TOPICS
    COUNTED = IMAGE
    UNIT = 'image'
    DONE = 'detected'
    ESTIMATE = 'the sequence'

    def _set_up(self) -> None:
        p = self.parameters
        self._detector: Detector | PeopleDetector = (
            PeopleDetector(p.people)
            if p.people
            else DETECTORS[p.detector].make(with_mask=p.publish_mask)
        )
        self.restart()

    def restart(self) -> None:
        """See `Session`."""
        # The detector itself recognises a new sequence by the stamps.
        self._landmarks: int | None = None
        self._count: int | None = None
        super().restart()

    def _take(self, source: str, message: Any, stamp: int) -> None:
        detector = self._detector
        try:
            image = self.decode_image(message)
            found = detector.detect(image, stamp)
        except ImageError as error:
            self._log.skip('image', str(error))
            return
        frame = str(message.header.frame_id)
        self._log.counts['detected'] += 1
        self._log.counts['empty'] += not found
        if isinstance(detector, PeopleDetector):
            assert isinstance(found, list)
            self._publish_people(found, detector.left_out, stamp, frame)
        else:
            assert not isinstance(found, list)
            self._landmarks = 0 if found is None else len(found.names)
            self._publish_found(found or NO_KEYPOINTS, detector.mask, stamp, frame)

    def _publish_people(
        self, seen: list[SeenPerson], left_out: int, stamp: int, frame_id: str
    ) -> None:
        people = detected_people(seen)
        self._landmarks, self._count = sum(len(x.keypoints.names) for x in people), len(people)
        if left_out:
            self._log.note(
                'too many people',
                f'{len(people) + left_out} people are seen in the image of {stamp} ns, but people '
                f'is {self.parameters.people}: the smallest are left out',
            )
        for one in seen:
            if one.still:
                self._log.note(
                    f'{one.name} is still',
                    f'nothing about {one.name} has changed for {PICTURE_TIME:g} s: '
                    'a picture or a statue?',
                )
        if self._wanted(DETECTIONS):
            self._publish(
                DETECTIONS, stamp, people_message(self._messages, people, stamp, frame_id)
            )

    def _publish_found(
        self, found: Keypoints, mask: Mask | None, stamp: int, frame_id: str
    ) -> None:
        messages = self._messages
        if self._wanted(KEYPOINTS):
            self._publish(KEYPOINTS, stamp, keypoints_message(messages, found, stamp, frame_id))
        if self._wanted(KEYPOINTS_3D):
            self._publish(KEYPOINTS_3D, stamp, positions_message(messages, found, stamp, frame_id))
        if mask is not None and self._wanted(MASK):
            picture = np.where(mask, np.uint8(255), np.uint8(0))
            self._publish(MASK, stamp, image_message(messages, picture, stamp, frame_id))

    def _present_state(self) -> KeypointsState:
        landmarks = self._landmarks
        if landmarks is None:
            return KeypointsState('waiting', 'an image', **self._totals())
        status = 'detecting' if landmarks else 'nobody'
        return KeypointsState(status, '', **self._totals(), landmarks=landmarks, people=self._count)


def detected_people(seen: Sequence[SeenPerson]) -> list[DetectedPerson]:
    """Convert the people that a detector has seen to the content of a message."""
    result = []
    for one in seen:
        left, top, right, bottom = one.corners.ravel().tolist()
        result.append(DetectedPerson(one.name, one.keypoints, (left, top, right, bottom)))
    return result
