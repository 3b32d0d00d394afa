"""What the evaluations that an image may cost bring: errors and processor time by their budget.

The two budgets of the product, at every rate of images; smaller ones at the first rate with one
seed, on the clips that settings were chosen on. An interval is that of `tracking_scores.interval`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import table
from benchmarks.runs import INPUTS, KEYPOINTS, USUAL_RATE, Record, Run, run_all
from benchmarks.tracking_means import GROUPS, OF_CHOSEN, group_of
from benchmarks.tracking_scores import interval, scores_of
from hmt_ros.sessions.filter_parameters import LIVE_BUDGET
from hmt_ros.tracking.settings import ACCURATE_BUDGET

Array = NDArray[Any]
PROFILES = {'accurate': ACCURATE_BUDGET, 'live': LIVE_BUDGET}
SMALLER = (150, 80, 40)
# Images that start a track: their cost is not that of a step.
STARTING = 2


def budgets(runs: Sequence[Run], processes: int = 0) -> list[dict[str, Any]]:
    """Errors and costs by group of clips, rate and budget.

    Args:
        runs: with the usual settings; of keypoints alone the first seed is taken, as nothing is
            drawn there.
        processes: number of processes; 0: one a core.
    """
    seed = runs[0].seed
    runs = [one for one in runs if one.inputs != KEYPOINTS or one.seed == seed]
    first = runs[0].rate
    asked: list[tuple[int, Run]] = [(budget, one) for budget in PROFILES.values() for one in runs]
    asked += [
        (budget, one)
        for budget in SMALLER
        for one in runs
        if one.rate == first and one.seed == seed and group_of(one.clip) == OF_CHOSEN
    ]
    found = run_all([_with(budget, one) for budget, one in asked], processes)
    rows: dict[tuple[str, float, int], dict[str, dict[str, list[Record]]]] = {}
    for (budget, one), record in zip(asked, found, strict=True):
        row = rows.setdefault((group_of(one.clip), one.rate, budget), {})
        row.setdefault(one.inputs, {}).setdefault(one.clip, []).append(record)
    order = sorted(rows, key=lambda key: (GROUPS.index(key[0]), -(key[1] or np.inf), -key[2]))
    return [
        {'group': group, 'rate': rate, 'budget': budget}
        | {given: _row(clips) for given, clips in rows[group, rate, budget].items()}
        for group, rate, budget in order
    ]


def _with(budget: int, one: Run) -> Run:
    """The run with a budget. The usual budget changes no setting: records of usual runs serve."""
    return (
        one if budget == ACCURATE_BUDGET else replace(one, changes=(('evaluation_budget', budget),))
    )


def _row(clips: dict[str, list[Record]]) -> dict[str, Any]:
    """Means over clips and seeds; the error with both ends."""
    errors = np.array([[scores_of(x)['heaviest_mm'] for x in seeds] for seeds in clips.values()])
    records = [x for seeds in clips.values() for x in seeds]
    costs = [_later(x.cpu_seconds).mean() for x in records]
    spent = [_later(x.evaluations).mean() for x in records]
    return {
        'heaviest_mm': interval(errors),
        'cpu_ms': 1e3 * float(np.mean(costs)),
        'evaluations': float(np.mean(spent)),
    }


def _later(values: Array) -> Array:
    """Of the images after the start; of the last one where there are no more."""
    return values[min(STARTING, len(values) - 1) :]


def budgets_as_text(rows: Sequence[dict[str, Any]], *, markdown: bool = False) -> str:
    """A table for each group of clips."""
    names = {budget: name for name, budget in PROFILES.items()}
    parts = []
    for group in GROUPS:
        mine = [row for row in rows if row['group'] == group]
        inputs = [given for given in INPUTS if any(given in row for row in mine)]
        cells = [['images a second', 'budget', *inputs]]
        for row in mine:
            rate, budget = row['rate'] or USUAL_RATE, row['budget']
            name = f'{budget}, {names[budget]}' if budget in names else str(budget)
            cells.append([f'{rate:g}', name, *(_cell(row.get(given)) for given in inputs)])
        if mine:
            parts.append(f'{group}: error of the heaviest mode, processor time of a step')
            parts.append(table(cells, markdown=markdown))
    return '\n\n'.join(parts)


def _cell(found: dict[str, Any] | None) -> str:
    if found is None:
        return '-'
    mean, low, high = found['heaviest_mm']
    ends = '' if low is None else f' ({low:.0f} to {high:.0f})'
    return f'{mean:.0f}{ends} mm, {found["cpu_ms"]:.0f} ms'
