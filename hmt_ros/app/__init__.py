"""What a person starts: `python -m hmt_ros <command>`, or each as an executable of its own."""

from __future__ import annotations

import importlib
import sys

import hmt_ros
from hmt_ros.app.printing import until_nobody_reads

# Command: (module, what it does). A module is imported when its command is given.
COMMANDS = {
    'replay': ('hmt_ros.app.replay.command', 'track the person in a bag, into a new bag'),
    'recover': ('hmt_ros.app.recover', 'save what is whole in a damaged bag'),
    'make-bag': ('hmt_ros.app.make_bag', 'render a motion into a bag with ground truth'),
    'train': ('hmt_ros.app.train', 'learn to predict poses from silhouettes'),
    'report': (
        'hmt_ros.app.report.command',
        'pictures and a page with a 3D view of the mixtures in a bag',
    ),
    'evaluate': ('hmt_ros.app.evaluate', 'errors and calibration of mixtures against ground truth'),
}

HELP = """\
usage: python -m hmt_ros <command> [arguments]

Monocular 3D human motion tracking with mixtures.

commands:
{commands}

python -m hmt_ros <command> --help tells what a command takes. Each is an executable of ROS 2 as
well, ros2 run hmt_ros <command>, and so are the nodes: filter_node, smoother_node, bme_node.

options:
  -h, --help  show this
  --version   show the version
"""


def main(argv: list[str] | None = None) -> int:
    """Runs a command; 0: done, 1: bad input, and one line on stderr says which."""
    return until_nobody_reads(lambda: _run(sys.argv[1:] if argv is None else argv))


def _run(arguments: list[str]) -> int:
    command, *rest = arguments or ['']
    if command in ('-h', '--help'):
        print(_help(), end='')
        return 0
    if command == '--version':
        print(f'hmt_ros {hmt_ros.__version__}')
        return 0
    if command not in COMMANDS:
        seen = f'no command {command!r}' if command else 'no command given'
        print(f'hmt_ros: {seen}, wanted one of {", ".join(COMMANDS)}', file=sys.stderr)
        return 1
    module = importlib.import_module(COMMANDS[command][0])
    return int(module.main(rest))


def _help() -> str:
    width = max(len(name) for name in COMMANDS)
    lines = [f'  {name:{width}}  {what}' for name, (_, what) in COMMANDS.items()]
    return HELP.format(commands='\n'.join(lines))
