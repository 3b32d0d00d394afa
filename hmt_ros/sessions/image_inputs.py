"""Table of the inputs that accompany camera images, and their storage until the images arrive.

Each row of the table `INPUTS` gives an input's topics, message types and reader, the parameter that
makes images wait for the input, and whether a missing input is reported. Sessions, nodes, replay
and recording use the table. A new input needs a row, a parameter that enables it, and code that
uses its content.

An input belongs to the image with exactly the same stamp; of several inputs with one stamp, the
last is used. If the parameter of an input is true, an image waits for the input with its stamp, for
an input with a later stamp, or for an image that is `input_timeout` younger. An unusable input is
treated as an empty input.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from hmt_ros.image.terms.depth import MAX_DEPTH, MIN_DEPTH, usable_depths
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
# Message types of detections, by value of the parameter `source`.
SOURCES = {
    'people': PEOPLE_2D,
    'yolo': YOLO,
    'boxes': BOXES,
    'floats': FLOATS,
    'skeleton2d': SKELETON_2D,
}

T = TypeVar('T')

# Maximum numbers of small and of image-sized inputs that wait; maximum sizes of a message, bytes.
MAX_SMALL_INPUTS, MAX_LARGE_INPUTS = 256, 64
MAX_MESSAGE_BYTES, MAX_MASK_BYTES, MAX_DEPTH_BYTES = (
    2**24,
    MAX_PIXELS + 2**16,
    4 * MAX_PIXELS + 2**16,
)


@dataclass(frozen=True)
class ImageInput:
    """An input that accompanies images: a row of the table.

    Attributes:
        name: name of the input.
        types: message types of the input, by source; the source is also the name of the topic.
        parameter: name of the parameter that makes images wait for the input; '': always.
        read: function of a message and its stamp that returns the content, or None if it is empty;
            raises a one-line ValueError if the message can not be used.
        report_missing: whether an image without the input, and an input without an image, are
            reported.
        pixels: remedy, or '', for the error message if input and image differ in size; None: the
            input has no pixels.
        remembered: maximum number of inputs that wait for their image.
        largest: maximum size of a message, bytes.
        reliable: whether the subscription is reliable, so that no message is lost in transit.
        together: whether inputs of earlier images are used with the next image instead of dropped.
    """

    name: str
    types: Mapping[str, str]
    parameter: str
    read: Callable[[Any, int], Any] | None = None
    report_missing: bool = False
    pixels: str | None = None
    remembered: int = MAX_SMALL_INPUTS
    largest: int = MAX_MESSAGE_BYTES
    reliable: bool = False
    together: bool = False

    def is_used(self, parameters: Any) -> bool:
        """Whether images wait for the input, given the parameters of a node."""
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
            f'depth of {stamp} ns has no value between {MIN_DEPTH:g} and {MAX_DEPTH:g} m: wanted '
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
    report_missing=True,
    pixels='',
    remembered=MAX_LARGE_INPUTS,
    largest=MAX_MASK_BYTES,
)
DEPTH_INPUT = ImageInput(
    DEPTH,
    {DEPTH: IMAGE_TYPE},
    'use_depth',
    _read_depth,
    report_missing=True,
    pixels=': use depth that is registered to the colour camera',
    remembered=MAX_LARGE_INPUTS,
    largest=MAX_DEPTH_BYTES,
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
    report_missing=True,
)

# The table of inputs, in the order in which images wait for them.
INPUTS = (MASK_INPUT, KEYPOINTS_INPUT, KEYPOINTS_3D_INPUT, DEPTH_INPUT, PREDICTION_INPUT)


class StampedInputs(Generic[T]):
    """Inputs that wait for the image with their stamp; of inputs with one stamp, the last is kept.

    None represents an input without content, for example if a detector saw nobody.
    """

    def __init__(self, most: int = MAX_SMALL_INPUTS) -> None:
        self._most = most
        # Contents by stamp, in the order of arrival.
        self._content: dict[int, T | None] = {}

    def keep(self, first_ns: int, last_ns: int) -> None:
        """Drops the inputs with stamps outside of a range."""
        kept = self._content.items()
        self._content = {stamp: x for stamp, x in kept if first_ns <= stamp <= last_ns}

    def put(self, stamp_ns: int, content: T | None) -> None:
        """Keeps an input for its image."""
        self._content[stamp_ns] = content
        while len(self._content) > self._most:
            del self._content[next(iter(self._content))]

    def is_settled(self, stamp_ns: int, within_ns: float) -> bool:
        """Whether the input for an image, or an input at most `within_ns` later, has arrived.

        A much later input is no evidence that the input for the image is missing.
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
        """Return the input that a source belongs to; None if the source is not an input."""
        return self._rows.get(source)

    def put(self, source: str, message: Any, stamp_ns: int, read: Callable[..., Any]) -> None:
        """Reads a message and keeps its content for its image.

        Args:
            read: reader with the signature of `ImageInput.read`.
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
            image: (H, W, 3) pixels of the image.
            dropped: stamps of dropped images; their inputs are not reported.

        Returns:
            Content for the image; None if the message is missing, empty, or of the wrong size.
        """
        taken = self._waiting[row.name].take_all(stamp_ns)
        content = taken.get(stamp_ns)
        if row.report_missing:
            for each in (x for x in taken if x != stamp_ns and x not in dropped):
                self._log.note(
                    f'{row.name} without an image',
                    f'{row.name} of {each} ns: no image with this stamp waits; wanted the stamp '
                    'of an image',
                )
        if row.report_missing and stamp_ns not in taken:
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
        """Drops all inputs with stamps outside of a range."""
        for waiting in self._waiting.values():
            waiting.keep(first_ns, last_ns)
