"""Writes the generated parts of the pages.

    python docs/generate.py NAME [NAME ...]

The name of a node, such as filter_node, writes the table of its parameters. The name of a benchmark
runs it and writes its results (minutes; soak ten, experts fifteen, tracking thirty or more). Such a
part stands between `<!-- begin NAME -->` and `<!-- end -->`.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

# Page of each part.
PAGES = {
    'filter_node': 'nodes.md',
    'smoother_node': 'nodes.md',
    'bme_node': 'nodes.md',
    'keypoints_node': 'nodes.md',
    'hri_node': 'nodes.md',
    'people_adapter_node': 'nodes.md',
    'people_node': 'nodes.md',
    'bags': 'bags.md',
    'nodes': 'nodes.md',
    'live': 'nodes.md',
    'soak': 'robustness.md',
    'flips': 'flips.md',
    'forecast': 'robots.md',
    'keep_out': 'robots.md',
    'kernels': 'likelihood.md',
    'contour_noise': 'likelihood.md',
    'depth': 'likelihood.md',
    'distance': 'ground.md',
    'error_model': 'tracking.md',
    'gate': 'tracking.md',
    'joint_errors': 'body.md',
    'lifting': 'lifting.md',
    'keypoint_noise': 'keypoints.md',
    'motion_prior': 'motion_prior.md',
    'people': 'people.md',
    'hypotheses': 'sampling.md',
    'kjs': 'sampling.md',
    'real_video': 'real_video.md',
    'smoothing': 'smoothing.md',
    'experts': 'experts.md',
    'absence': 'tracking.md',
    'tracking': 'tracking.md',
    'vertical': 'ground.md',
    'votes': 'tracking.md',
}


def main(argv: list[str]) -> int:
    """Writes the parts that are named."""
    if not argv or any(name not in PAGES for name in argv):
        sys.stderr.write(f'generate.py: wanted some of {", ".join(PAGES)}\n')
        return 1
    for name in argv:
        path, content = DOCS / PAGES[name], part(name)
        # Read when it is written: a page may have been edited while a benchmark ran.
        path.write_text(with_part(path.read_text('utf-8'), name, content), 'utf-8')
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
    from benchmarks import benchmark

    measuring = benchmark(name)
    from benchmarks.machine import on_machine

    result = measuring.measure()
    return f'{measuring.as_text(result, markdown=True)}\n\n{on_machine(result["machine"])}'


def parameter_table(node: str) -> str:
    """All parameters of a node, as it declares them."""
    from hmt_ros.sessions.bme_parameters import BmeParameters
    from hmt_ros.sessions.declared_parameters import declared_parameters
    from hmt_ros.sessions.filter_parameters import FilterParameters
    from hmt_ros.sessions.hri_parameters import HriParameters
    from hmt_ros.sessions.keypoints_parameters import KeypointsParameters
    from hmt_ros.sessions.people_adapter_parameters import PeopleAdapterParameters
    from hmt_ros.sessions.people_parameters import PeopleParameters
    from hmt_ros.sessions.smoother_parameters import SmootherParameters

    settings = {
        'filter_node': FilterParameters(),
        'smoother_node': SmootherParameters(),
        'bme_node': BmeParameters(),
        'keypoints_node': KeypointsParameters(),
        'hri_node': HriParameters(),
        'people_adapter_node': PeopleAdapterParameters(),
        'people_node': PeopleParameters(),
    }
    lines = ['| parameter | default | range | takes effect | what |', '|---|---|---|---|---|']
    for parameter in declared_parameters(settings[node]):
        value = parameter.default
        text = str(value).lower() if isinstance(value, bool) else str(value)
        default = f'`{text}`' if value != () and text else 'empty'
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
