"""The tables of `tracking`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from benchmarks.clips import table
from benchmarks.tracking_oracle import as_text as oracle_as_text
from benchmarks.tracking_speed import memory_as_text, speed_as_text


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        head: of the column.
        key: of the score.
        form: of a number.
        factor: that the score is multiplied with.
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
        # Without the sign of a zero that was rounded from below.
        return format(0.0, sign + self.form) if float(text) == 0.0 else text


HEAVIEST, POINT = Column('heaviest', 'heaviest_mm'), Column('point', 'point_mm')
BEST, BLIND = Column('best of K', 'best_mm'), Column('blind', 'blind_mm')
KEPT = Column('kept, %', 'kept', factor=100.0)
WEIGHTS = Column('weights', 'weights', '+.2f')
JOINT_90 = Column('joint 90 %', 'joint_coverage_90', factor=100.0)
EVALUATIONS = Column('evaluations', 'evaluations')
ERRORS = (
    HEAVIEST, Column('expected', 'expected_mm'), POINT, Column('PA', 'aligned_mm'), BEST, BLIND,
    KEPT, Column('root, %', 'root_percent', '.1f'), Column('depth, %', 'depth_percent', '+.1f'),
    Column('path, %', 'path_percent', '.1f'),
    Column('path length, %', 'path_length_percent', '+.1f'),
)  # fmt: skip
CALIBRATION = (
    Column('50 %', 'coverage_50', factor=100.0), Column('90 %', 'coverage_90', factor=100.0),
    Column('joint 50 %', 'joint_coverage_50', factor=100.0), JOINT_90,
    Column('-log p', 'negative_log_likelihood', '.1f'), WEIGHTS,
    Column('acceleration', 'acceleration', '.1f'), Column('feet, m/s', 'feet', '.2f'),
    EVALUATIONS,
)  # fmt: skip
# Of two kinds of settings.
COMPARED = tuple(
    column._replace(form=column.form.replace('.0f', '.1f'))
    for column in (HEAVIEST, POINT, BEST, KEPT, WEIGHTS, JOINT_90)
)
OF_ABLATIONS = (HEAVIEST, POINT, BEST, BLIND, KEPT, WEIGHTS, JOINT_90, EVALUATIONS)
WORST_JOINT = 'worst joint 90 %'


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
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
    if 'against' in result:
        found = result['against']
        what = ', '.join(found['changes'])
        for group in found['groups']:
            parts.append(f'{group["group"]}: {what} minus the usual settings, mm.')
            parts.append(_table(group, COMPARED, markdown, sign='+'))
        if len(found['groups']) > 1:
            parts.append(f'All clips: {what} minus the usual settings, mm.')
            parts.append(_table({**found, 'clips': []}, COMPARED, markdown, sign='+'))
    if 'ablations' in result:
        found = result['ablations']
        parts.append(f'Images alone, seed 0; mean over {", ".join(found["clips"])}.')
        parts.append(_table_of_ablations(found['rows'], markdown))
    if 'sizes' in result:
        found = result['sizes']
        rows = [['size of the images', 'heaviest, mm']]
        rows += [[f'{x["size"]:g}', HEAVIEST.cell(x[HEAVIEST.key])] for x in found['rows']]
        difference = 100.0 * found['largest_difference']
        parts.append(
            f'{found["clip"]} with smaller images, images alone: '
            f'the error differs by {difference:.0f} % at most.'
        )
        parts.append(table(rows, markdown=markdown))
    if 'oracle' in result:
        parts.append(oracle_as_text(result['oracle'], markdown=markdown))
    if 'speed' in result:
        cores = result['machine']['cores']
        parts.append(speed_as_text(result['speed'], cores, markdown=markdown))
    if 'memory' in result:
        parts.append(memory_as_text(result['memory']))
    return '\n\n'.join(parts)


def _table(
    group: dict[str, Any],
    columns: Sequence[Column],
    markdown: bool,
    *,
    sign: str = '',
    worst_joint: bool = False,
) -> str:
    """Clips and inputs, then the means of each input with their intervals."""
    extra = [WORST_JOINT] if worst_joint else []
    rows = [['clip', 'inputs', *(column.head for column in columns), *extra]]
    for entry in group['clips']:
        cells = [column.cell(entry.get(column.key), _sign(column, sign)) for column in columns]
        cells += [_worst_joint(entry)] if worst_joint else []
        rows.append([entry['clip'], entry['inputs'], *cells])
    for means in group['means']:
        known = [(column, means.get(column.key, [None] * 3)) for column in columns]
        cells = [column.cell(values[0], _sign(column, sign)) for column, values in known]
        cells += [_worst_joint(means)] if worst_joint else []
        rows.append(['mean', means['inputs'], *cells])
        ends = [_ends(column, values, sign) for column, values in known]
        rows.append(['95 %', means['inputs'], *ends, *['' for _ in extra]])
    return table(rows, left=2, markdown=markdown)


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


def _table_of_ablations(rows: list[dict[str, Any]], markdown: bool) -> str:
    result = [['setting', 'value', *(column.head for column in OF_ABLATIONS)]]
    for row in rows:
        cells = [f'{x.cell(row[x.key][0])} ({_ends(x, row[x.key])})' for x in OF_ABLATIONS[:-1]]
        last = OF_ABLATIONS[-1]
        result.append([row['setting'], str(row['value']), *cells, last.cell(row[last.key][0])])
    return table(result, left=2, markdown=markdown)
