"""Writes the tables and files of parameters, and the results of benchmarks.

    python docs/generate.py NAME [NAME ...]

The name of a node, such as filter_node, writes the table of its parameters in NAME.md, between
`<!-- begin NAME -->` and `<!-- end -->`, and hmt_ros/config/NAME.yaml. The name of a benchmark, or
of a part that has a page, runs it and writes benchmarks/results/NAME.md (minutes; live, oracles,
soak and tracking about ten).
"""

from __future__ import annotations

import math
import sys
import textwrap
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

NODES = (
    'filter_node',
    'smoother_node',
    'bme_node',
    'keypoints_node',
    'hri_node',
    'people_node',
)
# Mark in the table, and its explanation, by the time at which a new value takes effect.
_EFFECTS = {
    'at once': ('', ''),
    'next track': ('†', 'with the next track'),
    'next window': ('†', 'with the next window'),
    'next configure': ('‡', 'at the next configuration'),
    'at launch': ('§', 'only at launch'),
}
_MARKS = [*_EFFECTS.values()]
RESULTS = DOCS.parent / 'benchmarks' / 'results'
CONFIG = DOCS.parent / 'hmt_ros' / 'config'
_WIDTH, _INDENT = 100, '    '


def main(argv: list[str]) -> int:
    """Writes the files for the given names."""
    from benchmarks import BENCHMARKS, PARTS

    known = (*NODES, *BENCHMARKS, *PARTS)
    if not argv or any(name not in known for name in argv):
        sys.stderr.write(f'generate.py: wanted some of {", ".join(known)}\n')
        return 1
    for name in argv:
        if name in NODES:
            page = DOCS / f'{name}.md'
            page.write_text(
                with_part(page.read_text('utf-8'), name, parameter_table(name)), 'utf-8'
            )
            like = ('filter_node', settings_of('filter_node')) if name == 'people_node' else ()
            text = parameter_file_text(name, settings_of(name), *like)
            (CONFIG / f'{name}.yaml').write_text(text, 'utf-8')
        else:
            (RESULTS / f'{name}.md').write_text(results(name), 'utf-8')
    return 0


def with_part(page: str, name: str, content: str) -> str:
    """A page with a part replaced.

    Raises:
        ValueError: the page has no such part.
    """
    begin, end = f'<!-- begin {name} -->\n', '<!-- end -->\n'
    head, found, rest = page.partition(begin)
    _, closed, tail = rest.partition(end)
    if not found or not closed:
        raise ValueError(f'no part {name!r}')
    return f'{head}{begin}{content}\n{end}{tail}'


def results(name: str) -> str:
    """Runs a benchmark and returns its results as a page."""
    from benchmarks import BENCHMARKS, PARTS, benchmark

    module, command, what = PARTS.get(name) or (name, name, BENCHMARKS[name])
    measuring = benchmark(module)
    from benchmarks.machine import on_machine

    result = measuring.measure()
    table, machine = measuring.as_text(result, markdown=True), on_machine(result['machine'])
    head = f'# {name}: {what}\n\n```\npython -m benchmarks {command}\n```'
    return f'{head}\n\n{table}\n\n{machine}\n'


def settings_of(node: str) -> Any:
    """The parameters of a node with their defaults."""
    from hmt_ros.sessions.bme_parameters import BmeParameters
    from hmt_ros.sessions.hri_parameters import HriParameters
    from hmt_ros.sessions.keypoints_session import KeypointsParameters
    from hmt_ros.sessions.smoother_parameters import SmootherParameters
    from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters

    kinds = {
        'filter_node': FilterParameters,
        'smoother_node': SmootherParameters,
        'bme_node': BmeParameters,
        'keypoints_node': KeypointsParameters,
        'hri_node': HriParameters,
        'people_node': PeopleParameters,
    }
    return kinds[node]()


def parameter_file_text(node: str, settings: Any, like: str = '', others: Any = None) -> str:
    """A parameter file with all parameters, each under a comment that describes it.

    Args:
        like: name of the node whose file lists the parameters that both share; '' if no node
            shares them.
        others: settings of that node.
    """
    from hmt_ros.sessions.declared_parameters import EFFECTS, declared_parameters
    from hmt_ros.sessions.parameter_file import PARAMETERS_KEY, yaml_scalar

    declared = declared_parameters(settings)
    if like:
        known = declared_parameters(others)
        declared = [parameter for parameter in declared if parameter not in known]
    used = {parameter.effect for parameter in declared}
    lines = [
        f'# Parameters of {node}, with their defaults. A file needs only those that it changes:',
        '#',
        f'#     ros2 run hmt_ros {node} --ros-args --params-file FILE',
        '#',
        *([f'# All others are those of {like}: see {like}.yaml.', '#'] if like else []),
        '# In square brackets: lowest and highest value, and when a new value takes effect:',
        *(
            f'# "{name}": {text[0].lower()}{text[1:]}'
            for name, text in EFFECTS.items()
            if name in used
        ),
        f'/**/{node}:',
        f'  {PARAMETERS_KEY}:',
    ]
    for parameter in declared:
        facts = parameter.bounds, parameter.effect
        lines.extend(
            textwrap.wrap(
                f'{parameter.description} [{"; ".join(filter(None, facts))}]',
                _WIDTH,
                initial_indent=f'{_INDENT}# ',
                subsequent_indent=f'{_INDENT}# ',
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
        lines.append(f'{_INDENT}{parameter.name}: {yaml_scalar(parameter.default)}')
    return '\n'.join(lines) + '\n'


def parameter_table(node: str) -> str:
    """The table of the parameters that a node declares.

    Parameters that filter_node has with the same default, description and effect are named below
    the table, or only counted for people_node, which has nearly all.
    """
    from hmt_ros.sessions.declared_parameters import declared_parameters

    declared = declared_parameters(settings_of(node))
    known = [] if node == 'filter_node' else declared_parameters(settings_of('filter_node'))
    shared = [f'`{parameter.name}`' for parameter in declared if parameter in known]
    declared = [parameter for parameter in declared if parameter not in known]
    rest = ''
    if shared:
        named = f'{", ".join(shared[:-1])} and {shared[-1]}'
        which = f'The other {len(shared)}' if node == 'people_node' else named
        rest = f' {which} are as for [filter_node](filter_node.md#parameters).'
    lines, same = ['| parameter | default, range | meaning |', '|---|---|---|'], ''
    for parameter in declared:
        value = parameter.default
        text = str(value).lower() if isinstance(value, bool) else str(value)
        default = f'`{text}`' if value != () and text else 'empty'
        if parameter.limits is not None:
            low, high = (_number(limit) for limit in parameter.limits)
            default += f', {low} to {high}' if high else f', at least {low}'
        mark, _ = _EFFECTS[parameter.effect]
        description = parameter.description.replace('<', '&lt;')
        head, _, tail = description.partition(': ')
        if tail and tail == same:
            description = f'{head}: as above.'
        same = tail
        lines.append(f'| `{parameter.name}`{mark} | {default} | {description} |')
    used = dict.fromkeys(_EFFECTS[parameter.effect] for parameter in declared)
    marks = ', '.join(f'{mark} {text}' for mark, text in sorted(used, key=_MARKS.index) if mark)
    return '\n'.join([*lines, '', f'New values take effect at once; {marks}.{rest}'])


def _number(limit: float) -> str:
    return '' if math.isinf(limit) or limit == 2**31 - 1 else f'{limit:g}'


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
