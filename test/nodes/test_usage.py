"""Each node prints its usage and all parameters, wherever --help stands."""

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]
NODES = [path.stem for path in sorted((ROOT / 'hmt_ros' / 'nodes').glob('*_node.py'))]
# Helper modules, a process of several nodes, and a driver with arguments.
OTHERS = ('run_node', 'session_node', 'tracking_node', 'person_node', 'camera_node')
NODES = [name for name in NODES if name not in OTHERS]


@pytest.fixture
def helped(ended):
    """The help text of a node."""

    def help_of(node, *arguments):
        code, output, errors = ended(node, *arguments)
        assert (code, errors) == (0, '')
        return output

    return help_of


@pytest.mark.parametrize('node', NODES)
def test_help_lists_usage_and_all_parameters(node, helped):
    from importlib import import_module

    from hmt_ros.sessions.declared_parameters import declared_parameters

    module = import_module(f'hmt_ros.nodes.{node}')
    (kind,) = (x for x in vars(module).values() if getattr(x, 'NAME', '') == node)
    text = helped(node, '--help')
    assert text.startswith(f'usage: ros2 run hmt_ros {node} [--ros-args')
    assert max(map(len, text.splitlines())) <= 100
    words = ' '.join(text.split())
    declared = declared_parameters(kind.DEFAULTS)
    assert len(declared) >= 5
    for parameter in declared:
        assert re.search(rf'^  {re.escape(parameter.name)} \(\w.*; default .*\)$', text, re.M)
        assert ' '.join(parameter.description.split()) in words


@pytest.mark.parametrize('node', ['filter_node', 'camera_node'])
@pytest.mark.parametrize(
    'arguments',
    [
        ('-p', 'nonsense'),
        ('-p', 'x:=' + 10_000 * '['),
        ('--params-file', '/no\n\x1b[2J'),
        ('-r', '__ns:=/a b' + 10_000 * 'c'),
    ],
    ids=['parameter', 'nested', 'file', 'namespace'],
)
def test_bad_arguments_are_one_line(node, arguments, ended):
    code, output, errors = ended(node, 'video.mp4', '--ros-args', *arguments)
    assert (code, output) == (1, '')
    # rcl prints further lines, which begin with their time.
    (line,) = (x for x in errors.splitlines() if x.startswith(f'{node}: '))
    assert len(line) <= 300
    assert line.isprintable()
    assert 'Traceback' not in errors


@pytest.mark.parametrize(
    'arguments',
    [('-h',), ('--ros-args', '-p', 'max_hypotheses:=3', '--', '--help')],
)
def test_wherever_it_stands(arguments, helped):
    text = helped('filter_node', *arguments)
    assert '  max_hypotheses (int; ' in text
    assert text == helped('filter_node', '--help')
