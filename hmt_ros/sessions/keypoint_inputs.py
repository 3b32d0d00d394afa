"""Keypoints of the person who is tracked, from messages of any detector.

The parameter `source` selects the type of messages: hmt_msgs/Keypoints2D of one person, or messages
of other detectors about one or several people:

- Skeleton2D is in units of the image size and needs an earlier camera_info. Its topic belongs to
  one person. Float32MultiArray without a stamp gets the stamp of the newest camera_info.
- `person_id` selects one of several people. Without it, the largest person is chosen at first, and
  then the person nearest to the last position.

Keypoints without names mean that nobody was seen. Positions in space are matched by name with the
keypoints of the same stamp.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.core import elementary
from hmt_ros.experts.lifter import Lifter, load_lifter
from hmt_ros.image.keypoint_schemes import AUTO, JOINTS, Scheme
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.declared_parameters import OWN_SOURCE, CameraNodeParameters
from hmt_ros.sessions.handled import HandlingLog
from hmt_ros.sessions.image_inputs import DETECTIONS, KEYPOINTS_INPUT, SOURCES, ImageInput
from hmt_ros.sessions.named_file import named_file
from msg_tools import MessageError
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    DetectedPerson,
    people_of_boxes,
    people_of_floats,
    people_of_message,
    people_of_yolo,
    person_of_skeleton,
)
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.keypoints import Positions, keypoints_of

# Value of `source` for messages of one person, in units of the image size.
SKELETON = 'skeleton2d'
# Time without the person after which the largest person is chosen again, s.
MAX_ABSENCE = 1.0
# Maximum motion of a person between two images, relative to the size of the person.
_MAX_MOTION = 1.0
# Decay factor, per image, of a person's remembered size; the person may be partly hidden.
_SIZE_DECAY = 0.95


def known_lifter(model: str) -> Lifter | None:
    """Load the lifter that the parameter `lifter` names; None if the name is empty.

    Raises:
        ValueError: the file does not exist, or is not a lifter (one-line message).
    """
    with named_file('lifter', model, 'lifter'):
        return load_lifter(model) if model else None


def keypoints_input(source: str) -> ImageInput:
    """Return the keypoint input for a value of `source`."""
    if source == OWN_SOURCE:
        return KEYPOINTS_INPUT
    return replace(KEYPOINTS_INPUT, types={DETECTIONS: SOURCES[source]})


def _person_of_skeleton(
    message: Any, _order: Scheme, camera: Camera | None
) -> list[DetectedPerson]:
    if camera is None:
        raise MessageError(
            'it comes before a calibrated camera_info, which gives the size of the image'
        )
    return [person_of_skeleton(message, camera.width, camera.height)]


# Functions that read the people in a message, by value of `source`.
_READERS: dict[str, Callable[[Any, Scheme, Camera | None], list[DetectedPerson]]] = {
    'people': lambda message, _order, _camera: people_of_message(message),
    'boxes': lambda message, _order, _camera: people_of_boxes(message),
    'yolo': lambda message, order, _camera: people_of_yolo(message, order),
    'floats': lambda message, order, _camera: people_of_floats(message, order),
    SKELETON: _person_of_skeleton,
}


class ChosenPerson:
    """Chooses the person to follow: the largest at first, then the nearest to the last position.

    The last position comes from the detections, not from the tracker, which may have lost the
    person.
    """

    def __init__(self) -> None:
        self._last: Keypoints | None = None
        self._stamp = 0
        self._size = 0.0

    def forget(self) -> None:
        """Forgets the person: the next choice is the largest person."""
        self._last = None

    def choose(
        self, people: Sequence[DetectedPerson], stamp_ns: int, longest_absence: float
    ) -> Keypoints | None:
        """Choose the person among the people who were seen in an image.

        Args:
            longest_absence: time without the person after which the largest person is chosen, s.

        Returns:
            The keypoints of the person; None if the person is not in the image.
        """
        seen = [person.keypoints for person in people if person.keypoints.seen.any()]
        if not seen:
            return None
        last = self._last
        if last is None or abs(stamp_ns - self._stamp) > longest_absence * SECOND_NS:
            chosen = max(seen, key=_size)
            self._size = 0.0
        else:
            chosen = min(seen, key=lambda keypoints: _distance(keypoints, last))
            if _distance(chosen, last) > _MAX_MOTION * self._size:
                return None
        self._last, self._stamp = chosen, stamp_ns
        self._size = max(_size(chosen), _SIZE_DECAY * self._size)
        return chosen


def _size(keypoints: Keypoints) -> float:
    """Return the diagonal of the box around a person, px."""
    pixels = keypoints.pixels[keypoints.seen]
    return float(elementary.hypot(*np.ptp(pixels, axis=0)))


def _distance(one: Keypoints, other: Keypoints) -> float:
    """Return the median distance of shared landmarks or, if none is shared, of the centres, px."""
    both = one.seen & other.seen
    if both.any():
        return float(np.median(elementary.hypot(*(one.pixels - other.pixels)[both].T)))
    middles = [each.pixels[each.seen].mean(0) for each in (one, other)]
    return float(elementary.hypot(*(middles[0] - middles[1])))


class DetectionReader:
    """Reads the messages of a detector.

    Args:
        source: type of the messages, see `CameraNodeParameters.source`.
    """

    def __init__(self, source: str, log: HandlingLog) -> None:
        self._source, self._log = source, log

    def _people(
        self, message: Any, stamp: int, order: Scheme, camera: Camera | None = None
    ) -> list[DetectedPerson]:
        """Return the people in a message.

        Args:
            order: scheme that gives the order of keypoints without names.
            camera: camera of the image; None: unknown.

        Raises:
            MessageError: the message can not be used.
        """
        try:
            return _READERS[self._source](message, order, camera)
        except MessageError as error:
            raise MessageError(f'detections of {stamp} ns: {error}') from error

    def _report(self, unknown: list[str], scheme: str) -> None:
        """Reports unknown names of keypoints."""
        known = {AUTO: 'of the body or of a known scheme', JOINTS: 'of the body'}
        self._log.note(
            'names of keypoints',
            f'keypoints {unknown} are not used: wanted names of joints '
            f'{known.get(scheme, f"in the scheme {scheme}")}',
        )


class KeypointReader(DetectionReader):
    """Reads the keypoints of the person who is tracked.

    Attributes:
        chosen: selects the tracked person if a detector reports several people.
    """

    def __init__(self, source: str, log: HandlingLog) -> None:
        super().__init__(source, log)
        self.chosen = ChosenPerson()

    def read(
        self,
        message: Any,
        stamp: int,
        parameters: CameraNodeParameters,
        body: Body,
        camera: Camera | None,
    ) -> Keypoints:
        """Return the keypoints in a message.

        Args:
            camera: camera of the image; None: not known yet.

        Raises:
            ValueError: the message can not be used (one-line message).
        """
        found = self._found(message, stamp, parameters, camera)
        if found is None or not found.names:
            return NO_KEYPOINTS
        _, unknown = found.named_for(body, parameters.keypoint_scheme)
        if unknown:
            self._report(unknown, parameters.keypoint_scheme)
        return found

    def _found(
        self,
        message: Any,
        stamp: int,
        p: CameraNodeParameters,
        camera: Camera | None,
    ) -> Keypoints | None:
        if self._source == OWN_SOURCE:
            return keypoints_of(message)
        if stamp == 0 and self._source != SKELETON:
            raise MessageError('it comes before a camera_info, which gives its stamp')
        people = self._people(message, stamp, p.order, camera)
        chosen: Keypoints | None
        if self._source == SKELETON:
            chosen = people[0].keypoints
        elif p.person_id:
            own = (x.keypoints for x in people if x.name == p.person_id and x.keypoints.seen.any())
            chosen = next(own, None)
        else:
            chosen = self.chosen.choose(people, stamp, MAX_ABSENCE)
        return None if chosen is None else chosen[np.flatnonzero(chosen.seen)]

    def at_joints(
        self,
        found: Keypoints | None,
        positions: Positions | None,
        body: Body,
        scheme: str,
        stamp_ns: int,
    ) -> Keypoints | None:
        """Return the keypoints that were seen in an image, named as joints of the body.

        Args:
            found: keypoints from `read`; None without a message.
            positions: positions of the landmarks in space; None without a message.
        """
        if found is None or not found.names:
            return found
        if positions is not None and positions.names:
            found = positions.added_to(found)
            if not set(positions.names) & set(found.names):
                self._log.note(
                    'keypoints_3d',
                    f'keypoints_3d of {stamp_ns} ns has none of the names of its keypoints, such '
                    f'as {found.names[0]!r}, but {positions.names[0]!r}',
                )
        known, _ = found.named_for(body, scheme)
        return known[np.flatnonzero(known.seen)] if known.names else None
