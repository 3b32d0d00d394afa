"""JSON of detectors: COCO, MMPose, AlphaPose, OpenPose, Ultralytics.

Their layouts differ in how frames hold persons, and in the names of what a person has.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.persons import (
    FoundPersons,
    Person,
    numbers_of,
    orders_of,
    person,
)
from hmt_ros.image.keypoint_schemes import recognised
from hmt_ros.inference.arrays import Array
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line

LARGEST_FILE = 2**28  # bytes
_POINTS = ('keypoints', 'pose_keypoints_2d', 'joints')
_SCORES = ('keypoint_scores', 'keypoints_scores', 'keypoint_score')
_SCORE = ('score', 'bbox_score', 'confidence', 'scores')
_TRACK = ('track_id', 'idx', 'person_id')
_FRAME = ('image_id', 'frame_id', 'frame', 'image_name', 'file_name')
_PERSONS = ('people', 'bodies', 'instances')

Frames = list[tuple[Any, list[Any]]]


def read_json(path: Path) -> Any:
    """The content of a file of JSON.

    Raises:
        ValueError: no JSON, or too much.
    """
    return _parsed(read_bytes(path, LARGEST_FILE))


def _parsed(content: bytes | str) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f'not JSON ({error_line(error)})') from error


def add_json(found: FoundPersons, content: Any, source: FrameSource) -> None:
    """Adds the persons of all frames in one file.

    Raises:
        ValueError: of no known layout.
    """
    names: tuple[str, ...] | None = None
    annotated = isinstance(content, dict) and 'annotations' in content
    results = isinstance(content, dict) and 'instance_info' in content
    if annotated:
        names, frames = _annotations(found, content)
    else:
        frames = frames_in(content, None)
        if results:
            names = _names(content.get('meta_info'))
    if not frames and content not in ([], {}):
        raise ValueError(
            'no known layout of JSON; wanted a list of {image_id, keypoints, score}, annotations '
            'of COCO, or what MMPose, AlphaPose or Ultralytics write'
        )
    labels = [label for label, _ in frames]
    for i, label in enumerate(labels):
        if not isinstance(label, (int, str)):
            raise ValueError(f'entry {i} has no image_id or no keypoints')
    # The demos of MMPose count frames from 1, its inferencer from 0.
    numbers = numbers_of(labels, source, from_one=results)
    for i, (number, (_, entries)) in enumerate(zip(numbers, frames, strict=True)):
        found.add(number, None)
        for entry in entries:
            found.add(number, person_in(found, entry, f'entry {i}', names, flags=annotated))


def _annotations(found: FoundPersons, content: dict[str, Any]) -> tuple[Any, Frames]:
    """Names and frames of COCO annotations."""
    labels: dict[Any, str] = {}
    names: tuple[str, ...] | None = None
    for image in list_of(content, 'images'):
        if not isinstance(image.get('id'), (int, str)):
            raise ValueError('an image has no id')
        labels[image['id']] = str(image.get('file_name') or image['id'])
        if isinstance(image.get('width'), int) and isinstance(image.get('height'), int):
            found.size = image['width'], image['height']
    for category in content.get('categories') or []:
        if isinstance(category, dict) and isinstance(category.get('keypoints'), list):
            names = tuple(str(x) for x in category['keypoints'])
    frames: Frames = []
    for i, entry in enumerate(list_of(content, 'annotations')):
        label = entry.get('image_id')
        if not isinstance(label, (int, str)):
            raise ValueError(f'entry {i} has no image_id or no keypoints')
        frames.append((labels.get(label, label), [entry]))
    return names, frames


def _names(about: Any) -> tuple[str, ...] | None:
    """The names of the points that MMPose tells; None: they are of no known scheme."""
    listed = about.get('keypoint_id2name') if isinstance(about, dict) else None
    names = tuple(map(str, listed.values())) if isinstance(listed, dict) else ()
    return names if names and recognised(names) else None


def frames_in(content: Any, label: Any) -> Frames:
    """Labels of frames, and the objects of the persons in them.

    Args:
        label: of the frame whose file it is; None: of many frames.

    Raises:
        ValueError: of no known layout.
    """
    if isinstance(content, dict):
        return [*_frames_of_object(content, label)]
    if not isinstance(content, list):
        return []
    frames: Frames = []
    for i, entry in enumerate(content):
        entry = _parsed(entry) if isinstance(entry, str) else entry
        own = next((entry[x] for x in _FRAME if x in entry), label) if _holds(entry) else None
        if isinstance(entry, list):
            frames.append((i, entry))
        elif not _holds(entry):
            raise ValueError(f'entry {i} is no person and no frame')
        elif 'preds' in entry:
            frames += _predictions(entry)
        elif any(isinstance(entry.get(x), list) for x in _PERSONS):
            frames += _frames_of_object(entry, i if own is None else own)
        else:
            frames.append((own, [entry]))
    return frames


def _holds(entry: Any) -> bool:
    return isinstance(entry, dict)


def _frames_of_object(content: dict[str, Any], label: Any) -> Iterator[tuple[Any, list[Any]]]:
    """Frames of an object: of one frame, of frames by name, or of the frames of each person."""
    if 'instance_info' in content:
        yield from frames_in(content['instance_info'], 0)
        return
    persons = next((content[x] for x in _PERSONS if isinstance(content.get(x), list)), None)
    if persons is not None:
        yield next((content[x] for x in _FRAME if x in content), label), persons
        return
    for name, value in content.items():
        if isinstance(value, list):
            yield name, value
        elif isinstance(value, dict):
            for frame, entry in value.items():
                if isinstance(entry, dict) and any(x in entry for x in _POINTS):
                    yield frame, [{'track_id': name, **entry}]
            if any(isinstance(value.get(x), list) for x in _PERSONS):
                yield from _frames_of_object(value, name)


def _predictions(entry: dict[str, Any]) -> Frames:
    """Frames of a batch as the test of MMPose wrote them before version 1."""
    paths, points = entry.get('image_paths'), entry['preds']
    boxes = entry.get('boxes') or []
    if not isinstance(paths, list) or not isinstance(points, list) or len(points) != len(paths):
        raise ValueError('preds and image_paths of MMPose do not fit each other')
    return [
        (Path(str(path)).name, [{'keypoints': one, 'bbox': box}])
        for path, one, box in zip(paths, points, boxes or [None] * len(paths), strict=False)
    ]


def person_in(
    found: FoundPersons,
    entry: Any,
    where: str,
    names: Sequence[str] | None = None,
    *,
    flags: bool = False,
) -> Person | None:
    """A person as an object of JSON tells it; None if nothing of the person was seen.

    Args:
        where: name of the object in errors.
        names: of the points, if the file has them.
        flags: whether confidences are flags of annotators.

    Raises:
        ValueError: the object is no person.
    """
    points = next((entry[x] for x in _POINTS if x in entry), None) if _holds(entry) else None
    if points is None:
        raise ValueError(f'{where} has no image_id or no keypoints')
    sure = next((entry[x] for x in _SCORES if x in entry), None)
    values = _triples(points, sure, where)
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
    track = next((entry[x] for x in _TRACK if x in entry), None)
    return person(names, values[:, :2], confidences, track=_text(track), score=_score(entry))


def _score(entry: dict[str, Any]) -> float:
    """How sure the detector is of a person; 1 where it does not tell."""
    box = entry.get('bbox')
    of_box = box[4] if isinstance(box, list) and len(box) > 4 else None
    told = next((entry[x] for x in _SCORE if entry.get(x) is not None), of_box)
    try:
        score = float(np.array(told, dtype=np.float64).reshape(-1)[0])
    except (TypeError, ValueError, IndexError, OverflowError):
        return 1.0
    return score if np.isfinite(score) else 1.0


def _text(track: Any) -> str:
    """The name of a person; '' if it has none."""
    if isinstance(track, list):
        track = track[0] if track else None
    if isinstance(track, float) and track.is_integer():
        track = int(track)
    return '' if track in (None, -1) else str(track)


def list_of(content: dict[str, Any], name: str) -> list[Any]:
    """A list of objects in an object.

    Raises:
        ValueError: it is not there.
    """
    entries = content.get(name)
    if not isinstance(entries, list) or not all(isinstance(x, dict) for x in entries):
        raise ValueError(f'no list {name}')
    return entries


def _triples(points: Any, sure: Any, where: str) -> Array:
    """(n, 3) column, row and confidence of keypoints: triples in a row, or a list of each."""
    try:
        if isinstance(points, dict):
            sure = points.get('visible') if sure is None else sure
            points = np.stack([np.array(points.get(x), dtype=np.float64) for x in 'xy'], -1)
        values = np.array(points, dtype=np.float64)
        given = None if sure is None else np.array(sure, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'{where}: keypoints are not numbers') from error
    if values.ndim == 3 and len(values) == 1:
        values = values[0]
    width = 3 if given is None else 2
    if values.ndim == 1 and values.size and values.size % width == 0:
        values = values.reshape(-1, width)
    if values.ndim != 2 or values.shape[1] not in (2, 3) or not values.size:
        raise ValueError(
            f'{where} has {values.size} numbers, wanted u, v and confidence for each keypoint'
        )
    if given is None:
        given = values[:, 2] if values.shape[1] == 3 else np.ones(len(values))
    if given.shape != (len(values),):
        raise ValueError(f'{where} has {given.size} confidences of {len(values)} keypoints')
    return np.column_stack([values[:, :2], given])
