"""Inputs that come with the images of a camera, declared once, and those that wait for an image.

`INPUTS` is the table: topics and types, reading of messages, waiting of images for them, faults of
their absence. Sessions, nodes, replay and recording read it; a new input is a row here, the
parameter that switches it on, and the place where its content is used.

An input belongs to the image of exactly its stamp; of several of one stamp the last counts. Where
its parameter says so an image waits for it: for the input of its stamp, for one of a later stamp,
or for an image that is `input_timeout` younger. One that can not be used counts as none.
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

# Inputs that are remembered, those as large as images, and bytes of one.
REMEMBERED, FEWER = 256, 64
LARGEST, LARGEST_MASK, LARGEST_DEPTH = 2**24, MAX_PIXELS + 2**16, 4 * MAX_PIXELS + 2**16


@dataclass(frozen=True)
class ImageInput:
    """An input: a row of the table.

    Attributes:
        name: of the input.
        types: type of its messages, by source; a source is the name of its topic, too.
        parameter: name of the one that is true where images wait for it; '': they always do.
        read: content of a message of a stamp, None where it says that there is nothing; raises
            ValueError, in one line, where it can not be used.
        told: whether an image without one, and one that belongs to no image, are reported.
        pixels: remedy, maybe '', where its size is not that of its image; None: it has no pixels.
        remembered: maximum number kept of stamps whose image has not come.
        largest: size of the largest message that is taken, bytes.
        reliable: whether none may be lost on its way.
        together: whether those of images before stay, to be used with the next.
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
        """Whether images wait for it, by the parameters of a node."""
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
# Its type depends on the parameter `source`.
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

    None stands for an input without content, as of a detector that saw nobody.
    """

    def __init__(self, most: int = REMEMBERED) -> None:
        self._most = most
        # In the order in which they came.
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
        """Whether the input for an image has come, or one that is later by no more than a time.

        One that is far ahead says nothing of the images until then.
        """
        return any(0 <= each - stamp_ns <= within_ns for each in self._content)

    def take_all(self, stamp_ns: int) -> dict[int, T | None]:
        """The inputs by stamp, in order, for an image and all that are older; drops them."""
        taken = sorted(stamp for stamp in self._content if stamp <= stamp_ns)
        return {stamp: self._content.pop(stamp) for stamp in taken}


class ImageInputs:
    """Inputs that have come for the images of a session."""

    def __init__(self, rows: Iterable[ImageInput], log: HandlingLog) -> None:
        self._log = log
        self._rows = {source: row for row in rows for source in row.types}
        self._waiting: dict[str, StampedInputs[Any]] = {
            row.name: StampedInputs(row.remembered) for row in self._rows.values()
        }

    def __getitem__(self, name: str) -> StampedInputs[Any]:
        """The messages of an input that wait."""
        return self._waiting[name]

    def row(self, source: str) -> ImageInput | None:
        """The input that a source belongs to; None: to none."""
        return self._rows.get(source)

    def put(self, source: str, message: Any, stamp_ns: int, read: Callable[..., Any]) -> None:
        """Reads a message and keeps its content for its image.

        Args:
            read: as `ImageInput.read`.
        """
        row, content = self._rows[source], None
        try:
            content = read(message, stamp_ns)
        except ValueError as error:
            self._log.fault(row.name, error_line(error))
        self._waiting[row.name].put(stamp_ns, content)

    def take(self, row: ImageInput, stamp_ns: int, image: Image, dropped: Container[int]) -> Any:
        """The input for an image; reports a missing one, and those that belong to no image.

        Args:
            image: (H, W, 3).
            dropped: stamps of images that were dropped, whose inputs are not missed.

        Returns:
            Content of its stamp; None: no message, or one without content.
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
