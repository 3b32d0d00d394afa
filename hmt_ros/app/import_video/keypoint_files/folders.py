"""Reads folders with one file per frame: JSON, for example of OpenPose, or Ultralytics labels."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hmt_ros.app.import_video.frames import FrameSource, natural_order
from hmt_ros.app.import_video.keypoint_files.json_layouts import frames_in, person_in
from hmt_ros.app.import_video.keypoint_files.persons import (
    MAX_FRAMES,
    FoundPersons,
    numbers_of,
    orders_of,
    person,
)
from hmt_ros.image.keypoint_schemes import unnamed_orders
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.plain_json import read_plain_json

MAX_FILE_BYTES, MAX_LABELS_BYTES = 2**24, 2**20  # maximum size of the file of a frame, bytes
_BOX_VALUES = 5  # number of values before the keypoints: class, centre and size of a box
# File names of video frames, which Ultralytics numbers from 1.
_VIDEO_FRAME_NAME = re.compile(r'.*_[1-9]\d*')


def read_folder(path: Path, source: FrameSource) -> FoundPersons:
    """Reads files such as walk_000000000012_keypoints.json, or walk_13.txt.

    Raises:
        ValueError: the folder has no such files, or their format is unknown.
    """
    files = [x for x in path.iterdir() if x.suffix in ('.json', '.txt') and x.is_file()]
    kind = '.json' if any(x.suffix == '.json' for x in files) else '.txt'
    files = sorted((x for x in files if x.suffix == kind), key=lambda x: natural_order(x.name))
    if not files or len(files) > MAX_FRAMES:
        raise ValueError(
            'no .json files in this folder, wanted those that OpenPose or MMPose write, or the '
            'labels (.txt) of Ultralytics'
        )
    found = FoundPersons(path)
    stems = [x.stem.removesuffix('_keypoints') for x in files]
    from_one = kind == '.txt' and all(map(_VIDEO_FRAME_NAME.fullmatch, stems))
    numbers = numbers_of(stems, source, from_one=from_one)
    for file, number in zip(files, numbers, strict=True):
        if number in found.frames:
            raise ValueError(f'{file.name} is the second file of frame {number}')
        found.add(number, None)
        try:
            if kind == '.txt':
                _add_labels(found, file, number)
                continue
            for _, entries in frames_in(read_plain_json(file, MAX_FILE_BYTES), number):
                for entry in entries:
                    found.add(number, person_in(found, entry, 'a person'))
        except ValueError as error:
            raise ValueError(f'{file.name}: {error}') from error
    return found


def _add_labels(found: FoundPersons, file: Path, number: int) -> None:
    """Adds persons from lines of class, box, keypoints as fractions, confidence, and track."""
    text = read_bytes(file, MAX_LABELS_BYTES).decode('utf-8', 'replace')
    for i, line in enumerate(text.split('\n')):
        try:
            values = np.array(line.split(), dtype=np.float64)
        except ValueError as error:
            raise ValueError(f'line {i + 1} has other text than numbers') from error
        if not values.size or values[0] != 0:
            continue
        more = len(values) - _BOX_VALUES
        layouts = [
            (count, width, more - count * width)
            for count in (17, *unnamed_orders())
            for width in (3, 2)
            if 0 <= more - count * width <= 2
        ]
        if not layouts:
            raise ValueError(
                f'line {i + 1} has {len(values)} numbers, wanted class, box and keypoints: '
                'labels of a model for poses, such as yolo11n-pose'
            )
        count, width, rest = layouts[0]
        orders_of(count)
        found.unnamed, found.fractions = count, True
        points = values[_BOX_VALUES : _BOX_VALUES + count * width].reshape(count, width)
        tail = [*values[len(values) - rest :]] if rest else []
        track = str(int(tail.pop())) if tail and tail[-1] >= 1 and tail[-1].is_integer() else ''
        seen = person(
            None,
            points[:, :2],
            points[:, 2] if width == 3 else None,
            track=track,
            score=tail[0] if tail else 1.0,
        )
        found.add(number, seen)
