"""Tables: those of import-video --help (.csv), of DeepLabCut (.csv), and markers (.trc)."""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, landmark_name, person
from hmt_ros.image.keypoint_schemes import landmark_called
from msg_tools.files.bounded_file import read_bytes
from msg_tools.messages.headers import SECOND_NS

LARGEST_FILE = 2**28  # bytes
_MOST_COLUMNS = 10_000
# Times from here on count from another day than that of the recording.
_UNIX, _LATEST = 1e8, 1e11  # s
# Places that all lie within are those of a calibrated system, m.
_METRES = 20.0


def read_table(path: Path, source: FrameSource, first_stamp_ns: int) -> FoundPersons:
    """A table of a known kind.

    Args:
        first_stamp_ns: stamp of the first frame, which stamps in the file refer to.

    Raises:
        ValueError: it is none, or contradicts itself.
    """
    try:
        text = read_bytes(path, LARGEST_FILE).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise ValueError('not a table: the file is not text in UTF-8') from error
    found = FoundPersons(path)
    if path.suffix.lower() == '.trc':
        _add_markers(found, text)
        return found
    rows = csv.reader(io.StringIO(text), strict=True)
    try:
        head = [next(rows, []) for _ in range(4)]
        depth = next((i for i, x in enumerate(head) if x[:1] == ['coords']), None)
        if depth is not None and head[0][:1] == ['scorer']:
            _add_deeplabcut(found, source, head[: depth + 1], [*head[depth + 1 :], *rows])
        else:
            _add_rows(found, source, first_stamp_ns, text)
    except csv.Error as error:
        raise ValueError(f'line {rows.line_num}: {error}') from error
    return found


def _add_rows(found: FoundPersons, source: FrameSource, first_stamp_ns: int, text: str) -> None:
    """A row for each person in a frame (NAME_u, NAME_v, ...), or for each keypoint (name, u, v)."""
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
    for row in reader:
        if not row[when] or not (wide or row['name']):
            raise ValueError(f'line {reader.line_num}: no {"name" if row[when] else when}')
        about = row[when], row.get('person') or ''
        for name in wide or [row['name']]:
            kind = [f'{name}_{x}' for x in ('u', 'v', 'confidence')] if wide else None
            keys = kind or ['u', 'v', 'confidence']
            u, v, sure = (_number(row, key, reader.line_num) for key in keys)
            if name in rows[about]:
                raise ValueError(
                    f'line {reader.line_num}: {name} twice in {when} {about[0]}; a column person '
                    'keeps several persons apart'
                )
            rows[about][name] = u, v, 1.0 if keys[2] not in columns else sure
    found.timed = when != 'frame'
    for key, ((_, track), keypoints) in zip(
        _keys([x for x, _ in rows], when, source, first_stamp_ns), rows.items(), strict=True
    ):
        values = np.array([*keypoints.values()])
        names = [landmark_name(x) for x in keypoints]
        found.add(key, person(names, values[:, :2], values[:, 2], track=track))


def _keys(labels: Sequence[str], when: str, source: FrameSource, first_stamp_ns: int) -> list[int]:
    """Keys of frames in a column; Unix times count from the first."""
    if when == 'frame':
        return [source.number_of(x) for x in labels]
    if when == 'stamp_ns':
        return [_time(x, when) - first_stamp_ns for x in labels]
    times = [_time(x, when) for x in labels]
    unit = 1
    while min(times, default=0) / unit > _LATEST * SECOND_NS:
        unit *= 1000  # milliseconds, or less
    first = min(times, default=0) // unit
    return [round(x / unit) - (first if first > _UNIX * SECOND_NS else 0) for x in times]


def _time(text: str, column: str) -> int:
    """A time in ns."""
    try:
        return int(text) if column == 'stamp_ns' else round(float(text) * SECOND_NS)
    except (ValueError, OverflowError) as error:
        raise ValueError(
            f'{column} is {text[:40]!r}, wanted a number, of seconds or of a Unix time'
        ) from error


def _number(row: dict[Any, Any], key: Any, line: int) -> float:
    """A cell; NaN where it is empty or not there."""
    text = (row.get(key) or '').strip()
    try:
        return float(text) if text else math.nan
    except ValueError as error:
        raise ValueError(f'line {line}: {key} is {text[:40]!r}, wanted a number') from error


def _add_deeplabcut(
    found: FoundPersons, source: FrameSource, head: list[list[str]], rows: list[list[str]]
) -> None:
    """Rows below a head of scorer, individuals (of several animals), bodyparts and coords."""
    heads = {x[0]: x for x in head}
    parts, coordinates = heads.get('bodyparts', []), heads['coords']
    if len(parts) != len(coordinates) or len(parts) > _MOST_COLUMNS:
        raise ValueError('the rows bodyparts and coords do not fit each other')
    whose = heads.get('individuals', [''] * len(parts))
    places: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)
    for i, (one, part, coordinate) in enumerate(zip(whose, parts, coordinates, strict=False)):
        if coordinate in ('x', 'y', 'likelihood'):
            places[one, part][coordinate] = i
    names = _landmarks([part for _, part in places])
    lacking = [part for (_, part), at in places.items() if not {'x', 'y'} <= {*at}]
    if lacking:
        raise ValueError(f'{lacking[0]} has no columns x and y')
    for line, row in enumerate(rows, len(head) + 1):
        if not row:
            continue
        values: dict[str, list[tuple[str, float, float, float]]] = defaultdict(list)
        for (one, part), at in places.items():
            cells = {x: row[i] if i < len(row) else '' for x, i in at.items()}
            u, v, sure = (_number(cells, x, line) for x in ('x', 'y', 'likelihood'))
            if part in names:
                sure = sure if 'likelihood' in at else 1.0
                values[one].append((names[part], u, v, sure))
        number = source.number_of(''.join(row[: min(at['x'] for at in places.values())][-1:]))
        for one, listed in values.items():
            points = np.array([x[1:] for x in listed])
            seen = person([x[0] for x in listed], points[:, :2], points[:, 2], track=one)
            found.add(number, seen)


def _add_markers(found: FoundPersons, text: str) -> None:
    """Rows of frame, time, and X, Y, Z of each marker, with Z 0, as Sports2D writes pixels."""
    lines = [x.split('\t') for x in text.splitlines()]
    head = next((i for i, x in enumerate(lines) if x[0].strip() == 'Frame#'), None)
    if head is None:
        raise ValueError('no line Frame#, wanted a table of markers (.trc)')
    markers = [x.strip() for x in lines[head][2:] if x.strip()]
    names = _landmarks(markers)
    width = 2 + 3 * len(markers)
    rows = []
    for i, line in enumerate(lines[head + 1 :], head + 2):
        if line[0].strip().isdecimal():
            cells = dict(enumerate(line))
            rows.append([_number(cells, k, i) for k in range(width)])
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    points = table[:, 2:].reshape(len(table), -1, 3)
    spread = float(np.nanmax(np.abs(points[..., :2]), initial=0.0))
    if np.nanmax(np.abs(points[..., 2]), initial=0.0) > 0 or spread <= _METRES:
        raise ValueError(
            'the markers have three coordinates or metres; wanted places in the image: the file '
            'of Sports2D whose name has _px_'
        )
    if np.nanmax(points[..., 1], initial=-math.inf) <= 0:
        points[..., 1] *= -1.0  # Y points up
    which = [i for i, x in enumerate(markers) if x in names]
    found.timed = True
    for time, row in zip(table[:, 1], points[:, which, :2], strict=True):
        seen = person([names[markers[i]] for i in which], row)
        found.add(round((time - table[0, 1]) * SECOND_NS), seen)


def _landmarks(parts: Sequence[str]) -> dict[str, str]:
    """Landmarks by the names of those markers that are landmarks."""
    names = {x: landmark_name(x) for x in parts}
    known = {x: name for x, name in names.items() if landmark_called(name) is not None}
    if not known:
        raise ValueError(
            f'wanted names such as left_hip or LHip, saw {[x[:40] for x in parts[:6]]}'
        )
    return known
