"""Writes the parts of the pages that are made by programs.

    python docs/generate.py filter_node smoother_node bme_node
                                           tables of parameters in nodes.md
    python docs/generate.py flips          times in flips.md
    python docs/generate.py kjs            minima that samples find in sampling.md (minutes)
    python docs/generate.py kernels        times in likelihood.md
    python docs/generate.py nodes          rates and latency of nodes in nodes.md (minutes)
    python docs/generate.py soak           the table of robustness.md (ten minutes)
    python docs/generate.py smoothing      exactness and speed in smoothing.md (minutes)
    python docs/generate.py bags           rates and memory in bags.md (minutes)
    python docs/generate.py experts        experts.md (a quarter of an hour)
    python docs/generate.py tracking       accuracy and speed in tracking.md (minutes)
    python docs/generate.py votes          votes for chains in tracking.md (minutes)

Such a part stands between `<!-- begin NAME -->` and `<!-- end -->`.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

PAGES = {
    'filter_node': 'nodes.md',
    'smoother_node': 'nodes.md',
    'bme_node': 'nodes.md',
    'bags': 'bags.md',
    'nodes': 'nodes.md',
    'soak': 'robustness.md',
    'flips': 'flips.md',
    'kernels': 'likelihood.md',
    'kjs': 'sampling.md',
    'smoothing': 'smoothing.md',
    'experts': 'experts.md',
    'tracking': 'tracking.md',
    'votes': 'tracking.md',
}


def main(argv: list[str]) -> int:
    """Writes the parts that are named."""
    if not argv or any(name not in PAGES for name in argv):
        sys.stderr.write(f'generate.py: wanted some of {", ".join(PAGES)}\n')
        return 1
    for name in argv:
        path = DOCS / PAGES[name]
        path.write_text(with_part(path.read_text('utf-8'), name, part(name)), 'utf-8')
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


def part(name: str) -> str:
    """The content of a part."""
    if name.endswith('_node'):
        return parameter_table(name)
    from benchmarks import (
        bags,
        experts,
        flips,
        kernels,
        kjs,
        nodes,
        smoothing,
        soak,
        tracking,
        votes,
    )

    pages = {
        'bags': bags,
        'nodes': nodes,
        'soak': soak,
        'flips': flips,
        'kernels': kernels,
        'kjs': kjs,
        'smoothing': smoothing,
        'experts': experts,
        'tracking': tracking,
        'votes': votes,
    }
    return pages[name].page()


def parameter_table(node: str) -> str:
    """All parameters of a node, as it declares them."""
    from hmt_ros.nodes.bme_parameters import BmeParameters
    from hmt_ros.nodes.declared_parameters import declared_parameters
    from hmt_ros.nodes.filter_parameters import FilterParameters
    from hmt_ros.nodes.smoother_parameters import SmootherParameters

    settings = {
        'filter_node': FilterParameters(),
        'smoother_node': SmootherParameters(),
        'bme_node': BmeParameters(),
    }
    lines = ['| parameter | default | range | takes effect | what |', '|---|---|---|---|---|']
    for parameter in declared_parameters(settings[node]):
        value = parameter.default
        text = str(value).lower() if isinstance(value, bool) else str(value)
        default = f'`{text}`' if text else 'empty'
        bounds = ''
        if parameter.limits is not None:
            low, high = (_number(limit) for limit in parameter.limits)
            bounds = f'{low} to {high}' if high else f'at least {low}'
        cells = (f'`{parameter.name}`', default, bounds, parameter.effect, parameter.description)
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines)


def _number(limit: float) -> str:
    return '' if math.isinf(limit) or limit == 2**31 - 1 else f'{limit:g}'


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
