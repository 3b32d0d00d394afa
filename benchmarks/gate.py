"""gate: fails if a step of the tracker costs more than the limit in gate.json.

The unit of processor time is the floor, OpenCV's work on the same images in the same run (`tracking
--parts speed`), so that machines and loads can be compared. The lower of two runs is used. --write
stores the measured values in the table.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import find_clips, table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import description
from benchmarks.tracking_speed import PRICED, costs

TABLE = Path(__file__).with_name('gate.json')
# Maximum accepted factor above the table.
MARGIN = 1.15
RUNS, QUICK = 2, 12


def floors_of(
    clips: Path | None = None, *, quick: bool = False
) -> tuple[str, dict[str, dict[str, float]]]:
    """Source of the clips, and mean floors of a step over the clips, by inputs and rate.

    Args:
        clips: folder of the clips; None means the development clips, or bags/.
        quick: one run, and few images.

    Raises:
        ValueError: no clip has a background.
    """
    folders, source = find_clips(clips, quick=quick)
    priced = [x for x in folders if x.name in PRICED] or folders
    priced = [folder for folder in priced if (folder / 'background.png').is_file()]
    if not priced:
        raise ValueError(f'{source}: no clip has a background.png')
    jobs = [(folder, run) for folder in priced for run in range(1 if quick else RUNS)]
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for folder, _ in told('gate', jobs, lambda job: f'{job[0].name}, run {job[1] + 1}'):
        for row in costs(folder, QUICK if quick else None):
            rate = 'all' if row['rate'] == 0 else f'{row["rate"]:g}'
            found.setdefault((row['inputs'], rate), {}).setdefault(folder.name, []).append(
                row['mean']
            )
    result: dict[str, dict[str, float]] = {}
    for (inputs, rate), by_clip in found.items():
        result.setdefault(inputs, {})[rate] = float(np.mean([min(x) for x in by_clip.values()]))
    return source, result


def compared(
    source: str,
    found: Mapping[str, Mapping[str, float]],
    limits: Mapping[str, Mapping[str, Mapping[str, float]]],
) -> list[dict[str, Any]]:
    """Rows of measured values and table values; `over` is true for too much.

    Raises:
        ValueError: the table lacks these clips, inputs or rates.
    """
    rows = []
    for inputs, by_rate in found.items():
        for rate, floors in by_rate.items():
            try:
                limit = float(limits[source][inputs][rate])
            except (KeyError, TypeError) as error:
                raise ValueError(
                    f'{TABLE.name} has no floors for {source}, {inputs}, rate {rate}; --write adds '
                    'what is measured'
                ) from error
            rows.append(
                {
                    'inputs': inputs,
                    'rate': rate,
                    'floors': floors,
                    'table': limit,
                    'over': floors > MARGIN * limit,
                }
            )
    return rows


def measure(
    clips: Path | None = None, *, quick: bool = False, write: bool = False
) -> dict[str, Any]:
    """Costs of a step, compared with the table.

    Args:
        clips, quick: as for `floors_of`.
        write: whether to store the measured values in the table.

    Raises:
        ValueError: there are no clips, or no table to compare with.
    """
    limits = read_table(TABLE)
    source, found = floors_of(clips, quick=quick)
    if write:
        limits[source] = {
            inputs: {rate: round(x, 1) for rate, x in by_rate.items()}
            for inputs, by_rate in found.items()
        }
        TABLE.write_text(json.dumps(limits, indent=1, sort_keys=True) + '\n', 'utf-8')
    rows = compared(source, found, limits)
    return {'machine': description(), 'clips': source, 'rows': rows}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    head = ['inputs', 'rate', 'floors', 'table', '']
    rows = [
        [x['inputs'], x['rate'], f'{x["floors"]:.1f}', f'{x["table"]:.1f}',
         'too much' if x['over'] else 'met']
        for x in result['rows']
    ]  # fmt: skip
    return table([head, *rows], left=2, markdown=markdown)


def read_table(path: Path) -> dict[str, Any]:
    """Checked-in floors by clips, inputs and images per second; empty if missing."""
    return dict(json.loads(path.read_text('utf-8'))) if path.is_file() else {}


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns 1 if a step costs too much or nothing can be compared."""
    parser = benchmark_parser('gate', __doc__, quick=f'one run over {QUICK} images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--write', action='store_true', help='write the table')
    options = parser.parse_args(arguments)
    try:
        result = measure(options.clips, quick=options.quick, write=options.write)
    except ValueError as error:
        print(f'gate: {error}', file=sys.stderr)
        return 1
    show(result, as_text, as_json=options.json)
    return int(any(row['over'] for row in result['rows']))
