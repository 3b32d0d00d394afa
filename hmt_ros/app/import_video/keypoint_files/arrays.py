"""Archives of arrays (.npz): those of import-video --help, and those of VideoPose3D."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, image_size_of, person
from hmt_ros.image.keypoint_schemes import schemes
from msg_tools.files.array_file import read_archive
from msg_tools.files.budget import Budget

_MOST_CLIPS = 10_000
_LARGEST = 2**28  # bytes; an archive of an hour has 10**8
_RECORDS = 10  # that a person counts for
# Names of the orders of points in the metadata of VideoPose3D.
_LAYOUTS = {'coco': 'coco17', 'h36m': 'h36m17'}


def read_arrays(path: Path) -> FoundPersons:
    """Row t of each array is frame t.

    Raises:
        ValueError: no archive, no keypoints in it, or arrays that do not fit each other.
    """
    content = read_archive(path, _LARGEST, with_objects=True)
    budget = Budget(path.stat().st_size)
    if 'positions_2d' in content:
        return _positions(path, content, budget)
    if 'pixels' not in content:
        raise ValueError('no array pixels; wanted pixels and landmark_names, or positions_2d')
    given = content.get('landmark_names')
    rows, n = (*content['pixels'].shape, 0, 0)[:2]
    n = n if given is None else given.size
    names = None if given is None else tuple(given.flat)
    if names is not None and not all(isinstance(x, str) for x in names):
        raise ValueError('landmark_names holds other things than texts')
    budget.spend(records=_RECORDS * rows)
    shapes = {
        'pixels': (rows, n, 2),
        'visibility': (rows, n),
        'world': (rows, n, 3),
        'detected': (rows,),
    }
    for name, shape in shapes.items():
        if name in content and content[name].shape != shape:
            raise ValueError(f'{name} has shape {content[name].shape}, wanted {shape}')
        if name in content and content[name].dtype.kind not in 'fiub':
            raise ValueError(f'{name} holds {content[name].dtype}, wanted numbers')
    detected = content.get('detected', np.ones(rows, dtype=bool))
    sure, world = content.get('visibility'), content.get('world')
    found = FoundPersons(path, rows=rows, unnamed=n if names is None else 0)
    for t in range(rows if n else 0):
        seen = None
        if detected[t]:
            seen = person(
                names,
                content['pixels'][t],
                None if sure is None else sure[t],
                None if world is None else world[t],
            )
        found.add(t, seen)
    return found


def _positions(path: Path, content: dict[str, NDArray[Any]], budget: Budget) -> FoundPersons:
    """The clips of VideoPose3D: positions_2d[SUBJECT][ACTION][CAMERA] is (T, n, 2) px.

    Each clip is a person whose name is that of the clip.
    """
    about = _object(content.get('metadata'))
    clips = dict(islice(_clips(_object(content['positions_2d'])), _MOST_CLIPS))
    # One array may stand for many clips.
    budget.spend(records=_RECORDS * sum(map(len, clips.values())))
    if not clips:
        raise ValueError('positions_2d has no arrays; wanted {SUBJECT: {ACTION: [(T, n, 2)]}}')
    rows, n = (max(x.shape[i] for x in clips.values()) for i in range(2))
    layout = about.get('layout_name')
    scheme = schemes().get(_LAYOUTS.get(layout, '') if isinstance(layout, str) else '')
    names = scheme.names if scheme is not None and len(scheme.names) == n else None
    found = FoundPersons(
        path, rows=rows, unnamed=n if names is None else 0, size=_size(about), clips=len(clips)
    )
    for clip, points in clips.items():
        for t, places in enumerate(points):
            sure = places[:, 2] if points.shape[2] == 3 else None
            found.add(t, person(names, places[:, :2], sure, track=clip))
    return found


def _object(array: Any) -> dict[Any, Any]:
    """The dictionary that an array holds; an empty one if it holds none."""
    held = array.item() if isinstance(array, np.ndarray) and array.size == 1 else None
    return held if isinstance(held, dict) else {}


def _clips(subjects: dict[Any, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Names of clips and their arrays (T, n, 2 or 3)."""
    for subject, actions in subjects.items():
        named = actions.items() if isinstance(actions, dict) else [('', actions)]
        for action, cameras in named:
            several = isinstance(cameras, (list, tuple)) or np.ndim(cameras) == 1
            for i, points in enumerate(cameras if several else [cameras]):
                name = f'{str(subject)[:40]}/{str(action)[:40]}/{i}'
                numbers = isinstance(points, np.ndarray) and points.dtype.kind in 'fiu'
                if not (numbers and points.size and points.ndim == 3 and points.shape[2] in (2, 3)):
                    raise ValueError(f'positions_2d of {name} is no array (T, n, 2) of numbers')
                yield name, points


def _size(about: dict[Any, Any]) -> tuple[int, int] | None:
    """Width and height of the images in metadata of one video; None: not known."""
    videos = about.get('video_metadata')
    one = [*videos.values()] if isinstance(videos, dict) else []
    known = len(one) == 1 and isinstance(one[0], dict)
    return image_size_of(one[0].get('w'), one[0].get('h')) if known else None
