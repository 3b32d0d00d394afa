"""Reads tables: .csv as in import-video --help or of DeepLabCut, and .trc of markers."""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, landmark_name, person
from hmt_ros.image.keypoint_schemes import landmark_called
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.budget import Budget
from msg_tools.files.error_line import error_line
from msg_tools.files.plain_json import MAX_MEMORY_BYTES
from msg_tools.messages.headers import SECOND_NS

MAX_FILE_BYTES = 2**26  # maximum size, bytes
_CELL_BYTES = 64  # memory of a cell, bytes
FRAME_COLUMN, TIME_COLUMN, STAMP_COLUMN = 'frame', 'time_s', 'stamp_ns'
# Minimum time that is a Unix time, and maximum time that is in seconds, not a shorter unit.
_MIN_UNIX_TIME, _MAX_TIME = 1e8, 1e11  # s
# Maximum coordinate for which positions are taken to be in metres, from a calibrated system.
_MAX_METRES = 20.0

# A cell: line number, frame or time, person, keypoint, and texts of column, row and confidence.
Cells = tuple[int, str, str, str, tuple[str, str, str]]


def read_table(path: Path, source: FrameSource, first_stamp_ns: int) -> FoundPersons:
    """Reads a table of a known kind.

    Args:
        first_stamp_ns: stamp of the first frame, which is subtracted from stamps in the file.

    Raises:
        ValueError: the file is not a known table, or is inconsistent.
    """
    try:
        text = read_bytes(path, MAX_FILE_BYTES).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise ValueError('not a table: the file is not text in UTF-8') from error
    markers, budget = path.suffix.lower() == '.trc', Budget(len(text))
    separator = '\t' if markers else ','
    # Memory in Python: of the text, of each cell including its list entry, and of each line.
    needed = 2 * len(text) + _CELL_BYTES * (text.count(separator) + 2 * text.count('\n'))
    if needed > MAX_MEMORY_BYTES:
        raise ValueError(
            f'a table whose cells take {needed} bytes, wanted at most {MAX_MEMORY_BYTES}'
        )
    lines = csv.reader(io.StringIO(text), strict=not markers, delimiter=separator)
    rows: dict[tuple[str, str], dict[str, tuple[float, float, float]]] = defaultdict(dict)
    try:
        table = [[x.strip() for x in line] for line in lines]
    except csv.Error as error:
        raise ValueError(f'line {lines.line_num}: {error}') from error
    if markers:
        when, cells = TIME_COLUMN, _of_markers(table)
    elif any(x[:1] == ['coords'] for x in table[:4]):
        when, cells = FRAME_COLUMN, _of_deeplabcut(table, budget)
    else:
        when = next(
            (x for x in (FRAME_COLUMN, TIME_COLUMN, STAMP_COLUMN) if table and x in table[0]), ''
        )
        cells = _of_rows(table, when, budget)
    for number, label, who, name, (u, v, sure) in cells:
        about = rows[label, who]
        if name in about:
            raise ValueError(
                f'line {number}: {name} twice in {when} {label}; a column person keeps several '
                'persons apart'
            )
        about[name] = _number(u, number), _number(v, number), _number(sure, number)
    found = FoundPersons(path, timed=when != FRAME_COLUMN)
    keys = _keys([label for label, _ in rows], when, source, first_stamp_ns)
    for key, ((_, who), keypoints) in zip(keys, rows.items(), strict=True):
        values = np.array([*keypoints.values()])
        seen = person([*keypoints], values[:, :2], values[:, 2], track=who)
        found.add(key, seen)
    return found


def _of_rows(table: list[list[str]], when: str, budget: Budget) -> Iterator[Cells]:
    """Yields cells of a table with a row per person (NAME_u, ...) or per keypoint (name, u, v)."""
    columns = table[0] if table else []
    if not when:
        raise ValueError(f'wanted a column frame, time_s or stamp_ns, saw {columns[:8]}')
    wide = [x.removesuffix('_u') for x in columns if x.endswith('_u')]
    known = {*columns}
    budget.spend(records=len(wide) * len(table))
    lacking = [f'{x}_v' for x in wide if f'{x}_v' not in known]
    if lacking:
        raise ValueError(f'no column {lacking[0]}')
    if not wide and not {'name', 'u', 'v'} <= known:
        raise ValueError(f'wanted columns NAME_u and NAME_v, or name, u and v, saw {columns[:8]}')
    names = {name: landmark_name(name) for name in wide}
    for number, line in enumerate(table[1:], 2):
        row = dict(zip(columns, line, strict=False))
        if not line:
            continue
        if not row.get(when) or not (wide or row.get('name')):
            raise ValueError(f'line {number}: no {"name" if row.get(when) else when}')
        for name in wide or [row['name']]:
            kind = f'{name}_' if wide else ''
            u, v, sure = (row.get(f'{kind}{x}', '') for x in ('u', 'v', 'confidence'))
            sure = sure if f'{kind}confidence' in known else '1'
            who = row.get('person', '')
            yield number, row[when], who, names.get(name) or landmark_name(name), (u, v, sure)


def _of_deeplabcut(table: list[list[str]], budget: Budget) -> Iterator[Cells]:
    """Yields cells of a DeepLabCut table; its header is scorer, individuals, bodyparts, coords."""
    depth = next(i for i, x in enumerate(table) if x[:1] == ['coords'])
    heads = {x[0]: x for x in table[: depth + 1] if x}
    coordinates = heads['coords']
    parts = heads.get('bodyparts', [])
    whose = heads.get('individuals', []) + [''] * len(parts)
    names = _landmarks(parts[1:])
    first = next((i for i, x in enumerate(coordinates) if x == 'x'), 0)
    places = [i for i in range(len(parts)) if coordinates[i : i + 2] == ['x', 'y']]
    budget.spend(records=len(coordinates) * len(table))
    for number, row in enumerate(table[depth + 1 :], depth + 2):
        cells = row + [''] * (len(coordinates) - len(row))
        for i in places:
            sure = cells[i + 2] if coordinates[i + 2 : i + 3] == ['likelihood'] else '1'
            if parts[i] in names and row:
                label = cells[first - 1]
                yield number, label, whose[i], names[parts[i]], (cells[i], cells[i + 1], sure)


def _of_markers(table: list[list[str]]) -> Iterator[Cells]:
    """Yields cells of a .trc of Sports2D: frame, time, and X, Y, Z = 0 of each marker, px."""
    head = next((i for i, x in enumerate(table) if x[:1] == ['Frame#']), None)
    if head is None:
        raise ValueError('no line Frame#, wanted a table of markers (.trc)')
    markers = [x for x in table[head][2:] if x]
    names = _landmarks(markers)
    rows = [(i, x) for i, x in enumerate(table) if i > head and x and x[0].isdecimal()]
    numbers = [[_number(x, i + 1) for x in row[2 : 2 + 3 * len(markers)]] for i, row in rows]
    if any(len(x) != 3 * len(markers) for x in numbers):
        raise ValueError('rows of markers have another length than the header')
    points = np.array(numbers).reshape(-1, 3)
    farthest = np.nanmax(np.abs(points), axis=0, initial=0.0)
    if farthest[2] > 0 or farthest[:2].max() <= _MAX_METRES:
        raise ValueError(
            'the markers have three coordinates or metres; wanted image positions: the file of '
            'Sports2D with _px_ in its name'
        )
    upwards = np.nanmax(points[:, 1], initial=-math.inf) <= 0
    for i, row in rows:
        for k, marker in enumerate(markers):
            x, y = row[2 + 3 * k : 4 + 3 * k]
            y = y.removeprefix('-') if upwards else y
            if marker in names:
                yield i + 1, row[1], '', names[marker], (x, y, '1')


def _landmarks(parts: Sequence[str]) -> dict[str, str]:
    """Landmark of each marker with a known name; raises ValueError if no name is known."""
    names = {x: landmark_name(x) for x in parts}
    known = {x: name for x, name in names.items() if landmark_called(name) is not None}
    if not known:
        raise ValueError(f'wanted names such as left_hip or LHip, saw {[*names][:6]}')
    return known


def _keys(labels: Sequence[str], when: str, source: FrameSource, first_stamp_ns: int) -> list[int]:
    """Frame keys from a column of labels; Unix times become relative to the first time."""
    if when == FRAME_COLUMN:
        return [source.number_of(x) for x in labels]
    try:
        times = [int(x) if when == STAMP_COLUMN else round(float(x) * SECOND_NS) for x in labels]
    except (ValueError, OverflowError) as error:
        raise ValueError(f'{when} has {error_line(error)[:60]}, wanted numbers') from error
    first, unit = min(times, default=0), 1
    while when == TIME_COLUMN and first / unit > _MAX_TIME * SECOND_NS:
        unit *= 1000  # milliseconds or shorter units
    if when == STAMP_COLUMN:
        first = first_stamp_ns
    elif first / unit < _MIN_UNIX_TIME * SECOND_NS:
        first = 0
    keys = [(x - first) // unit for x in times]
    if keys and (
        max(keys) - min(keys) > _MIN_UNIX_TIME * SECOND_NS or max(keys) + first_stamp_ns > 2**62
    ):
        raise ValueError(f'{when} has times that are years apart, wanted those of one recording')
    return keys


def _number(text: str, line: int) -> float:
    """The number in a cell; NaN for an empty cell."""
    try:
        return float(text) if text else math.nan
    except ValueError as error:
        raise ValueError(f'line {line}: {text[:40]!r}, wanted a number') from error
