"""Clips with known truth: a bag of images, and beside it subject file, empty scene and truth."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.truth import read_truth
from hmt_ros.body import Camera
from hmt_ros.evaluation.track_scores import Truth
from msg_tools import BagReader
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).resolve().parents[1]
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
IMAGES = (COMPRESSED, 'sensor_msgs/msg/Image')


@dataclass(frozen=True, eq=False)
class Clip:
    """Images of one person.

    Attributes:
        folder: where the files are.
        camera: that saw it.
        stamps: (T,) ns.
        images: (T,) BGR.
        truth: where the joints were.
        pixels: stamp -> (J, 2) true image positions of the joints of `truth`.
        background: the empty scene.
    """

    folder: Path
    camera: Camera
    stamps: list[int]
    images: list[NDArray[np.uint8]]
    truth: Truth
    pixels: dict[int, NDArray[np.float64]]
    background: NDArray[np.uint8]

    @property
    def name(self) -> str:
        """Of the clip."""
        return self.folder.name

    @property
    def subject(self) -> Path:
        """The subject file."""
        return self.folder / 'subject.yaml'

    def back_and_forth(self, frames: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """So many images with increasing stamps: to the end, back to the start, and again."""
        step = self.stamps[1] - self.stamps[0]
        for i in range(frames):
            yield self.stamps[0] + i * step, self.images[index_back_and_forth(i, len(self.images))]


def index_back_and_forth(number: int, count: int) -> int:
    """Index of what is shown as the number-th, of so many that are shown to the end and back."""
    turn = max(2 * count - 2, 1)
    return min(number % turn, turn - number % turn)


def find_clips(folder: Path | None) -> tuple[list[Path], str]:
    """Folders of clips with truth, and where they come from.

    Args:
        folder: that holds the clips; None: the development data, and where that is absent the
            bags of this repository.

    Raises:
        ValueError: there are none.
    """
    if folder is not None:
        return _clips_in(folder), str(folder)
    shared = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'video'
    if shared.is_dir():
        return _clips_in(shared), 'development clips'
    return _clips_in(ROOT / 'bags'), f'bags/ of the repository, as {shared.resolve()} is absent'


def _clips_in(folder: Path) -> list[Path]:
    wanted = ('metadata.yaml', 'truth.npz', 'subject.yaml', 'background.png')
    found = [
        path
        for path in (sorted(folder.iterdir()) if folder.is_dir() else [])
        if all((path / name).is_file() for name in wanted)
    ]
    if not found:
        raise ValueError(f'{folder} has no folder with {", ".join(wanted)}')
    return found


def read_messages(
    folder: Path, kinds: Sequence[str] = IMAGES, frames: int | None = None
) -> tuple[Any, list[Any]]:
    """Calibration and images of a clip as they are in its bag, or the first of them.

    Raises:
        ValueError: a bag that can not be read, or with no such topics.
    """
    with BagReader(folder) as bag:
        topic = bag.find_topic(kinds).name
        info = next(bag.messages([bag.find_topic(['sensor_msgs/msg/CameraInfo']).name])).message
        return info, [stored.message for stored in islice(bag.messages([topic]), frames)]


def read_clip(folder: Path, frames: int | None = None) -> Clip:
    """Reads a clip, or its first frames.

    Raises:
        ValueError: files that can not be read, or that do not fit each other.
    """
    info, messages = read_messages(folder, frames=frames)
    stamps = [time_ns(message.header.stamp) for message in messages]
    images = [decode_image(message) for message in messages]
    background = cv2.imread(str(folder / 'background.png'))
    if background is None:
        raise ValueError(f'{folder / "background.png"} is no image')
    height, width = images[0].shape[:2]
    with np.load(folder / 'truth.npz') as content:
        pixels = dict(zip(map(int, content['stamps']), np.array(content['pixels']), strict=True))
    return Clip(
        folder,
        camera_from_info(info, (width, height)),
        stamps,
        images,
        read_truth(folder / 'truth.npz'),
        pixels,
        background,
    )


def table(rows: list[list[str]], *, left: int = 1, markdown: bool = False) -> str:
    """A table whose first row is its head; so many columns are aligned to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]

    def line(cells: list[str], separator: str) -> str:
        aligned = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return separator.join(aligned)

    if not markdown:
        return '\n'.join(line(row, '  ').rstrip() for row in rows)
    rule = ['-' * width if i < left else '-' * (width - 1) + ':' for i, width in enumerate(widths)]
    return '\n'.join(f'| {line(row, " | ")} |' for row in [rows[0], rule, *rows[1:]])


def rounded(value: Any) -> Any:
    """Numbers of a report with four digits that mean something."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(f'{value:.4g}')
    return value
