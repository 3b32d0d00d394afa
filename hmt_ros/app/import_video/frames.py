"""Frames of a video file or of a folder of images, with their times; masks of the person."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hmt_ros.inference.arrays import Image, Mask
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.display_matrix import (
    IDENTITY,
    ROTATIONS,
    display_matrix,
    is_mirrored,
    is_turned,
    shown,
)
from msg_tools.files.video_file import check_size, open_video
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.images import decode_picture, decoded

IMAGE_SUFFIXES = ('.jpg', '.jpeg', '.png', '.bmp', '.tif', '.tiff', '.webp', '.ppm', '.pgm')
MAX_IMAGE_BYTES = 2**28  # maximum size, bytes
MAX_FRAMES = 1e9  # maximum number of frames; a larger number in the header is a sign of damage
MAX_FPS = 1000.0  # maximum frames per second; a higher rate in the container is a sign of damage
_EXIF_BYTES = 2**16  # number of bytes at the start of a JPEG that are searched for Exif data
_MASK_THRESHOLD = 127  # threshold of masks, grey levels
_MAX_SIDE_RATIO, _MIN_SIDE_RATIO = (
    0.99,
    0.1,
)  # limits of the ratio of a pixel's shorter side to its longer side
# OpenCV 4.6, which Ubuntu 24.04 ships, reports the rotation of a video with the wrong sign.
_HAS_REVERSED_ROTATION = cv2.__version__.startswith('4.6.')


@dataclass(frozen=True)
class Frame:
    """A frame of a source.

    Attributes:
        number: number of the frame in the source, from 0.
        time_ns: time since the first frame of the source, ns.
        name: name of the image file; '' in a video.
        image: (H, W, 3) upright image, BGR.
        jpeg: content of the image file if it is a JPEG of the same upright image; None otherwise.
        aspect: width of a pixel over its height.
    """

    number: int
    time_ns: int
    name: str
    image: Image
    jpeg: bytes | None = None
    aspect: float = 1.0


@dataclass(frozen=True)
class Selection:
    """A selection of the frames of a source.

    Attributes:
        start, end: times since the first frame of the source, s; the end is not included.
        every: step from one selected frame to the next; the first is at or after `start`.
    """

    start: float = 0.0
    end: float = math.inf
    every: int = 1

    def __post_init__(self) -> None:
        if not self.start < self.end:
            raise ValueError(f'--start {self.start:g} is not before --end {self.end:g}')

    def wanted(self, times_ns: Iterator[int]) -> Iterator[tuple[int, int, bool]]:
        """Yields number and time of each frame before `end`, and whether the frame is selected."""
        first = None
        for number, time_ns in enumerate(times_ns):
            if time_ns >= self.end * SECOND_NS:
                return
            if first is None and time_ns >= self.start * SECOND_NS:
                first = number
            yield number, time_ns, first is not None and (number - first) % self.every == 0


class FrameSource:
    """A source of frames; this base class has no frames and only maps labels to frame numbers.

    Args:
        names: names of the image files in order; empty for a video file.
        first_number: number of the first frame in labels.

    Attributes:
        claimed: number of frames according to the header; 0 if unknown.
        count: number of frames read so far, selected or not.
        ended: whether the last frame was read.
        notes: lines of text for the user about mirrored frames and pixel shapes.
        rate: frames per second; None if unknown.
    """

    rate: float | None = None

    def __init__(self, path: Path, names: tuple[str, ...] = (), first_number: int = 0) -> None:
        self.path = path
        self.names = names
        self.claimed = len(names)
        self.count = 0
        self.ended = False
        self.notes: list[str] = []
        self.first_number = first_number
        self._by_name = {Path(x).stem: i for i, x in reversed([*enumerate(names)])}
        self._by_name |= {x: i for i, x in enumerate(names)}

    def frames(self, selection: Selection) -> Iterator[Frame]:
        """Yields the selected frames; can be called only once.

        Raises:
            ValueError: a frame can not be read.
        """
        return iter(())

    def number_of(self, label: str | int) -> int:
        """Number, from 0, of the frame that a label refers to.

        Args:
            label: file name of the frame, with or without suffix; or a number or a name such as
                walk_000012, whose last number is the frame number, counted from `first_number`.

        Raises:
            ValueError: the label refers to no frame.
        """
        name = Path(str(label))
        for known in (name.name, name.stem):
            if known in self._by_name:
                return self._by_name[known]
        digits = re.findall(r'\d+', name.stem)
        if not digits:
            raise ValueError(f'{label} is not the name of a frame and has no number')
        number = int(digits[-1]) - self.first_number
        if number < 0:
            raise ValueError(
                f'{label} is before the first frame, which has the number {self.first_number}'
            )
        return number


def open_source(path: Path, fps: float | None, first_number: int = 0) -> FrameSource:
    """Opens a video file or a folder of images.

    Args:
        fps: frames per second; None uses the times in the video file.

    Raises:
        ValueError: the file or folder is missing or has no frames.
    """
    if path.is_dir():
        return ImageFolder(path, fps, first_number)
    if not path.is_file():
        raise ValueError(f'{path}: no such file; wanted a video file or a folder of images')
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise ValueError(f'{path} is one image; wanted a video file or a folder of images')
    return VideoFile(path, fps, first_number)


class VideoFile(FrameSource):
    """A video file; frames are rotated and mirrored according to its metadata, as in players.

    Args:
        fps: frames per second; None uses the times in the file.
    """

    def __init__(self, path: Path, fps: float | None, first_number: int = 0) -> None:
        super().__init__(path, first_number=first_number)
        self._capture = open_video(path)
        # Versions of OpenCV differ in whether and in which direction they rotate frames.
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        angle = round(self._capture.get(cv2.CAP_PROP_ORIENTATION_META))
        turned = ROTATIONS.get((-angle if _HAS_REVERSED_ROTATION else angle) % 360, IDENTITY)
        self._matrix = display_matrix(path) or turned
        if is_mirrored(self._matrix):
            self.notes.append(
                f'{path}: its metadata mirror the frames; they are imported as players show '
                'them, so left and right of the person are exchanged if the file is correct '
                'without mirroring'
            )
        across = self._capture.get(cv2.CAP_PROP_SAR_NUM)
        down = self._capture.get(cv2.CAP_PROP_SAR_DEN)
        if is_turned(self._matrix):
            across, down = down, across
        self._aspect = 1.0
        if (
            _MIN_SIDE_RATIO * max(across, down)
            < min(across, down)
            < _MAX_SIDE_RATIO * max(across, down)
        ):
            self._aspect = across / down
            self.notes.append(
                f'{path}: pixels are {self._aspect:.3g} times as wide as high: frames are kept '
                'as stored, and a field of view refers to the picture that players show'
            )
        self._fps = fps
        self.rate = fps or self._capture.get(cv2.CAP_PROP_FPS) or None
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.claimed = int(count) if 0 < count < MAX_FRAMES else 0

    def frames(self, selection: Selection) -> Iterator[Frame]:
        """See `FrameSource`."""
        try:
            for number, time_ns, wanted in selection.wanted(self._times()):
                if not wanted:
                    continue
                check_size(self._capture, self.path)
                done, image = self._capture.retrieve()
                if not done:
                    raise ValueError(f'{self.path}: frame {number} can not be decoded')
                upright = shown(np.asarray(image, dtype=np.uint8), self._matrix)
                yield Frame(number, time_ns, '', upright, None, self._aspect)
        finally:
            self._capture.release()

    def _times(self) -> Iterator[int]:
        """Yields the time of each frame, ns; decode the frame before requesting the next time."""
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        first, last = 0.0, -1
        while self._capture.grab():
            time = self._capture.get(cv2.CAP_PROP_POS_MSEC)
            if self.count == 0:
                first = time
            time_ns = round((time - first) * 1e6)
            if self._fps is not None:
                time_ns = round(self.count * SECOND_NS / self._fps)
            elif time_ns <= last:
                # Times are 0 in containers without times, and can decrease in damaged containers.
                if not 0 < fps <= MAX_FPS:
                    raise ValueError(
                        f'{self.path} has neither timestamps nor a frame rate; give --fps'
                    )
                time_ns = last + round(SECOND_NS / fps)
            last = time_ns
            self.count += 1
            yield time_ns
        self.ended = True


class ImageFolder(FrameSource):
    """A folder of images, in the order of the numbers in their names.

    Args:
        fps: images per second; None allows only `frame`, not `frames`.
    """

    def __init__(self, path: Path, fps: float | None, first_number: int = 0) -> None:
        files = [x for x in path.iterdir() if x.suffix.lower() in IMAGE_SUFFIXES and x.is_file()]
        if not files:
            raise ValueError(f'{path} has no images, wanted files {" ".join(IMAGE_SUFFIXES)}')
        self._files = sorted(files, key=lambda x: natural_order(x.name))
        super().__init__(path, tuple(x.name for x in self._files), first_number)
        self._fps = self.rate = fps

    def frames(self, selection: Selection) -> Iterator[Frame]:
        """See `FrameSource`."""
        if self._fps is None:
            raise ValueError(f'{self.path} is a folder of images: give their rate with --fps')
        step = SECOND_NS / self._fps
        times = (round(i * step) for i in range(len(self._files)))
        for number, time_ns, wanted in selection.wanted(times):
            self.count = number + 1
            if wanted:
                yield self.frame(number, time_ns)
        self.ended = self.count == len(self._files)

    def frame(self, number: int, time_ns: int = 0) -> Frame:
        """Reads an image of the folder.

        Raises:
            ValueError: the image can not be read.
        """
        file = self._files[number]
        try:
            content = read_bytes(file, MAX_IMAGE_BYTES)
            image, jpeg = _upright(content)
        except ValueError as error:
            raise ValueError(f'{file}: {error}') from error
        return Frame(number, time_ns, file.name, image, jpeg)


def _upright(content: bytes) -> tuple[Image, bytes | None]:
    """The upright image in a file, and the file content if it is a JPEG that needs no rotation."""
    if content.startswith(b'\xff\xd8\xff'):
        as_stored = decode_picture(content, 'jpeg')
        if b'Exif\0' not in content[:_EXIF_BYTES]:
            return as_stored, content
        image = decoded(content)
        same = image.shape == as_stored.shape and np.array_equal(image, as_stored)
        return image, content if same else None
    png = content.startswith(b'\x89PNG')
    return decode_picture(content) if png else decoded(content), None


def natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key that orders names by their numbers, frame_9 before frame_10."""
    parts = re.findall(r'\d+|\D+', name)
    return [(int(x), '') if x.isdecimal() else (-1, x) for x in parts]


class Masks:
    """Masks that belong to the frames of a source.

    In a folder of masks, the file name identifies the frame (`FrameSource.number_of`); in a video
    of masks, the frame number is the same.

    Raises:
        ValueError: no masks, a file name without a frame, or two masks of one frame.
    """

    def __init__(self, path: Path, source: FrameSource) -> None:
        opened = open_source(path, fps=1.0)
        self._path = path
        self._folder = opened if isinstance(opened, ImageFolder) else None
        self._files: dict[int, int] = {}
        self._video: Iterator[Frame] = iter(())
        if self._folder is None:
            self._video = opened.frames(Selection())
            return
        for i, name in enumerate(opened.names):
            try:
                number = source.number_of(name)
            except ValueError as error:
                raise ValueError(f'{path}: {error}; wanted a name such as 000012.png') from error
            if number in self._files:
                raise ValueError(
                    f'{path}: {name} and {opened.names[self._files[number]]} both belong to frame '
                    f'{number}'
                )
            self._files[number] = i

    @property
    def last(self) -> int:
        """Number of the last frame that has a mask; -1 without masks, or for a video."""
        return max(self._files, default=-1)

    def of(self, frame: Frame) -> Mask | None:
        """The mask (H, W) of a frame, or None; call it with increasing frame numbers.

        Raises:
            ValueError: mask and frame differ in size, or the mask covers the whole image.
        """
        found = self._found(frame.number)
        if found is None:
            return None
        mask = mask_in(found.image)
        name = found.name or f'frame {found.number}'
        (height, width), (rows, columns) = mask.shape, frame.image.shape[:2]
        if (height, width) != (rows, columns):
            raise ValueError(
                f'{self._path}: mask {name} has {width}x{height} pixels, wanted the '
                f'{columns}x{rows} of its frame'
            )
        if mask.all():
            raise ValueError(
                f'{self._path}: mask {name} is zero nowhere, wanted zero where the person is not'
            )
        return mask

    def _found(self, number: int) -> Frame | None:
        if self._folder is not None:
            return self._folder.frame(self._files[number]) if number in self._files else None
        return next((x for x in self._video if x.number == number), None)


def mask_in(image: Image) -> Mask:
    """Converts the image (H, W, 3) of a mask to a boolean mask (H, W) of the person.

    A pixel is True if its brightest channel exceeds 127, or 0 in an image of zeros and ones.
    """
    brightest = image.max(2)
    result: Mask = brightest > (_MASK_THRESHOLD if brightest.max() > 1 else 0)
    return result
