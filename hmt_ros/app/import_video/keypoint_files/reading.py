"""Reads the output of a detector in any known format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.arrays import read_arrays
from hmt_ros.app.import_video.keypoint_files.choice import Choice, chosen_person
from hmt_ros.app.import_video.keypoint_files.clip_check import check_clip, check_steps
from hmt_ros.app.import_video.keypoint_files.folders import read_folder
from hmt_ros.app.import_video.keypoint_files.json_layouts import MAX_FILE_BYTES, add_json
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons
from hmt_ros.app.import_video.keypoint_files.tables import read_table
from hmt_ros.app.progress import Notify
from hmt_ros.body.skeleton import other_side
from hmt_ros.image.keypoint_schemes import AUTO
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools.files.error_line import error_line
from msg_tools.files.plain_json import read_plain_json

_MAX_COORDINATE = 1e5  # maximum coordinate of a keypoint, px


@dataclass(frozen=True)
class ClipReading:
    """Options for reading the keypoints of a clip.

    Attributes:
        person: choice of the person.
        scheme: order of points without names; `AUTO` selects the order that fits people.
        points_size: width and height of the images in which the points were found, px.
        mirror: whether the images are mirror images.
    """

    person: Choice = Choice()  # noqa: RUF009 - frozen
    scheme: str = AUTO
    points_size: tuple[int, int] | None = None
    mirror: bool = False


def read_keypoints(path: Path, source: FrameSource, first_stamp_ns: int) -> FoundPersons:
    """Reads the output of a detector for the frames of a source.

    Args:
        first_stamp_ns: stamp of the first frame, which is subtracted from stamps in the file.

    Raises:
        ValueError: the file is missing or unreadable, or has an unknown format or inconsistent
            content.
    """
    kind = path.suffix.lower()
    try:
        if path.is_dir():
            found = read_folder(path, source)
        elif not path.is_file():
            raise ValueError('no such file')
        elif kind == '.json':
            found = FoundPersons(path)
            add_json(found, read_plain_json(path, MAX_FILE_BYTES), source)
        elif kind == '.npz':
            found = read_arrays(path)
        elif kind in ('.csv', '.trc'):
            found = read_table(path, source, first_stamp_ns)
        else:
            raise ValueError(
                f"{path.suffix or 'a file without suffix'} is not known; wanted a detector's "
                '.json, .npz, .csv or .trc, or a folder with a file for each frame'
            )
        farthest = max((float(np.nanmax(np.abs(x.box))) for x in found.persons()), default=0.0)
        if farthest > _MAX_COORDINATE:
            raise ValueError(f'a keypoint lies {farthest:g} px away, wanted positions in an image')
        for names in {x.keypoints.names for x in found.persons()}:
            if len({*names}) < len(names):
                twice = next(x for x, other in pairwise(sorted(names)) if x == other)
                raise ValueError(f'two keypoints are called {twice}')
    except (ValueError, RecursionError) as error:
        raise ValueError(f'{path}: {error_line(error)}') from error
    return found


def keypoints_of_person(
    found: FoundPersons,
    reading: ClipReading,
    size: tuple[int, int],
    notify: Notify,
    first: int = 0,
    rate: float | None = None,
) -> dict[int, Keypoints]:
    """Keypoints of the chosen person by frame key, in pixels of the images.

    Args:
        size: width and height of the images, px.
        first: key of the first frame.
        rate: frames per second; None if unknown.

    Raises:
        ValueError: the clip is inconsistent, or has no such person; the message names a remedy.
    """
    notices: list[str] = []
    check_clip(found, size, notices.append, scheme=reading.scheme, points_size=reading.points_size)
    try:
        chosen = chosen_person(found, reading.person, first, rate)
        check_steps([chosen[key] for key in sorted(chosen)])
    except ValueError as error:
        raise ValueError(f'{found.path}: {error_line(error)}') from error
    for text in notices:
        notify(text)
    return {
        key: mirrored(one.keypoints, size[0]) if reading.mirror else one.keypoints
        for key, one in chosen.items()
    }


def mirrored(keypoints: Keypoints, width: int) -> Keypoints:
    """Converts keypoints of a mirrored image, `width` px wide, to keypoints of the original."""
    positions = keypoints.positions
    return replace(
        keypoints,
        names=tuple(other_side(x) for x in keypoints.names),
        pixels=np.array([width - 1.0, 0.0]) + keypoints.pixels * (-1.0, 1.0),
        positions=None if positions is None else positions * (-1.0, 1.0, 1.0),
    )
