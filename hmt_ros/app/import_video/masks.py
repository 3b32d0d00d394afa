"""Masks of the person, from a folder of images or a video, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hmt_ros.app.import_video.frames import (
    Frame,
    FrameSource,
    ImageFolder,
    Selection,
    open_source,
)
from hmt_ros.inference.arrays import Image, Mask

_HALF = 127  # grey levels


class Masks:
    """Masks that belong to the frames of a source.

    In a folder a mask belongs to the frame that its file name means (`FrameSource.number_of`); in a
    video, to the frame of the same number.

    Args:
        path: folder or video file.
        source: whose frames they belong to.

    Raises:
        ValueError: there are none.
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
        """Number of the last frame that has a mask; -1: none has, as far as one knows yet."""
        return max(self._files, default=-1)

    def of(self, frame: Frame) -> Mask | None:
        """The mask (H, W) of a frame, whose numbers must rise; None: there is none.

        Raises:
            ValueError: it has another size than the frame, or does not tell person from scene.
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
    """(H, W) where a picture (H, W, 3) shows the person.

    That is where its brightest channel is above 127, or above 0 in a picture of zeros and ones.
    """
    brightest = image.max(2)
    result: Mask = brightest > (_HALF if brightest.max() > 1 else 0)
    return result
