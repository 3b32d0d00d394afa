"""hypotheses: what it brings to keep more modes, on clips with known truth, by images alone.

Runs are kept in build/benchmarks/tracking until the code changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.clips import table, with_file
from benchmarks.command import benchmark_parser, show
from benchmarks.machine import description
from benchmarks.runs import IMAGES, Run, run_all
from benchmarks.tracker_changes import changed
from benchmarks.tracking_means import OF_CHOSEN, OF_OTHERS, group_of
from benchmarks.tracking_scores import interval, scores_of
from hmt_ros.tracking import TrackerSettings

COUNTS = (1, 2, 4, 8, 16)
# Four clips that settings were chosen on, and four others; images of each, 3 s.
CLIPS = ('walk', 'charleston', 'signals', 'kick', 'laugh', 'dab', 'turns', 'drill')
LENGTH, QUICK = 90, 12
SEEDS = (0, 1)
SCORES = ('heaviest_mm', 'best_mm', 'blind_mm', 'evaluations')


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('hypotheses', __doc__, quick=f'{QUICK} images a clip, one seed')
    options = parser.parse_args(argv)
    length, seeds = (QUICK, SEEDS[:1]) if options.quick else (LENGTH, SEEDS)
    return show(measure(length, seeds), as_text, as_json=options.json)


def measure(
    length: int = LENGTH,
    seeds: Sequence[int] = SEEDS,
    clips: Sequence[str] = CLIPS,
    processes: int = 0,
) -> dict[str, Any]:
    """Errors by number of modes and group of clips; `skipped` tells why there are none.

    Args:
        length: images of each clip, from its start.
        seeds: of the tracker.
        clips: names of development clips.
        processes: number of processes; 0: one a core.
    """
    result: dict[str, Any] = {'machine': description(), 'clips': list(clips), 'rows': []}
    try:
        folders = with_file(clips, None, 'truth.npz')
    except FileNotFoundError as error:
        return result | {'skipped': str(error)}
    runs = [
        Run(folder, IMAGES, seed, _change(count), length)
        for count in COUNTS for folder in folders for seed in seeds
    ]  # fmt: skip
    scores = [scores_of(record) for record in run_all(runs, processes)]
    for group in (OF_CHOSEN, OF_OTHERS):
        for count in COUNTS:
            mine = [
                (one, x) for one, x in zip(runs, scores, strict=True)
                if one.changes == _change(count) and group_of(one.clip) == group
            ]  # fmt: skip
            if mine:
                values = {
                    name: np.array([x[name] for _, x in mine]).reshape(-1, len(seeds))
                    for name in SCORES
                }
                result['rows'].append(
                    {'group': group, 'modes': count, 'clips': sorted({one.clip for one, _ in mine})}
                    | {name: interval(value) for name, value in values.items()}
                )
    return result | {'images': length, 'seeds': list(seeds)}


def _change(count: int) -> tuple[tuple[str, Any], ...]:
    """The change that keeps so many modes; none where that is usual."""
    change = (('max_hypotheses', count),)
    return () if changed(change) == TrackerSettings() else change


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    if 'skipped' in result:
        return f'skipped: {result["skipped"]}'
    rows = [['clips', 'modes', 'heaviest, mm', 'best, mm', 'blind, mm', 'evaluations']]
    for row in result['rows']:
        errors = [_cell(row[name]) for name in SCORES[:-1]]
        name = ', '.join(row['clips'])
        rows.append([name, str(row['modes']), *errors, f'{row["evaluations"][0]:.0f}'])
    seeds = ', '.join(map(str, result['seeds']))
    return (
        f'{table(rows, markdown=markdown)}\n\nFirst {result["images"]} images of each clip, images '
        f'alone, seeds {seeds}; in brackets the 95 % interval over clips and seeds.'
    )


def _cell(found: tuple[float, float | None, float | None]) -> str:
    mean, low, high = found
    return f'{mean:.0f}' if low is None else f'{mean:.0f} ({low:.0f} to {high:.0f})'
