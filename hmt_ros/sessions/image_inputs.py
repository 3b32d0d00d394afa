"""Inputs that accompany the images of a camera: their table, and the inputs that wait for an image.

`INPUTS` is the table of topics, types, readers, the parameters that make images wait for an input,
and reports of missing inputs. Sessions, nodes, replay and recording use it. A new input needs a row
here, a parameter that enables it, and code that uses its content.

An input belongs to the image of exactly its stamp; of several with one stamp the last counts. If
its parameter is true, an image waits for the input of its stamp, for an input of a later stamp, or
for an image that is `input_timeout` younger. An unusable input counts as an empty one.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from hmt_ros.image.terms.depth import FURTHEST, NEAREST, usable_depths
from hmt_ros.inference.arrays import Image
from hmt_ros.sessions.handled import HandlingLog
from msg_tools.files.error_line import error_line
from msg_tools.messages import keypoints
from msg_tools.messages.detections import BOXES, FLOATS, PEOPLE_2D, SKELETON_2D, YOLO
from msg_tools.messages.images import MAX_PIXELS, decode_depth, decode_mask
from msg_tools.messages.keypoints import positions_of
from msg_tools.messages.pose_mixtures import POSE_MIXTURE

IMAGE_TYPE, COMPRESSED_TYPE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
MASK, COMPRESSED_MASK, DEPTH = 'mask', 'mask/compressed', 'depth'
KEYPOINTS, KEYPOINTS_3D, DETECTIONS = 'keypoints', 'keypoints_3d', 'detections'
PREDICTION = 'pose_prediction'
# Types of detections by value of the parameter `source`.
SOURCES = {
    'people': PEOPLE_2D,
    'yolo': YOLO,
    'boxes': BOXES,
    'floats': FLOATS,
    'skeleton2d': SKELETON_2D,
}

T = TypeVar('T')

# Maximum numbers of small and of image-sized inputs that wait; maximum sizes of a message, bytes.
REMEMBERED, FEWER = 256, 64
LARGEST, LARGEST_MASK, LARGEST_DEPTH = 2**24, MAX_PIXELS + 2**16, 4 * MAX_PIXELS + 2**16


@dataclass(frozen=True)
class ImageInput:
    """An input: a row of the table.

    Attributes:
        name: name of the input.
        types: types of its messages, by source; the source is also the name of the topic.
        parameter: name of the parameter that makes images wait for the input; '': they always do.
        read: returns the content of a message with a stamp, None if it is empty; raises ValueError,
            in one line, if the message can not be used.
        told: whether an image without the input, and an input without an image, are reported.
        pixels: remedy, possibly '', if its size differs from the image's; None: it has no pixels.
        remembered: maximum number of inputs that wait for their image.
        largest: maximum size of a message, bytes.
        reliable: whether no message may be lost in transit.
        together: whether inputs of earlier images are kept and used with the next image.
    """

    name: str
    types: Mapping[str, str]
    parameter: str
    read: Callable[[Any, int], Any] | None = None
    told: bool = False
    pixels: str | None = None
    remembered: int = REMEMBERED
    largest: int = LARGEST
    reliable: bool = False
    together: bool = False

    def is_used(self, parameters: Any) -> bool:
        """Whether images wait for the input, by the parameters of a node."""
        return not self.parameter or bool(getattr(parameters, self.parameter, False))


def _read_mask(message: Any, stamp: int) -> Any:
    mask = decode_mask(message)
    if mask.all():
        raise ValueError(f'mask of {stamp} ns is zero nowhere, wanted zero where the person is not')
    return mask


def _read_depth(message: Any, stamp: int) -> Any:
    depth = usable_depths(decode_depth(message))
    if not depth.any():
        raise ValueError(
            f'depth of {stamp} ns lies nowhere between {NEAREST:g} and {FURTHEST:g} m: wanted '
            '16UC1 in mm or 32FC1 in m'
        )
    return depth


def _read_positions(message: Any, _stamp: int) -> Any:
    return positions_of(message)


MASK_INPUT = ImageInput(
    MASK,
    {MASK: IMAGE_TYPE, COMPRESSED_MASK: COMPRESSED_TYPE},
    'use_mask',
    _read_mask,
    told=True,
    pixels='',
    remembered=FEWER,
    largest=LARGEST_MASK,
)
DEPTH_INPUT = ImageInput(
    DEPTH,
    {DEPTH: IMAGE_TYPE},
    'use_depth',
    _read_depth,
    told=True,
    pixels=': use depth that is registered to the colour camera',
    remembered=FEWER,
    largest=LARGEST_DEPTH,
)
KEYPOINTS_INPUT = ImageInput(
    KEYPOINTS,
    {KEYPOINTS: keypoints.KEYPOINTS_2D},
    'use_keypoints',
)
KEYPOINTS_3D_INPUT = ImageInput(
    KEYPOINTS_3D,
    {KEYPOINTS_3D: keypoints.KEYPOINTS_3D},
    'use_keypoints_3d',
    _read_positions,
)
PREDICTION_INPUT = ImageInput(
    PREDICTION,
    {PREDICTION: POSE_MIXTURE},
    'use_predictions',
    reliable=True,
    together=True,
)
# The type depends on the parameter `source`.
DETECTIONS_INPUT = ImageInput(
    DETECTIONS,
    {DETECTIONS: ''},
    '',
    told=True,
)

# In the order in which images wait for them.
INPUTS = (MASK_INPUT, KEYPOINTS_INPUT, KEYPOINTS_3D_INPUT, DEPTH_INPUT, PREDICTION_INPUT)


class StampedInputs(Generic[T]):
    """Inputs that belong to the image of exactly their stamp; of several the last counts.

    None represents an input without content, for example of a detector that saw nobody.
    """

    def __init__(self, most: int = REMEMBERED) -> None:
        self._most = most
        # Contents by stamp, in the order of arrival.
        self._content: dict[int, T | None] = {}

    def keep(self, first_ns: int, last_ns: int) -> None:
        """Drops the inputs of other stamps."""
        kept = self._content.items()
        self._content = {stamp: x for stamp, x in kept if first_ns <= stamp <= last_ns}

    def put(self, stamp_ns: int, content: T | None) -> None:
        """Keeps an input for its image."""
        self._content[stamp_ns] = content
        while len(self._content) > self._most:
            del self._content[next(iter(self._content))]

    def is_settled(self, stamp_ns: int, within_ns: float) -> bool:
        """Whether the input for an image has come, or one that is later by at most a time.

        An input further ahead does not show that the one of the image is missing.
        """
        return any(0 <= each - stamp_ns <= within_ns for each in self._content)

    def take_all(self, stamp_ns: int) -> dict[int, T | None]:
        """Remove and return the inputs for an image and all older ones, in the order of stamps."""
        taken = sorted(stamp for stamp in self._content if stamp <= stamp_ns)
        return {stamp: self._content.pop(stamp) for stamp in taken}


class ImageInputs:
    """Inputs that wait for the images of a session."""

    def __init__(self, rows: Iterable[ImageInput], log: HandlingLog) -> None:
        self._log = log
        self._rows = {source: row for row in rows for source in row.types}
        self._waiting: dict[str, StampedInputs[Any]] = {
            row.name: StampedInputs(row.remembered) for row in self._rows.values()
        }

    def __getitem__(self, name: str) -> StampedInputs[Any]:
        """Return the waiting contents of an input."""
        return self._waiting[name]

    def row(self, source: str) -> ImageInput | None:
        """Return the input that a source belongs to; None if it is no input."""
        return self._rows.get(source)

    def put(self, source: str, message: Any, stamp_ns: int, read: Callable[..., Any]) -> None:
        """Reads a message and keeps its content for its image.

        Args:
            read: reader like `ImageInput.read`.
        """
        row, content = self._rows[source], None
        try:
            content = read(message, stamp_ns)
        except ValueError as error:
            self._log.fault(row.name, error_line(error))
        self._waiting[row.name].put(stamp_ns, content)

    def take(self, row: ImageInput, stamp_ns: int, image: Image, dropped: Container[int]) -> Any:
        """Return the input for an image; report a missing input, and inputs without an image.

        Args:
            image: (H, W, 3).
            dropped: stamps of dropped images; their inputs are not reported.

        Returns:
            Content for the image; None if there is no message, or one without content.
        """
        taken = self._waiting[row.name].take_all(stamp_ns)
        content = taken.get(stamp_ns)
        if row.told:
            for each in (x for x in taken if x != stamp_ns and x not in dropped):
                self._log.note(
                    f'{row.name} without an image',
                    f'{row.name} of {each} ns: no image has this stamp, or waits any more; wanted '
                    'the stamp of an image',
                )
        if row.told and stamp_ns not in taken:
            text = f'no {row.name} came for the image of {stamp_ns} ns'
            self._log.note(f'no {row.name}', text)
        if content is None or row.pixels is None or content.shape == image.shape[:2]:
            return content
        (height, width), (rows, columns) = content.shape, image.shape[:2]
        self._log.fault(
            row.name,
            f'{row.name} of {stamp_ns} ns has {width}x{height} pixels, wanted the {columns}x{rows} '
            f'of its image{row.pixels}',
        )
        return None

    def keep(self, first_ns: int, last_ns: int) -> None:
        """Drops all inputs of other stamps."""
        for waiting in self._waiting.values():
            waiting.keep(first_ns, last_ns)
