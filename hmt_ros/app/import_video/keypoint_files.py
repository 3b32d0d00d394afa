"""Files of 2D detectors, in the layouts of import-video --help, and the choice of a person."""

from __future__ import annotations

import csv
import io
import json
import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.app.import_video.frames import Frame, FrameSource, natural_order
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array
from msg_tools.files.array_file import read_archive
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line
from msg_tools.messages.headers import SECOND_NS

LARGEST, NEAREST, INDEX, TRACK = 'largest', 'nearest', 'index', 'id'
# A person moves at most by this much of the diagonal of their box from frame to frame.
_FASTEST = 0.5


@dataclass(frozen=True, eq=False)
class Person:
    """A person in a frame.

    Attributes:
        keypoints: under the detector's names; their covariances are not known (NaN).
        track: name that the detector gives the person in all frames; '' if it does not track.
    """

    keypoints: Keypoints
    track: str = ''

    @property
    def box(self) -> Array:
        """(2, 2) least and greatest column and row of the keypoints that were seen."""
        seen = self.keypoints.pixels[self.keypoints.seen]
        return np.stack([seen.min(0), seen.max(0)])

    def distance(self, other: Person) -> float:
        """Mean distance of the keypoints that both have, px; of the boxes if there is none."""
        both = self.keypoints.seen & other.keypoints.seen
        apart = self.keypoints.pixels[both] - other.keypoints.pixels[both]
        if not both.any():
            apart = (self.box.mean(0) - other.box.mean(0))[None]
        return float(np.linalg.norm(apart, axis=1).mean())


def person(
    names: Sequence[str],
    pixels: ArrayLike,
    confidences: ArrayLike | None = None,
    positions: ArrayLike | None = None,
    track: str = '',
) -> Person | None:
    """A person as a detector reports one; None if it sees nothing of the person.

    A keypoint at (0, 0) or at NaN, or without confidence, was not seen. Confidences above 1,
    which some detectors give, count as 1.

    Args:
        pixels: (n, 2) px.
        confidences: (n,); None: 1.
        positions: (n, 3) m; None: the detector does not lift.
    """
    n = len(names)
    places = np.array(pixels, dtype=np.float64)
    sure = np.ones(n) if confidences is None else np.array(confidences, dtype=np.float64)
    sure = np.clip(np.nan_to_num(sure, nan=0.0), 0.0, 1.0)
    unseen = ~np.isfinite(places).all(1) | (places == 0.0).all(1) | (sure == 0.0)
    if unseen.all():
        return None
    places[unseen], sure[unseen] = np.nan, 0.0
    lifted = None if positions is None else np.array(positions, dtype=np.float64)
    unknown = np.full((n, 2, 2), np.nan)
    return Person(Keypoints(tuple(names), places, unknown, sure, lifted), track)


@dataclass(frozen=True)
class Choice:
    """How the person to track is chosen among several.

    Attributes:
        kind: `LARGEST`: box in each frame. `NEAREST`: to the person chosen before; the first is
            the largest. `INDEX`: place in the list of the frame. `TRACK`: name that the detector
            gives the person.
        value: the place, or the name.
    """

    kind: str = NEAREST
    value: str = ''

    @classmethod
    def parse(cls, text: str) -> Choice:
        """A choice as the command line has it: largest, nearest, index:N or id:NAME.

        Raises:
            ValueError: another text.
        """
        kind, colon, value = text.partition(':')
        if kind in (LARGEST, NEAREST) and not colon:
            return cls(kind)
        if (kind == INDEX and value.isdecimal()) or (kind == TRACK and value):
            return cls(kind, value)
        raise ValueError(f'wanted largest, nearest, index:N or id:NAME, saw {text!r}')


class Chooser:
    """Chooses a person frame by frame."""

    def __init__(self, choice: Choice) -> None:
        self._choice = choice
        self._last: tuple[int, Person] | None = None

    def of(self, number: int, found: Sequence[Person]) -> Person | None:
        """The person among those in a frame, whose numbers must rise; None: not there."""
        kind, value = self._choice.kind, self._choice.value
        if kind == INDEX:
            return found[int(value)] if int(value) < len(found) else None
        if kind == TRACK:
            return next((x for x in found if x.track == value), None)
        if not found:
            return None
        if kind == LARGEST or self._last is None:
            chosen = max(found, key=lambda x: float(np.prod(x.box[1] - x.box[0])))
        else:
            before, last = self._last
            chosen = min(found, key=last.distance)
            reach = _FASTEST * float(np.linalg.norm(last.box[1] - last.box[0]))
            if chosen.distance(last) > reach * (number - before):
                return None
        self._last = number, chosen
        return chosen


LARGEST_FILE = 2**30  # bytes
# Schemes of lists without names, by their number of keypoints.
_BY_COUNT = {
    len(schemes()[name].names): name
    for name in ('coco17', 'skeleton2d', 'body25', 'halpe26', 'mediapipe33', 'mhr70')
}
_MATCHING_NS = 10_000_000  # between the time of a row and that of its frame
_FRACTION = 2.0  # px; keypoints that all lie within are given as fractions of the image
_FARTHEST = 1e5  # px; no image is so large


@dataclass
class FoundPersons:
    """Persons by frame.

    Attributes:
        by_time: persons of frames, by time since the first frame, ns.
        rows: number of frames that the file describes one by one; None: it skips frames.
        size: width and height of the frames that the detector saw, px; None: not known.
    """

    by_number: dict[int, list[Person]] = field(default_factory=lambda: defaultdict(list))
    by_time: dict[int, list[Person]] = field(default_factory=lambda: defaultdict(list))
    rows: int | None = None
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        self._times: list[int] = []

    @property
    def last(self) -> int:
        """Number of the last frame with an entry; -1: there is none."""
        return max(self.by_number, default=-1)

    @property
    def lifts(self) -> bool:
        """Whether the detector has positions in space."""
        return any(x.keypoints.positions is not None for x in self.persons())

    def of(self, frame: Frame) -> list[Person]:
        """Persons in a frame."""
        if frame.number in self.by_number:
            return self.by_number[frame.number]
        if len(self._times) != len(self.by_time):
            self._times = sorted(self.by_time)
        at = bisect_left(self._times, frame.time_ns)
        near = min(
            self._times[max(at - 1, 0) : at + 1], key=lambda t: abs(t - frame.time_ns), default=None
        )
        if near is None or abs(near - frame.time_ns) > _MATCHING_NS:
            return []
        return self.by_time[near]

    def check_size(self, frame: Frame) -> None:
        """Raises ValueError where the detector saw frames of another size."""
        height, width = frame.image.shape[:2]
        if self.size not in (None, (width, height)):
            assert self.size is not None
            raise ValueError(
                f'the keypoints were found in images of {self.size[0]}x{self.size[1]} pixels, but '
                f'the frames have {width}x{height}'
            )

    def persons(self) -> Iterator[Person]:
        """All persons of all frames."""
        for found in (*self.by_number.values(), *self.by_time.values()):
            yield from found


def read_keypoints(path: Path, source: FrameSource, first_stamp_ns: int) -> FoundPersons:
    """Reads the output of a detector for the frames of a source.

    Args:
        first_stamp_ns: stamp of the first frame, which stamps in the file refer to.

    Raises:
        ValueError: the file is missing, unreadable, of no known kind, or contradicts itself.
    """
    try:
        if path.is_dir():
            found = _openpose(path, source)
        elif not path.is_file():
            raise ValueError('no such file')
        elif path.suffix.lower() == '.json':
            found = _coco(_json(path), source)
        elif path.suffix.lower() == '.npz':
            found = _arrays(path)
        elif path.suffix.lower() == '.csv':
            found = _table(path, source, first_stamp_ns)
        else:
            raise ValueError(
                f'{path.suffix or "a file without suffix"} is not known; wanted COCO (.json), a '
                'folder of OpenPose, .npz or .csv'
            )
        farthest = max(
            (float(np.nanmax(np.abs(x.keypoints.pixels))) for x in found.persons()),
            default=_FARTHEST,
        )
        if farthest > _FARTHEST:
            raise ValueError(f'a keypoint lies {farthest:g} px away, wanted places in an image')
        for names in {x.keypoints.names for x in found.persons()}:
            if len({*names}) < len(names):
                twice = next(x for x in names if names.count(x) > 1)
                raise ValueError(f'two keypoints are called {twice}')
        if farthest <= _FRACTION:
            raise ValueError(
                f'all keypoints lie within {farthest:g} px: they are fractions of the image, '
                'wanted pixels'
            )
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
    return found


def _json(path: Path) -> Any:
    content = read_bytes(path, LARGEST_FILE)
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f'not JSON ({error_line(error)})') from error


def _coco(content: Any, source: FrameSource) -> FoundPersons:
    """Results, a list of {image_id, keypoints}; or annotations, which name images and keypoints."""
    labels: dict[Any, str | int] = {}
    names: tuple[str, ...] | None = None
    found = FoundPersons()
    annotated = isinstance(content, dict)
    if annotated:
        for image in _list(content, 'images'):
            labels[image.get('id')] = image.get('file_name') or image.get('id')
            if isinstance(image.get('width'), int) and isinstance(image.get('height'), int):
                found.size = image['width'], image['height']
        for category in content.get('categories') or []:
            if isinstance(category, dict) and category.get('keypoints'):
                names = tuple(str(x) for x in category['keypoints'])
        content = _list(content, 'annotations')
    if not isinstance(content, list) or not all(isinstance(x, dict) for x in content):
        raise ValueError('not COCO: wanted a list of {image_id, keypoints, score}, or annotations')
    for i, entry in enumerate(content):
        label = entry.get('image_id')
        if not isinstance(label, (int, str)) or 'keypoints' not in entry:
            raise ValueError(f'entry {i} has no image_id or no keypoints')
        values = _triples(entry['keypoints'], f'entry {i}')
        if names is not None and len(names) != len(values):
            raise ValueError(
                f'entry {i} has {len(values)} keypoints, but {len(names)} are named in categories'
            )
        sure = values[:, 2]
        if np.isin(sure, (0.0, 1.0, 2.0)).all() and (annotated or (sure == 2.0).any()):
            sure = sure / 2  # flags: 0 not labelled, 1 hidden, 2 visible
        track = entry.get('track_id', entry.get('idx', ''))
        seen = person(names or _names(len(values)), values[:, :2], sure, track=str(track))
        number = source.number_of(labels.get(label, label))
        found.by_number[number] += [] if seen is None else [seen]
    return found


def _openpose(path: Path, source: FrameSource) -> FoundPersons:
    """Files such as walk_000000000012_keypoints.json."""
    files = sorted(path.glob('*.json'), key=lambda x: natural_order(x.name))
    if not files:
        raise ValueError('no .json files in this folder, wanted those that OpenPose writes')
    found = FoundPersons()
    for file in files:
        content = _json(file)
        if not isinstance(content, dict) or 'people' not in content:
            raise ValueError(f'{file.name} is not of OpenPose: it has no people')
        number = source.number_of(file.stem.removesuffix('_keypoints'))
        if number in found.by_number:
            raise ValueError(f'{file.name} is the second file of frame {number}')
        entries = found.by_number[number]
        for entry in _list(content, 'people'):
            values = _triples(entry.get('pose_keypoints_2d'), file.name)
            track = next(iter(entry.get('person_id') or []), -1)
            seen = person(
                _names(len(values)), values[:, :2], values[:, 2],
                track='' if track == -1 else str(track),
            )  # fmt: skip
            entries += [] if seen is None else [seen]
    return found


def _arrays(path: Path) -> FoundPersons:
    """Row t of each array is frame t."""
    content = read_archive(path)
    if 'pixels' not in content:
        raise ValueError('no array pixels; wanted pixels and landmark_names')
    rows, size = len(content['pixels']), content['pixels'].size
    given = content.get('landmark_names')
    names = _names(size // max(2 * rows, 1)) if given is None else tuple(map(str, given))
    n = len(names)
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
    found = FoundPersons(rows=rows)
    for t in range(rows):
        entries = found.by_number[t]
        if detected[t]:
            seen = person(
                names, content['pixels'][t], None if sure is None else sure[t],
                None if world is None else world[t],
            )  # fmt: skip
            entries += [] if seen is None else [seen]
    return found


def _table(path: Path, source: FrameSource, first_stamp_ns: int) -> FoundPersons:
    """A row for each person in a frame (NAME_u, NAME_v, ...), or for each keypoint (name, u, v)."""
    try:
        text = read_bytes(path, LARGEST_FILE).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise ValueError('not a table: the file is not text in UTF-8') from error
    reader = csv.DictReader(io.StringIO(text), strict=True)
    columns = [x.strip() for x in reader.fieldnames or []]
    reader.fieldnames = columns
    when = next((x for x in ('frame', 'time_s', 'stamp_ns') if x in columns), None)
    if when is None:
        raise ValueError(f'wanted a column frame, time_s or stamp_ns, saw {columns[:8]}')
    wide = [x.removesuffix('_u') for x in columns if x.endswith('_u')]
    lacking = [f'{x}_v' for x in wide if f'{x}_v' not in columns]
    if lacking:
        raise ValueError(f'no column {lacking[0]}')
    if not wide and not {'name', 'u', 'v'} <= {*columns}:
        raise ValueError(f'wanted columns NAME_u and NAME_v, or name, u and v, saw {columns[:8]}')
    rows: dict[tuple[str, str], dict[str, tuple[float, float, float]]] = defaultdict(dict)
    try:
        for row in reader:
            if not row[when] or not (wide or row['name']):
                raise ValueError(f'line {reader.line_num}: no {"name" if row[when] else when}')
            about = row[when], row.get('person') or ''
            for name in wide or [row['name']]:
                kind = [f'{name}_{x}' for x in ('u', 'v', 'confidence')] if wide else None
                keys = kind or ['u', 'v', 'confidence']
                u, v, sure = (_number(row, key, reader.line_num) for key in keys)
                if name in rows[about]:
                    raise ValueError(f'line {reader.line_num}: {name} twice in {when} {about[0]}')
                rows[about][name] = u, v, 1.0 if keys[2] not in columns else sure
    except csv.Error as error:
        raise ValueError(f'line {reader.line_num}: {error}') from error
    found = FoundPersons()
    for (label, track), keypoints in rows.items():
        values = np.array([*keypoints.values()])
        seen = person(tuple(keypoints), values[:, :2], values[:, 2], track=track)
        if when == 'frame':
            entries = found.by_number[source.number_of(label)]
        else:
            at = _time(label, when)
            entries = found.by_time[at if when == 'time_s' else at - first_stamp_ns]
        entries += [] if seen is None else [seen]
    return found


def _number(row: dict[str, Any], key: str, line: int) -> float:
    """A cell; NaN where it is empty or not there."""
    text = (row.get(key) or '').strip()
    try:
        return float(text) if text else math.nan
    except ValueError as error:
        raise ValueError(f'line {line}: {key} is {text!r}, wanted a number') from error


def _time(text: str, column: str) -> int:
    """A time in ns."""
    try:
        return int(text) if column == 'stamp_ns' else round(float(text) * SECOND_NS)
    except (ValueError, OverflowError) as error:
        raise ValueError(f'{column} is {text!r}, wanted a number') from error


def _list(content: dict[str, Any], name: str) -> list[Any]:
    entries = content.get(name)
    if not isinstance(entries, list) or not all(isinstance(x, dict) for x in entries):
        raise ValueError(f'no list {name}')
    return entries


def _triples(values: Any, where: str) -> Array:
    """(n, 3) column, row and confidence of the keypoints in a flat list."""
    try:
        flat = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'{where}: keypoints are not numbers') from error
    if flat.ndim != 1 or flat.size == 0 or flat.size % 3:
        raise ValueError(f'{where} has {flat.size} numbers, wanted u, v and confidence for each')
    return flat.reshape(-1, 3)


def _names(count: int) -> tuple[str, ...]:
    if count not in _BY_COUNT:
        known = ', '.join(f'{n} ({name})' for n, name in sorted(_BY_COUNT.items()))
        raise ValueError(f'{count} keypoints without names; wanted {known}')
    return schemes()[_BY_COUNT[count]].names
