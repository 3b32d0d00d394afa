"""Reads JSON of detectors: COCO, MMPose, AlphaPose, OpenPose, Ultralytics.

The layouts differ in the nesting of frames and persons, and in the names of fields.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.persons import (
    FoundPersons,
    Person,
    image_size_of,
    numbers_of,
    orders_of,
    person,
)
from hmt_ros.image.keypoint_schemes import recognised
from hmt_ros.inference.arrays import Array
from msg_tools.files.plain_json import load_plain_json

MAX_FILE_BYTES = 2**27  # maximum size, bytes
# Names of the fields of a person or a frame in all layouts.
_POINT_FIELDS = ('keypoints', 'pose_keypoints_2d', 'joints')
_CONFIDENCE_FIELDS = ('keypoint_scores', 'keypoints_scores', 'keypoint_score')
_SCORE_FIELDS = ('score', 'bbox_score', 'confidence', 'scores')
_TRACK_FIELDS = ('track_id', 'idx', 'person_id')
_FRAME_FIELDS = ('image_id', 'frame_id', 'frame', 'image_name', 'file_name')
_PERSON_FIELDS = ('people', 'bodies', 'instances')

Labelled = tuple[Any, list[Any]]


def add_json(found: FoundPersons, content: Any, source: FrameSource) -> None:
    """Adds the persons of all frames in one file.

    Raises:
        ValueError: the layout is unknown.
    """
    names: tuple[str, ...] | None = None
    about = content if isinstance(content, dict) else {}
    annotated, results = 'annotations' in about, 'instance_info' in about
    if annotated:
        names, frames = _annotations(found, about)
    else:
        frames = [*frames_in(content, None)]
        listed = _get(about.get('meta_info'), ('keypoint_id2name',))
        if isinstance(listed, dict) and recognised([*map(str, listed.values())]):
            names = tuple(map(str, listed.values()))
    if not frames and content not in ([], {}):
        raise ValueError(
            'no known layout of JSON; wanted a list of {image_id, keypoints, score}, annotations '
            'of COCO, or what MMPose, AlphaPose or Ultralytics write'
        )
    for i, (label, _) in enumerate(frames):
        if not isinstance(label, (int, str)):
            raise ValueError(
                f'entry {i} has no image_id or no keypoints: put files of single frames into a '
                'folder'
            )
    # The demos of MMPose count frames from 1, its inferencer from 0.
    numbers = numbers_of([label for label, _ in frames], source, from_one=results)
    for i, (number, (_, entries)) in enumerate(zip(numbers, frames, strict=True)):
        found.add(number, None)
        for entry in entries:
            found.add(number, person_in(found, entry, f'entry {i}', names, flags=annotated))


def _get(entry: Any, names: Sequence[str], default: Any = None) -> Any:
    """Value of the first of the given names that an object has, or else the default."""
    if not isinstance(entry, dict):
        return default
    return next((entry[x] for x in names if entry.get(x) is not None), default)


def _annotations(found: FoundPersons, content: dict[str, Any]) -> tuple[Any, list[Labelled]]:
    """Keypoint names and frames in COCO annotations."""
    labels: dict[str, str | int] = {}
    for image in _list(content, 'images'):
        name = image.get('file_name') or image.get('id')
        if not (isinstance(image.get('id'), (int, str)) and isinstance(name, (int, str))):
            raise ValueError('an image has no id, or its file_name is not text')
        labels[str(image['id'])] = name
        found.size = image_size_of(image.get('width'), image.get('height')) or found.size
    categories = _get(content, ('categories',))
    named = [_get(x, ('keypoints',)) for x in categories] if isinstance(categories, list) else []
    names = next((tuple(map(str, x)) for x in named if isinstance(x, list)), None)
    frames: list[Labelled] = []
    for entry in _list(content, 'annotations'):
        label = entry.get('image_id')
        known = labels.get(str(label), label) if isinstance(label, (int, str)) else None
        frames.append((known, [entry]))
    return names, frames


def frames_in(content: Any, label: Any) -> Iterator[Labelled]:
    """Yields the label of each frame, and the JSON objects of its persons.

    Args:
        label: label of the only frame in the file; None if the file has many frames.

    Raises:
        ValueError: the layout is unknown.
    """
    if isinstance(content, dict):
        yield from _frames_of_object(content, label)
    elif isinstance(content, list):
        for i, entry in enumerate(content):
            entry = load_plain_json(entry) if isinstance(entry, str) else entry
            if not isinstance(entry, (dict, list)):
                raise ValueError(f'entry {i} is not an object')
            own = _get(entry, _FRAME_FIELDS, label)
            if isinstance(entry, list):
                yield i, entry
            elif isinstance(_get(entry, _PERSON_FIELDS), list):
                yield i if own is None else own, _get(entry, _PERSON_FIELDS)
            else:
                yield own, [entry]


def _frames_of_object(content: dict[str, Any], label: Any) -> Iterator[Labelled]:
    """Yields the frames in an object: a single frame, frames by name, or frames for each person."""
    persons = _get(content, _PERSON_FIELDS)
    if 'instance_info' in content:
        yield from frames_in(content['instance_info'], 0)
    elif isinstance(persons, list):
        yield _get(content, _FRAME_FIELDS, label), persons
    elif label is not None:
        raise ValueError('an object without people, wanted what a detector writes for a frame')
    else:
        for name, value in content.items():
            if isinstance(value, list):
                yield name, value
            elif isinstance(_get(value, _PERSON_FIELDS), list):
                yield name, _get(value, _PERSON_FIELDS)
            elif isinstance(value, dict):
                for frame, entry in value.items():
                    if _get(entry, _POINT_FIELDS) is not None:
                        yield frame, [{'track_id': name, **entry}]


def person_in(
    found: FoundPersons,
    entry: Any,
    where: str,
    names: Sequence[str] | None = None,
    *,
    flags: bool = False,
) -> Person | None:
    """Reads a person from a JSON object; returns None if no keypoint was seen.

    Args:
        where: name of the object in error messages.
        names: names of the points, if the file has them.
        flags: whether confidences are visibility flags from annotators.

    Raises:
        ValueError: the object is not a person.
    """
    points = _get(entry, _POINT_FIELDS)
    if points is None:
        raise ValueError(f'{where} has no image_id or no keypoints')
    values = _triples(points, _get(entry, _CONFIDENCE_FIELDS), where)
    if names is not None and len(names) != len(values):
        raise ValueError(
            f'{where} has {len(values)} keypoints, but {len(names)} are named in categories'
        )
    confidences = values[:, 2]
    if np.isin(confidences, (0.0, 1.0, 2.0)).all() and (flags or (confidences == 2.0).any()):
        confidences = confidences / 2  # flags: 0 not labelled, 1 hidden, 2 visible
    if names is None:
        orders_of(len(values))
        found.unnamed = len(values)
    track, box = _get(entry, _TRACK_FIELDS), _get(entry, ('bbox',))
    track = track[0] if isinstance(track, list) and track else track
    track = int(track) if isinstance(track, float) and track.is_integer() else track
    told = _get(entry, _SCORE_FIELDS, box[4] if isinstance(box, list) and len(box) > 4 else None)
    told = told[0] if isinstance(told, list) and told else told
    return person(
        names,
        values[:, :2],
        confidences,
        track=str(track) if isinstance(track, (int, float, str)) and track != -1 else '',
        score=float(told) if isinstance(told, (int, float)) and abs(told) < 1e9 else 1.0,
    )


def _list(content: dict[str, Any], name: str) -> list[Any]:
    """The list of objects in a field of an object; raises ValueError if missing."""
    entries = content.get(name)
    if not isinstance(entries, list) or not all(isinstance(x, dict) for x in entries):
        raise ValueError(f'no list {name}')
    return entries


def _triples(points: Any, sure: Any, where: str) -> Array:
    """Column, row and confidence (n, 3) of keypoints, from a flat list or separate lists."""
    try:
        if isinstance(points, dict):  # written by Ultralytics
            sure = points.get('visible') if sure is None else sure
            points = np.array([points.get('x'), points.get('y')], dtype=np.float64).T
        values = np.array(points, dtype=np.float64)
        given = None if sure is None else np.array(sure, dtype=np.float64).reshape(-1, 1)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'{where}: keypoints are not numbers') from error
    width = values.shape[-1] if values.ndim > 1 else 3 if given is None else 2
    if width not in (2, 3) or not values.size or values.size % width:
        raise ValueError(
            f'{where} has {values.size} numbers, wanted u, v and confidence for each keypoint'
        )
    values = values.reshape(-1, width)
    given = values[:, 2:] if given is None else given
    given = np.ones((len(values), 1)) if given.shape[1] == 0 else given
    if len(given) != len(values):
        raise ValueError(f'{where} has {len(given)} confidences of {len(values)} keypoints')
    return np.hstack([values[:, :2], given])
