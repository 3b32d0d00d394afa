"""The tables of `tracking`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from benchmarks.clips import table
from benchmarks.runs import GIVEN
from benchmarks.tracking_budgets import budgets_as_text
from benchmarks.tracking_means import DETECTOR
from benchmarks.tracking_oracle import as_text as oracle_as_text
from benchmarks.tracking_speed import OPENCV, costs_as_text, memory_as_text, speed_as_text


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
# Large mistakes, and what an image costs.
MISTAKES = (
    WRONG_WAY, Column('images', 'wrong_way_images', '.1f'), WRONG_SIGN, NOBODY,
    EVALUATIONS, Column('99 %', 'evaluations_99'), Column('ms', 'ms'), CPU,
)  # fmt: skip
# Where the model has joints of the trunk.
OFFSETS = tuple(
    Column(f'{joint}, {way}', f'{joint}_{way}_mm', '+.0f')
    for joint in ('neck', 'shoulders', 'hips')
    for way in ('ahead', 'up')
)
# Of two kinds of settings.
COMPARED = tuple(
    column._replace(form=column.form.replace('.0f', '.1f'))
    for column in (
        HEAVIEST, LAGGED, HIPS, EXPECTED, POINT, BEST, KEPT, WEIGHTS, JOINT_90, WRONG_WAY,
        WRONG_SIGN, NOBODY, EVALUATIONS, CPU,
    )
)  # fmt: skip
# Of the tracker without a rule.
OF_RULES = tuple(
    column._replace(form=column.form.replace('.0f', '.1f'))
    for column in (
        HEAVIEST, EXPECTED, BEST, BLIND, LOG_DENSITY, WEIGHTS, WRONG_WAY, NOBODY, EVALUATIONS, CPU,
    )
)  # fmt: skip
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
        parts.append(f'{group["group"]}: large mistakes, and what an image costs.')
        parts.append(_table(group, MISTAKES, markdown))
        if group['means']:
            parts.append(
                f'{group["group"]}: how far joints lie ahead and above the true ones, mm, seen '
                'from the pelvis in the frame of the trunk.'
            )
            parts.append(_table({**group, 'clips': []}, OFFSETS, markdown))
    if 'budgets' in result:
        parts.append(budgets_as_text(result['budgets'], markdown=markdown))
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
    if 'rules' in result:
        parts += _tables_of_rules(result['rules'], markdown)
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
        parts.append(f'Processor time of a step in floors, that of {OPENCV} of the same images:')
        parts.append(costs_as_text(result['costs'], markdown=markdown))
    if 'scaling' in result:
        from benchmarks.tracking_scaling import scaling_as_text

        parts.append(scaling_as_text(result['scaling'], markdown=markdown))
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
    """Clips and inputs, then means with their intervals and medians of each input."""
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
    for means, medians in zip(group['means'], group['medians'], strict=True):
        known = [(column, means.get(column.key, [None] * 3)) for column in columns]
        cells = [column.cell(values[0], _sign(column, sign)) for column, values in known]
        cells += [_worst_joint(means)] if worst_joint else []
        rows.append([*head('mean', means), *cells])
        ends = [_ends(column, values, sign) for column, values in known]
        rows.append([*head('95 %', means), *ends, *['' for _ in extra]])
        cells = [column.cell(medians.get(column.key), _sign(column, sign)) for column in columns]
        rows.append([*head('median', medians), *cells, *['' for _ in extra]])
    return table(rows, left=2 + len(rated) + len(upright), markdown=markdown)


def _rate(rate: float) -> str:
    return f'{rate:g}' if rate > 0 else 'all'


def _gravity(entry: dict[str, Any]) -> str:
    """Whether gravity was given; a detector takes none."""
    return '-' if entry['inputs'] == DETECTOR else str(entry['gravity'])


def _tables_of_comparison(found: dict[str, Any], what: str, markdown: bool) -> list[str]:
    """Differences by group, of all clips together, and paired ones of the heaviest mode."""
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


def _tables_of_rules(found: dict[str, Any], markdown: bool) -> list[str]:
    """Differences without each rule: the heaviest mode in short, then all scores."""
    what = f'clips {", ".join(found["clips"])}; seeds {", ".join(map(str, found["seeds"]))}'
    parts = [f'The tracker without each rule minus the usual one: {what}.']
    parts += [f'Skipped: {name}: {why}.' for name, why in found['skipped'].items()]
    groups = [group for rule in found['rules'] for group in rule['groups']]
    titles = [group['group'] for group in groups if group['means']]
    for title in dict.fromkeys(titles):
        parts.append(
            f'{title}: heaviest mode without the rule, mm, more is worse; by input, rate and '
            'gravity. Last, how often a clip has an interval over its seeds wholly above or below '
            '0.'
        )
        parts.append(_summary_of_rules(found['rules'], title, markdown))
        parts.append(f'{title}: differences of all scores.')
        head = ['group', 'rule', 'inputs', 'rate', 'gravity', *(column.head for column in OF_RULES)]
        rows = [head]
        for rule, means in _means_of_rules(found['rules'], title):
            cells = [_with_ends(column, means[column.key]) for column in OF_RULES]
            conditions = [means['inputs'], _rate(means['rate']), means['gravity']]
            rows.append([rule['rule_group'], rule['rule'], *conditions, *cells])
        parts.append(table(rows, left=5, markdown=markdown))
    return parts


def _summary_of_rules(rules: Sequence[dict[str, Any]], title: str, markdown: bool) -> str:
    """One row a rule, one column an input, rate and gravity."""
    every = [
        (means['inputs'], means['rate'], means['gravity'])
        for _, means in _means_of_rules(rules, title)
    ]
    columns = list(dict.fromkeys(every))
    columns.sort(key=lambda column: -column[1] if column[1] > 0 else float('-inf'))
    heads = [
        f'{given}, {_rate(rate)}' + (', gravity given' if gravity == GIVEN else '')
        for given, rate, gravity in columns
    ]
    rows = [['group', 'rule', *heads, 'above', 'below']]
    for rule in rules:
        own = {
            (x['inputs'], x['rate'], x['gravity']): _with_ends(OF_RULES[0], x[OF_RULES[0].key])
            for _, x in _means_of_rules([rule], title)
        }
        mine = [x for x in rule['paired'] if x['group'] == title]
        counts = [str(sum(len(x[side]) for x in mine)) for side in ('above', 'below')]
        cells = [own.get(column, '') for column in columns]
        rows.append([rule['rule_group'], rule['rule'], *cells, *counts])
    return table(rows, left=2, markdown=markdown)


def _means_of_rules(
    rules: Sequence[dict[str, Any]], title: str
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Rules with each of the means of a group of clips."""
    for rule in rules:
        for group in rule['groups']:
            if group['group'] == title:
                for means in group['means']:
                    yield rule, means


def _with_ends(column: Column, values: Sequence[float | None]) -> str:
    mean = column.cell(values[0], _sign(column, '+'))
    return mean if values[1] is None else f'{mean} ({_ends(column, values, "+")})'


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
