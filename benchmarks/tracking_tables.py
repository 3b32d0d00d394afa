"""The tables of `tracking`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from benchmarks.clips import table
from benchmarks.runs import GIVEN
from benchmarks.tracking_means import DETECTOR
from benchmarks.tracking_speed import OPENCV, costs_as_text, speed_as_text


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        head: title of the column.
        key: key of the score.
        form: number format.
        factor: factor on the score.
    """

    head: str
    key: str
    form: str = '.0f'
    factor: float = 1.0

    def cell(self, value: float | None, sign: str = '') -> str:
        """A number, or `-` for None."""
        if value is None:
            return '-'
        text = format(self.factor * value, sign + self.form)
        # Negative numbers that round to zero are shown without sign.
        return format(0.0, sign + self.form) if float(text) == 0.0 else text


HEAVIEST, POINT = Column('heaviest', 'heaviest_mm'), Column('point', 'point_mm')
LAGGED = Column('lag 10', 'lagged_mm')
BEST, BLIND = Column('best of K', 'best_mm'), Column('blind', 'blind_mm')
KEPT = Column('kept, %', 'kept', factor=100.0)
WEIGHTS = Column('weights', 'weights', '+.2f')
JOINT_90 = Column('joint 90 %', 'joint_coverage_90', factor=100.0)
EVALUATIONS = Column('evaluations', 'evaluations')
EXPECTED, HIPS = Column('expected', 'expected_mm'), Column('hips', 'hips_mm')
LOG_DENSITY = Column('-log p', 'negative_log_likelihood', '.1f')
WRONG_WAY = Column('wrong way, %', 'wrong_way', '.1f', 100.0)
WRONG_SIGN = Column('wrong sign, %', 'wrong_sign', '.1f', 100.0)
NOBODY = Column('nobody, %', 'nobody', '.1f', 100.0)
CPU = Column('CPU, ms', 'cpu_ms')
ERRORS = (
    HEAVIEST, LAGGED, HIPS, EXPECTED, POINT, Column('PA', 'aligned_mm'), BEST, BLIND,
    KEPT, Column('root, %', 'root_percent', '.1f'), Column('depth, %', 'depth_percent', '+.1f'),
    Column('path, %', 'path_percent', '.1f'),
    Column('path length, %', 'path_length_percent', '+.1f'),
)  # fmt: skip
CALIBRATION = (
    Column('50 %', 'coverage_50', factor=100.0), Column('90 %', 'coverage_90', factor=100.0),
    Column('joint 50 %', 'joint_coverage_50', factor=100.0), JOINT_90,
    Column('absolute 50 %', 'absolute_coverage_50', factor=100.0),
    Column('absolute 90 %', 'absolute_coverage_90', factor=100.0),
    Column('volume, l', 'volume', '.1f'), LOG_DENSITY, WEIGHTS,
    Column('acceleration', 'acceleration', '.1f'), Column('feet, m/s', 'feet', '.2f'),
    EVALUATIONS,
)  # fmt: skip
# Large mistakes, and the cost of an image.
MISTAKES = (
    WRONG_WAY, Column('images', 'wrong_way_images', '.1f'), WRONG_SIGN, NOBODY,
    EVALUATIONS, Column('99 %', 'evaluations_99'), Column('ms', 'ms'), CPU,
)  # fmt: skip
# Columns for comparisons of two settings or checkouts.
COMPARED = tuple(
    column._replace(form=column.form.replace('.0f', '.1f'))
    for column in (
        HEAVIEST, LAGGED, HIPS, EXPECTED, POINT, BEST, KEPT, WEIGHTS, JOINT_90, WRONG_WAY,
        WRONG_SIGN, NOBODY, EVALUATIONS, CPU,
    )
)  # fmt: skip
WORST_JOINT = 'worst joint 90 %'


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables."""
    parts = [f'{result["clips"]}; seeds {", ".join(map(str, result["seeds"]))}']
    if result['without_keypoints']:
        parts.append(
            f'Without keypoints of a detector, images alone: '
            f'{", ".join(result["without_keypoints"])}.'
        )
    for group in result.get('accuracy', []):
        parts.append(f'{group["group"]}: errors in mm; kept, root, depth and path in %.')
        parts.append(_table(group, ERRORS, markdown))
        parts.append(f'{group["group"]}: calibration and motion.')
        parts.append(_table(group, CALIBRATION, markdown, worst_joint=True))
        parts.append(f'{group["group"]}: large mistakes, and what an image costs.')
        parts.append(_table(group, MISTAKES, markdown))
    if 'against' in result:
        found = result['against']
        what = f'{", ".join(found["changes"])} minus the usual settings'
        parts += _tables_of_comparison(found, what, markdown)
    if 'baseline' in result:
        found = result['baseline']
        for clip, given, rate, gravity in found['lacking']:
            which = f'{clip}, {given}, rate {_rate(rate)}, gravity {gravity}'
            parts.append(f'{which}: not in {found["folder"]}.')
        parts += _tables_of_comparison(found, f'this code minus {found["folder"]}', markdown)
    if 'speed' in result:
        cores = result['machine']['cores']
        parts.append(speed_as_text(result['speed'], cores, markdown=markdown))
        parts.append(f'Processor time of a step in floors, that of {OPENCV} of the same images:')
        parts.append(costs_as_text(result['costs'], markdown=markdown))
    return '\n\n'.join(parts)


def _table(
    group: dict[str, Any],
    columns: Sequence[Column],
    markdown: bool,
    *,
    sign: str = '',
    worst_joint: bool = False,
) -> str:
    """Table of clips and inputs, then means of each input with their intervals."""
    extra = [WORST_JOINT] if worst_joint else []
    entries = [*group['clips'], *group['means']]
    rated = ['rate'] if any(entry['rate'] > 0 for entry in entries) else []
    upright = ['gravity'] if any(entry['gravity'] == GIVEN for entry in entries) else []

    def head(name: str, entry: dict[str, Any]) -> list[str]:
        conditions = [*(_rate(entry['rate']) for _ in rated), *(_gravity(entry) for _ in upright)]
        return [name, entry['inputs'], *conditions]

    rows = [['clip', 'inputs', *rated, *upright, *(column.head for column in columns), *extra]]
    for entry in group['clips']:
        cells = [column.cell(entry.get(column.key), _sign(column, sign)) for column in columns]
        cells += [_worst_joint(entry)] if worst_joint else []
        rows.append([*head(entry['clip'], entry), *cells])
    for means in group['means']:
        known = [(column, means.get(column.key, [None] * 3)) for column in columns]
        cells = [column.cell(values[0], _sign(column, sign)) for column, values in known]
        cells += [_worst_joint(means)] if worst_joint else []
        rows.append([*head('mean', means), *cells])
        ends = [_ends(column, values, sign) for column, values in known]
        rows.append([*head('95 %', means), *ends, *['' for _ in extra]])
    return table(rows, left=2 + len(rated) + len(upright), markdown=markdown)


def _rate(rate: float) -> str:
    return f'{rate:g}' if rate > 0 else 'all'


def _gravity(entry: dict[str, Any]) -> str:
    """Whether gravity was given; a detector does not use it."""
    return '-' if entry['inputs'] == DETECTOR else str(entry['gravity'])


def _tables_of_comparison(found: dict[str, Any], what: str, markdown: bool) -> list[str]:
    """Tables of differences by group, over all clips, and paired ones of the heaviest mode."""
    parts = []
    for group in found['groups']:
        parts.append(f'{group["group"]}: {what}, mm.')
        parts.append(_table(group, COMPARED, markdown, sign='+'))
    if sum(bool(group['means']) for group in found['groups']) > 1:
        parts.append(f'All clips: {what}, mm.')
        parts.append(_table({**found, 'clips': []}, COMPARED, markdown, sign='+'))
    parts.append(
        f'Heaviest mode: {what}, mm, mean and 95 % interval over clips and seeds; clips whose own '
        'interval over the seeds lies wholly above or below 0.'
    )
    rows = [['group', 'inputs', 'rate', 'gravity', 'clips', 'difference', '95 %', 'above', 'below']]
    column = COMPARED[0]
    rows += [
        [
            each['group'], each['inputs'], _rate(each['rate']), each['gravity'], str(each['clips']),
            column.cell(each['difference'][0], '+'), _ends(column, each['difference'], '+'),
            _number_of(each['above']), _number_of(each['below']),
        ]
        for each in found['paired']
    ]  # fmt: skip
    parts.append(table(rows, left=4, markdown=markdown))
    return parts


def _number_of(clips: Sequence[str]) -> str:
    return f'{len(clips)} ({", ".join(clips)})' if clips else '0'


def _sign(column: Column, sign: str) -> str:
    return '' if column.form.startswith('+') else sign


def _ends(column: Column, values: Sequence[float | None], sign: str = '') -> str:
    _, low, high = values
    own = _sign(column, sign)
    return '-' if low is None else f'{column.cell(low, own)} to {column.cell(high, own)}'


def _worst_joint(entry: dict[str, Any]) -> str:
    shares = {name: x for name, x in entry.get('by_joint_90', {}).items() if x is not None}
    if not shares:
        return '-'
    name = min(shares, key=lambda name: shares[name])
    return f'{100 * shares[name]:.0f} {name}'
