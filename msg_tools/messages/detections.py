"""People in the messages of detectors: identities, keypoints, boxes.

- hmt_msgs/People2D: people with keypoints of any names, boxes, or both, with or without an id.
- hri_msgs/Skeleton2D (REP 155): one person, 18 landmarks in units of image width and height.
- yolo_msgs/DetectionArray (yolo_ros): people with an id and landmarks; the landmarks are numbered
  from 1.
- std_msgs/Float32MultiArray: rows (u, v) or (u, v, confidence), px, of one person; several people
  have an additional outermost dimension. The label of the outermost dimension can be the image
  stamp, ns.
- vision_msgs/Detection2DArray: people with an id and a box, but without keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.image.keypoint_schemes import Scheme, schemes
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools.messages.headers import header_message
from msg_tools.messages.keypoints import (
    MAX_PIXEL,
    checked_keypoints,
    keypoints_message,
    keypoints_of,
)
from msg_tools.messages.message_error import Array, MessageError
from msg_tools.messages.message_types import MessageFactory

SKELETON_2D, YOLO = 'hri_msgs/msg/Skeleton2D', 'yolo_msgs/msg/DetectionArray'
FLOATS = 'std_msgs/msg/Float32MultiArray'
PEOPLE_2D, BOXES = 'hmt_msgs/msg/People2D', 'vision_msgs/msg/Detection2DArray'
REGION = 'sensor_msgs/msg/RegionOfInterest'
# Class labels of people in vision_msgs detections: names from data sets, and COCO's number.
PERSON_CLASSES = ('person', 'people', 'human', 'pedestrian', '0', '')
# Maximum number of people in one image.
MAX_PEOPLE = 1000


# Empty keypoints, if nobody was seen or the detector finds no keypoints.
NO_KEYPOINTS = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


class DetectedPerson(NamedTuple):
    """A person in an image.

    Attributes:
        name: identity from the detector; '' if unknown.
        keypoints: landmarks under the names of their scheme; empty if there is only a box.
        box: (left, top, right, bottom) px; None if unknown.
    """

    name: str
    keypoints: Keypoints
    box: tuple[float, float, float, float] | None = None

    @property
    def extent(self) -> Array | None:
        """Top left and bottom right corner (2, 2) of the box, or else of the seen keypoints.

        None if no part of the person was seen.
        """
        if self.box is not None:
            return np.array(self.box, dtype=np.float64).reshape(2, 2)
        pixels = self.keypoints.pixels[self.keypoints.seen]
        return np.stack([pixels.min(0), pixels.max(0)]) if len(pixels) else None


def person_of_skeleton(message: Any, width: int, height: int) -> DetectedPerson:
    """The person in an hri_msgs/Skeleton2D.

    Args:
        width, height: size of the image, px.

    Raises:
        MessageError: wrong number of landmarks, or invalid positions.
    """
    scheme = schemes()['skeleton2d']
    wanted = len(scheme.names)
    if len(message.skeleton) != wanted:
        raise MessageError(f'Skeleton2D has {len(message.skeleton)} points, wanted {wanted}')
    rows = np.array([(p.x, p.y, p.c) for p in message.skeleton], dtype=np.float64)
    rows[(rows[:, :2] == 0).all(1)] = np.nan, np.nan, 0.0
    # In the message (0, 0) is the corner of the first pixel; in results it is the pixel's centre.
    rows[:, :2] = rows[:, :2] * (width, height) - 0.5
    return _person('', scheme, rows)


def people_of_message(message: Any, sigma_px: float = 0.0) -> list[DetectedPerson]:
    """The people in an hmt_msgs/People2D.

    Args:
        sigma_px: see `keypoints_of`.

    Raises:
        MessageError: people, keypoints and boxes differ in number, or `keypoints_of` rejects
            keypoints.
    """
    n = len(message.ids)
    _check_count(n)
    for name, values in (('keypoints', message.keypoints), ('boxes', message.boxes)):
        if len(values) not in (0, n):
            raise MessageError(f'people: {n} ids with {len(values)} {name}, wanted {n} or none')
    people = []
    for i in range(n):
        keypoints = NO_KEYPOINTS
        if len(message.keypoints) and len(message.keypoints[i].names):
            keypoints = keypoints_of(message.keypoints[i], sigma_px)
        box = None
        if len(message.boxes) and message.boxes[i].width:
            b = message.boxes[i]
            left, top = float(b.x_offset), float(b.y_offset)
            box = (left, top, left + float(b.width), top + float(b.height))
        people.append(DetectedPerson(str(message.ids[i]), keypoints, box))
    return people


def people_message(
    messages: MessageFactory, people: Sequence[DetectedPerson], stamp_ns: int, frame_id: str
) -> Any:
    """Makes an hmt_msgs/People2D of the people in an image."""
    boxes = []
    for person in people:
        left, top, right, bottom = (0, 0, 0, 0) if person.box is None else person.box
        x, y = max(int(left), 0), max(int(top), 0)
        width, height = max(int(right) - x, 0), max(int(bottom) - y, 0)
        boxes.append(messages.create(REGION, x_offset=x, y_offset=y, width=width, height=height))
    return messages.create(
        PEOPLE_2D,
        header=header_message(messages, stamp_ns, frame_id),
        ids=[person.name for person in people],
        keypoints=[
            keypoints_message(messages, person.keypoints, stamp_ns, frame_id) for person in people
        ],
        boxes=boxes,
    )


def people_of_boxes(message: Any) -> list[DetectedPerson]:
    """The people in a vision_msgs/Detection2DArray; detections of other classes are left out.

    Raises:
        MessageError: a box without area, or invalid positions.
    """
    _check_count(len(message.detections))
    people = []
    for detection in message.detections:
        results = detection.results
        classes = [str(each.hypothesis.class_id).lower() for each in results[:1]]
        if classes and classes[0] not in PERSON_CLASSES:
            continue
        centre = detection.bbox.center.position
        size = np.array([detection.bbox.size_x, detection.bbox.size_y], dtype=np.float64)
        middle = np.array([centre.x, centre.y], dtype=np.float64)
        numbers = [*middle.tolist(), *size.tolist()]
        if not ((size > 0).all() and np.abs(numbers).max() <= MAX_PIXEL):
            raise MessageError(
                f'detection {detection.id!r} has the centre and size {numbers}, wanted a box '
                f'within {MAX_PIXEL:g} px'
            )
        left, top = (middle - 0.5 * size).tolist()
        right, bottom = (middle + 0.5 * size).tolist()
        people.append(DetectedPerson(str(detection.id), NO_KEYPOINTS, (left, top, right, bottom)))
    return people


def people_of_yolo(message: Any, scheme: Scheme) -> list[DetectedPerson]:
    """The people with keypoints in a yolo_msgs/DetectionArray.

    Args:
        scheme: keypoint scheme that defines the numbers of the keypoints.

    Raises:
        MessageError: a keypoint number is unknown to the scheme or occurs twice, or positions are
            invalid.
    """
    _check_count(len(message.detections))
    people = []
    for detection in message.detections:
        points = detection.keypoints.data
        if not len(points):
            continue
        rows = np.full((len(scheme.names), 3), (np.nan, np.nan, 0.0))
        numbers = [int(point.id) for point in points]
        for number, point in zip(numbers, points, strict=True):
            if not 1 <= number <= len(rows):
                raise MessageError(
                    f'keypoint has the id {number}, wanted 1 to {len(rows)} of the scheme '
                    f'{scheme.name}'
                )
            rows[number - 1] = point.point.x, point.point.y, point.score
        if len(set(numbers)) < len(numbers):
            twice = next(number for number in numbers if numbers.count(number) > 1)
            raise MessageError(f'detection {detection.id!r} has the keypoint {twice} twice')
        people.append(_person(str(detection.id), scheme, rows))
    return people


def people_of_floats(message: Any, scheme: Scheme) -> list[DetectedPerson]:
    """The people in a std_msgs/Float32MultiArray.

    Args:
        message: array (n, 2), (n, 3), (people, n, 2) or (people, n, 3); an array without dimensions
            is one person. An empty array means that nobody was seen.
        scheme: scheme with n landmarks, in the order of the rows.

    Raises:
        MessageError: unsupported shape, or invalid positions.
    """
    n = len(scheme.names)
    data = np.array(message.data, dtype=np.float64)[int(message.layout.data_offset) :]
    if data.size == 0:
        return []
    shape = tuple(int(dimension.size) for dimension in message.layout.dim)
    if not shape:
        shape = (n, data.size // n)
    if len(shape) == 2:
        shape = (1, *shape)
    if len(shape) != 3 or shape[1] != n or shape[2] not in (2, 3) or data.size != np.prod(shape):
        seen = 'x'.join(str(dimension.size) for dimension in message.layout.dim) or 'no'
        raise MessageError(
            f'array has {data.size} numbers in {seen} dimensions, wanted {n}x2 or {n}x3 of the '
            f'scheme {scheme.name}, or as many for each of several people'
        )
    _check_count(shape[0])
    rows = np.ones((*shape[:2], 3))
    rows[..., : shape[2]] = data.reshape(shape)
    return [_person('', scheme, each) for each in rows]


def stamp_of_floats(message: Any) -> int | None:
    """The image stamp in a std_msgs/Float32MultiArray, ns; None if missing."""
    dimensions = message.layout.dim
    label = str(dimensions[0].label) if len(dimensions) else ''
    return int(label) if label.isascii() and label.isdigit() and len(label) < 20 else None


def _person(name: str, scheme: Scheme, rows: Array) -> DetectedPerson:
    return DetectedPerson(
        name, checked_keypoints(scheme.names, rows[:, :2].copy(), rows[:, 2].copy())
    )


def _check_count(count: int) -> None:
    if count > MAX_PEOPLE:
        raise MessageError(f'message has {count} people, the limit is {MAX_PEOPLE}')
