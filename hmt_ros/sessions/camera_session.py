"""Sessions that estimate from the images of one camera.

Images are used in the order of their stamps. They wait for the first calibrated camera_info and for
other inputs (`image_inputs`); if more than `MAX_INCOMPLETE_IMAGES` images wait, the oldest are
dropped. A session is late if messages have arrived during an estimate while further images waited.
It then uses only the newest `queue_size` of the images whose other inputs have arrived.

If the parameters name a frame, an image also waits for the transforms of its stamp. The wait ends
when an image or a transform that is `input_timeout` younger arrives, or when the image would have
to be dropped. If transforms are missing, the last known gravity is used, and the camera is assumed
to continue its motion.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Camera
from hmt_ros.image.background import BackgroundModel, SceneWatch
from hmt_ros.inference.arrays import Image, Mask
from hmt_ros.sessions.camera_frames import CameraFrames
from hmt_ros.sessions.declared_parameters import CameraNodeParameters
from hmt_ros.sessions.image_inputs import (
    DEPTH,
    DETECTIONS,
    MASK,
    MASK_INPUT,
    MAX_SMALL_INPUTS,
    ImageInput,
    ImageInputs,
)
from hmt_ros.sessions.named_file import named_file
from hmt_ros.sessions.session import NeededInput, Session, SessionState, State
from hmt_ros.sessions.stamp_order import Turn
from hmt_ros.sessions.transform_buffer import TF_STATIC, TRANSFORMS
from msg_tools.files.bounded_file import read_bytes
from msg_tools.messages.camera_info import CameraInfoError, UncalibratedError, camera_from_info
from msg_tools.messages.detections import stamp_of_floats
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.images import ImageError, decode_picture

CAMERA_INFO, IMAGE = 'camera_info', 'image'
CAMERA_MOVED_FAULT = 'the camera has moved since the background was taken'
PERSON_IN_BACKGROUND_FAULT = 'the background was learned with the person in it'
FRAME_ID = 'camera_optical_frame'  # default if neither image nor camera_info names a frame

CameraParameters = TypeVar('CameraParameters', bound=CameraNodeParameters)

# Maximum number of images that wait for other inputs: half a second at a common image rate.
MAX_INCOMPLETE_IMAGES = 16
# Maximum total size of the waiting images, bytes.
MAX_INCOMPLETE_BYTES = 2**29
_MAX_PICTURE_BYTES = 2**28  # bytes
# Maximum time from an image to a later input that ends the wait for the missing input, s;
# `input_timeout` replaces it if longer.
_MIN_LEAD_TIME = 1.0
# Maximum number of remembered frame names per source; a camera uses one name.
_MAX_FRAMES = 8


class WaitingImage(NamedTuple):
    """An image that was received.

    Attributes:
        image: (H, W, 3) BGR.
        stamp_ns: stamp of the image, ns.
        frame_id: optical frame of the camera.
        given: content of the inputs for the image, by name; None: no content.
    """

    image: Image
    stamp_ns: int
    frame_id: str
    given: Mapping[str, Any] = MappingProxyType({})

    def content(self, name: str) -> Any:
        """Return the content of an input for the image; None if missing."""
        return self.given.get(name)

    @property
    def mask(self) -> Mask | None:
        """Mask (H, W) of the person from a segmenter; empty if nobody was seen, None if unknown."""
        return self.content(MASK)

    @property
    def depth(self) -> NDArray[np.float32] | None:
        """Depth of the surface at each pixel, (H, W) m; None if unknown."""
        return self.content(DEPTH)


@dataclass(frozen=True)
class CameraState(SessionState):
    """State of a session that estimates from images.

    Attributes:
        moved: whether the camera has moved since the background was taken.
    """

    moved: bool = False

    def trouble(self) -> str:
        """Return why the background is unusable; '' if it is usable."""
        return CAMERA_MOVED_FAULT if self.moved else ''


class CameraSession(Session[CameraParameters, State]):
    """A session that estimates from images; see `Session` for arguments and attributes.

    Attributes:
        rows: inputs that may accompany the images.
        frames: frames that transforms relate to the camera; without a named frame, transforms are
            not used.
    """

    COUNTED = IMAGE
    UNIT = 'image'

    def _set_up(self) -> None:
        self._camera: Camera | None = None
        self._frame = ''
        self._named_frames: dict[str, list[str]] = {IMAGE: [], CAMERA_INFO: []}
        self.frames = CameraFrames()
        self._uncalibrated = ''
        self._watch = SceneWatch()
        self._waiting: deque[WaitingImage] = deque()
        self._newest: int | None = None
        self.rows = self.inputs_of(self.parameters)
        self._inputs = ImageInputs(self.rows, self._log)
        # Messages of `floats` without a stamp get the stamp of the newest camera_info.
        self._floats, self._info_stamp = self.parameters.source == 'floats', 0
        # Number of images since the last estimate; whether an interruption left images waiting;
        # stamps of dropped images.
        self._fresh = 0
        self._left = False
        self._dropped: deque[int] = deque(maxlen=MAX_SMALL_INPUTS)

    def needed_inputs(self) -> list[NeededInput]:
        """Inputs that are needed at present. Thread-safe."""
        needed = super().needed_inputs()
        if self._camera is None and not self._uncalibrated:
            needed.append(NeededInput((CAMERA_INFO,)))
        needed += [NeededInput(tuple(row.types), with_each=True) for row in self._awaited()]
        if self.frames.wanted and not self.frames.heard:
            needed.append(NeededInput(TRANSFORMS))
        return needed

    @classmethod
    def inputs_of(cls, parameters: Any) -> tuple[ImageInput, ...]:
        """Return the inputs that may accompany the images, given the parameters."""
        return (MASK_INPUT,)

    def _awaited(self) -> list[ImageInput]:
        """Return the inputs that images wait for."""
        return [row for row in self.rows if row.is_used(self.parameters)]

    @abstractmethod
    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        """Estimates from an image; its size has been checked."""

    @abstractmethod
    def _status(self) -> tuple[str, str]:
        """Return `status` and `wants` of the state, once the camera is known."""

    @property
    def most_waiting(self) -> int:
        """See `Session`."""
        size = self.parameters.queue_size
        return max(size, MAX_INCOMPLETE_IMAGES) if self._awaited() or self.frames.wanted else size

    def _drop(self, stamp_ns: int) -> None:
        self._dropped.append(stamp_ns)
        super()._drop(stamp_ns)

    def _is_ready(self, waiting: WaitingImage) -> bool:
        """Whether an image waits for nothing but a camera_info."""
        return self._missing(waiting.stamp_ns) is None and self._has_transforms(waiting)

    def _missing(self, stamp: int) -> ImageInput | None:
        """Return the first input that an image waits for; None if it waits for none."""
        within = max(self.parameters.input_timeout, _MIN_LEAD_TIME) * SECOND_NS
        for row in self._awaited():
            if not self._inputs[row.name].is_settled(stamp, within) and not self._is_overdue(stamp):
                return row
        return None

    def _is_overdue(self, stamp: int) -> bool:
        """Whether an image has waited for `input_timeout`."""
        assert self._newest is not None
        return self._newest - stamp > self.parameters.input_timeout * SECOND_NS

    def _has_transforms(self, waiting: WaitingImage) -> bool:
        """Whether an image has its transforms, or no longer waits for them."""
        if not self.frames.wanted or len(self._waiting) > self.most_waiting:
            return True
        timeout = self.parameters.input_timeout * SECOND_NS
        return self._is_overdue(waiting.stamp_ns) or self.frames.is_settled(
            self._frame_of(waiting), waiting.stamp_ns, timeout
        )

    def _use(self, source: str, turn: Turn) -> None:
        super()._use(source, turn)
        # Messages that were put aside earlier do not make the session late.
        self._fresh -= max(len(turn.use) - 1, 0)

    def _jump_back(self, first: int, last: int) -> None:
        """See `Session`; uses or drops the waiting images, and drops inputs of other times."""
        self._end()
        self._log.counts['dropped'] += len(self._waiting)
        self._waiting.clear()
        self._newest = None
        self._inputs.keep(first, last)
        self.frames.forget_after(last)
        self.restart()

    def _take(self, source: str, message: Any, stamp: int) -> None:
        row = self._inputs.row(source)
        if source in TRANSFORMS and self.frames.wanted:
            for text in self.frames.take(message, static=source == TF_STATIC):
                self._log.note('transform', text)
        elif source == CAMERA_INFO:
            self._take_camera_info(message)
        elif source == IMAGE:
            self._take_image(message, stamp)
        elif row is not None and row in self._awaited():
            self._inputs.put(source, message, stamp, partial(self._read_input, row))

    def _stamp_of(self, source: str, message: Any) -> int:
        if source in TRANSFORMS:
            return max((time_ns(each.header.stamp) for each in message.transforms), default=0)
        if source != DETECTIONS or not self._floats:
            return super()._stamp_of(source, message)
        told = stamp_of_floats(message)
        return self._info_stamp if told is None else told

    def _read_input(self, row: ImageInput, message: Any, stamp: int) -> Any:
        """Return the content of a message, as `ImageInput.read` does."""
        assert row.read is not None
        return row.read(message, stamp)

    def _take_camera_info(self, message: Any) -> None:
        self._info_stamp = time_ns(message.header.stamp)
        self._check_frame_id(CAMERA_INFO, message)
        neglected: list[str] = []
        try:
            camera = camera_from_info(message, notify=neglected.append)
        except CameraInfoError as error:
            text = camera_info_fault(error, self._on_topic(CAMERA_INFO))
            self._uncalibrated = text if self._camera is None else ''
            self._log.fault('camera_info', text)
            return
        self._uncalibrated = ''
        self._frame = str(message.header.frame_id)
        known, self._camera = self._camera, camera
        if camera != known:
            for text in neglected:
                self._log.note('camera_info', text, warn=True)
        if known is not None and camera != known:
            text = f'camera_info changes: {self.ESTIMATE} starts again'
            self._log.note('calibration', text)
            self.restart()

    def _check_frame_id(self, source: str, message: Any) -> None:
        """Warns once about each unexpected frame_id in the messages of a source.

        This reveals two publishers on one topic, or the camera_info of another camera.
        """
        frame, seen = str(message.header.frame_id), self._named_frames[source]
        if not frame or frame in seen or len(seen) == _MAX_FRAMES:
            return
        seen.append(frame)
        images, infos = self._named_frames[IMAGE], self._named_frames[CAMERA_INFO]
        if len(seen) > 1:
            self._log.note(
                'frame_id',
                f'{self._on_topic(source)} has messages of the frames {seen[-2]!r} and {frame!r}: '
                'wanted those of one camera; stop or remap one of the publishers',
                warn=True,
            )
        elif images and infos and frame not in (images if source == CAMERA_INFO else infos):
            self._log.note(
                'frame_id',
                f'{self._on_topic(IMAGE)} has frame_id {images[-1]!r}, '
                f'{self._on_topic(CAMERA_INFO)} has {infos[-1]!r}: results are in the frame of '
                'the image; if both belong to one camera, set one frame_id in its driver, else '
                'remap camera_info',
                warn=True,
            )

    def _take_image(self, message: Any, stamp: int) -> None:
        self._check_frame_id(IMAGE, message)
        try:
            image = self.decode_image(message)
        except ImageError as error:
            self._log.skip('image', str(error))
            return
        self._newest, self._fresh = stamp, self._fresh + 1
        self._waiting.append(WaitingImage(image, stamp, str(message.header.frame_id)))

    def _end(self) -> int:
        """Estimates from all waiting images, as no more inputs will arrive."""
        while self._waiting and self._camera is not None:
            self._estimate_next(self._camera)
        return self._newest or 0

    def _look_at_scene(
        self, waiting: WaitingImage, background: BackgroundModel, remedy: str
    ) -> None:
        """Warns once when the camera has moved; see `camera_moved_fault` for the remedy."""
        before = self._watch.moved
        self._watch.update(waiting.image, background)
        if self._watch.moved and not before:
            text = camera_moved_fault(self._watch.shift, waiting.stamp_ns, remedy)
            self._log.note('camera moved', text, warn=True)

    def _estimate_from_inputs(self) -> None:
        late, self._fresh, self._left = self._left or self._fresh > 1, 0, False
        if self._camera is not None:
            if late:
                self._leave_out_late_images()
            while self._waiting and not self._left and self._is_ready(self._waiting[0]):
                self._estimate_next(self._camera)
                # Messages that have just arrived may change which image is next.
                self._left = bool(self._waiting) and self.interrupted()
        self._drop_incomplete_images()

    def _leave_out_late_images(self) -> None:
        """Of the images that are ready, drops all but the newest `queue_size`."""
        ready = sum(1 for _ in takewhile(self._is_ready, self._waiting))
        for _ in range(ready - self.parameters.queue_size):
            self._drop(self._waiting.popleft().stamp_ns)

    def _drop_incomplete_images(self) -> None:
        most = max(self.parameters.queue_size, MAX_INCOMPLETE_IMAGES)
        size = sum(one.image.nbytes for one in self._waiting)
        while len(self._waiting) > most or (size > MAX_INCOMPLETE_BYTES and len(self._waiting) > 1):
            size -= self._waiting[0].image.nbytes
            stamp = self._waiting.popleft().stamp_ns
            self._dropped.append(stamp)
            if self._camera is None:
                # An uncalibrated camera_info has been reported already.
                self._log.give_up(
                    'camera_info',
                    'a calibrated camera_info',
                    f'image of {stamp} ns is dropped: it waited for a calibrated camera_info',
                )
            else:
                row = self._missing(stamp)
                name = 'transform' if row is None else row.name
                self._log.give_up(
                    f'no {name}',
                    name,
                    f'image of {stamp} ns is dropped: no {name} of its stamp has come, and '
                    f'{len(self._waiting)} newer images wait',
                )

    def _estimate_next(self, camera: Camera) -> None:
        waiting = self._waiting.popleft()
        try:
            check_size(waiting.image, camera)
        except ValueError as error:
            self._log.skip('size of the image', str(error))
            return
        given = {
            row.name: self._inputs.take(row, waiting.stamp_ns, waiting.image, self._dropped)
            for row in self._awaited()
            if not row.together
        }
        frame = self._frame_of(waiting)
        self._estimate(waiting._replace(frame_id=frame, given=given), camera)

    def _frame_of(self, waiting: WaitingImage) -> str:
        """Return the optical frame named by the image or, if it names none, by the camera_info."""
        return waiting.frame_id or self._frame or FRAME_ID

    def _status_and_wants(self) -> tuple[str, str]:
        if self._camera is None:
            why = f'; {self._uncalibrated}' if self._uncalibrated else ''
            return 'no camera', f'a calibrated camera_info{why}'
        return self._status()


def camera_info_fault(error: CameraInfoError, source: str) -> str:
    """Return an error message about a camera_info, with the remedy."""
    text = f'{source}{str(error).removeprefix("camera info")}'
    if isinstance(error, UncalibratedError):
        return f'{text}; calibrate the camera, and let its driver publish the result'
    return text


def camera_moved_fault(shift: float, stamp_ns: int, remedy: str) -> str:
    """Return a warning that the camera has moved, with the remedy.

    Args:
        shift: shift of the scene, px; NaN: unknown.
        remedy: advice to the user on how to take a new background.
    """
    far = 'elsewhere' if math.isnan(shift) else f'{shift:.0f} px away'
    return (
        f'{CAMERA_MOVED_FAULT}: at the image of {stamp_ns} ns the scene is {far}; fix the camera, '
        f'take background_file again, or let the background be learned, and {remedy}'
    )


def check_size(image: Image, camera: Camera) -> None:
    """Raises ValueError if an image does not have the size of the camera."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise ValueError(
            f'image has {width}x{height} pixels, wanted the {camera.width}x{camera.height} of '
            'camera_info'
        )


def read_picture(file: str) -> Image:
    """Read the PNG or JPEG file named by `background_file` as an image (H, W, 3), BGR.

    Raises:
        ValueError: the file is not an image, or is too large.
    """
    with named_file('background_file', file, 'PNG or JPEG image'):
        try:
            return decode_picture(read_bytes(file, _MAX_PICTURE_BYTES))
        except ImageError as error:
            raise ValueError(f'{file}: not a picture ({error})') from error
        except ValueError as error:
            raise ValueError(f'{file}: {error}') from error
