"""Keypoints of other detectors: their messages in, hmt_msgs/Keypoints2D of one person out.

- Every detection gets one keypoints with its stamp and frame; without names where the person was
  not seen.
- Skeleton2D is in units of the image: it needs a camera_info before. Its topic belongs to one
  person already. Float32MultiArray without a stamp has that of the newest camera_info.
- A detection that is not younger than the one before is skipped, or is the first of a new sequence
  with `reset_on_time_jump`.
- What can not be used is skipped. The first fault of each kind is logged; all are counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.camera_session import CAMERA_INFO, camera_info_fault
from hmt_ros.sessions.chosen_person import ChosenPerson
from hmt_ros.sessions.handled import Fault, Output
from hmt_ros.sessions.keypoint_inputs import KEYPOINTS
from hmt_ros.sessions.keypoints_adapter_parameters import KeypointsAdapterParameters
from hmt_ros.sessions.session import (
    NeededInput,
    Order,
    PublishedTopic,
    Session,
    SessionState,
    everything,
)
from msg_tools import MessageError
from msg_tools.messages import keypoints
from msg_tools.messages.camera_info import CameraInfoError, camera_from_info
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    people_of_floats,
    people_of_yolo,
    person_of_skeleton,
    stamp_of_floats,
)
from msg_tools.messages.headers import time_ns
from msg_tools.messages.keypoints import keypoints_message

DETECTIONS = 'detections'
TOPICS = {KEYPOINTS: PublishedTopic(keypoints.KEYPOINTS_2D)}


@dataclass(frozen=True)
class KeypointsAdapterState(SessionState):
    """State of the adapter: its status is 'waiting', 'nobody' or 'following'.

    Of the counts 'converted' are detections with or without the person, 'empty' those without.

    Attributes:
        people: number of people in the last detection.
    """

    people: int = 0

    def summary(self) -> str:
        """The present detection in a few words."""
        return f'one of {self.people}'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('detections without the person', str(self.counts['empty'])),
            ('people', str(self.people)),
        ]


class KeypointsAdapterSession(Session[KeypointsAdapterParameters, KeypointsAdapterState]):
    """Converts detections; see `Session` for arguments and attributes."""

    TOPICS = TOPICS
    COUNTED = DETECTIONS
    UNIT = 'detection'
    DONE = 'converted'
    ESTIMATE = 'the sequence'
    CHECKED = ()

    def __init__(
        self,
        parameters: KeypointsAdapterParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        super().__init__(parameters, publish, wanted)
        self._source = parameters.source
        self._scheme = schemes()[parameters.scheme]
        self._camera: Camera | None = None
        # Stamp and frame of the newest camera_info.
        self._image: tuple[int, str] | None = None
        self._newest: int | None = None
        self._chosen = ChosenPerson()
        self._people = 0
        self._seen = False
        self.state = self._present_state()

    def needed_inputs(self) -> list[NeededInput]:
        """What has to come at present; may be called by any thread."""
        needed = super().needed_inputs()
        return [*needed, NeededInput((CAMERA_INFO,))] if self._wants() else needed

    def _forget(self) -> None:
        self._newest = None
        self._chosen.forget()
        self._people, self._seen = 0, False

    def _stamp_of(self, source: str, message: Any) -> int:
        if source == DETECTIONS and self._source == 'floats':
            told = stamp_of_floats(message)
            known = 0 if self._image is None else self._image[0]
            return known if told is None else told
        return super()._stamp_of(source, message)

    def _take(self, source: str, message: Any, stamp: int) -> None:
        if source == CAMERA_INFO:
            self._take_camera_info(message)
            return
        if self._wants():
            self._log.skip(Fault.CAMERA_INFO, f'detection comes before {self._wants()}')
            return
        order = self._order(stamp, self._newest)
        if order is Order.SKIPPED:
            return
        if order is Order.JUMP:
            self.restart()
        self._newest = stamp
        try:
            person = self._person_in(message, stamp)
        except MessageError as error:
            self._log.skip(Fault.DETECTIONS, f'detection of {stamp} ns: {error}')
            return
        self._seen = person is not None
        self._log.counts['converted'] += 1
        self._log.counts['empty'] += person is None
        if self._wanted(KEYPOINTS):
            found = NO_KEYPOINTS if person is None else _those_seen(person)
            frame = self._frame_of(message)
            written = keypoints_message(self._messages, found, stamp, frame)
            self._publish(KEYPOINTS, stamp, written)

    def _take_camera_info(self, message: Any) -> None:
        self._image = (time_ns(message.header.stamp), str(message.header.frame_id))
        try:
            self._camera = camera_from_info(message)
        except CameraInfoError as error:
            text = camera_info_fault(error, self._on_topic(CAMERA_INFO))
            self._log.fault(Fault.CAMERA_INFO, text)

    def _person_in(self, message: Any, stamp: int) -> Keypoints | None:
        """The keypoints of the person who is tracked; None: not seen."""
        p = self.parameters
        if self._source == 'skeleton2d':
            assert self._camera is not None
            person = person_of_skeleton(message, self._camera.width, self._camera.height)
            self._people = int(person.keypoints.seen.any())
            return person.keypoints if self._people else None
        read = people_of_yolo if self._source == 'yolo' else people_of_floats
        people = read(message, self._scheme)
        self._people = len(people)
        if p.person_id:
            people = [person for person in people if person.name == p.person_id]
            return next((x.keypoints for x in people if x.keypoints.seen.any()), None)
        return self._chosen.choose(people, stamp, p.longest_absence)

    def _frame_of(self, message: Any) -> str:
        own = '' if self._source == 'floats' else str(message.header.frame_id)
        return own or ('' if self._image is None else self._image[1])

    def _wants(self) -> str:
        """What has to come before detections can be used; '' where it has come."""
        if self._source == 'skeleton2d' and self._camera is None:
            return 'a calibrated camera_info, which tells the size of the image'
        if self._source == 'floats' and self._image is None:
            return 'a camera_info, which tells stamp and frame of the image'
        return ''

    def _present_state(self) -> KeypointsAdapterState:
        wants = self._wants()
        if wants or self._newest is None:
            status, wants = 'waiting', wants or 'a detection'
        else:
            status = 'following' if self._seen else 'nobody'
        return KeypointsAdapterState(status, wants, **self._totals(), people=self._people)


def _those_seen(person: Keypoints) -> Keypoints:
    return person[np.flatnonzero(person.seen)]
