"""The commands: `python -m hmt_ros <command>`, or each as an executable of its own."""

from __future__ import annotations

import importlib
import sys

import hmt_ros
from hmt_ros.app.command_line import until_nobody_reads

# Command: (module, description). A module is imported when its command runs.
COMMANDS = {
    'track-video': ('hmt_ros.app.track_video', 'import a video, track the person, write a report'),
    'import-video': (
        'hmt_ros.app.import_video.command',
        'write a video and the keypoints of a detector into a bag',
    ),
    'lift': ('hmt_ros.app.lift', 'tell the poses of a person from keypoints alone'),
    'subject': ('hmt_ros.app.subject', 'write the start of a track from keypoints in a bag'),
    'replay': (
        'hmt_ros.app.replay.command',
        'track the person in a bag and write the poses into a new bag',
    ),
    'recover': (
        'hmt_ros.app.recover',
        'copy the undamaged messages of a damaged bag into a new bag',
    ),
    'make-bag': ('hmt_ros.app.make_bag', 'render a motion into a bag with ground truth'),
    'compile': (
        'hmt_ros.app.compile_kernels',
        'compile all kernels, so that no first image waits for it',
    ),
    'install-detector': (
        'hmt_ros.app.install_detector',
        'install a detector of keypoints, MediaPipe Pose',
    ),
    'train': ('hmt_ros.app.train', 'learn a predictor of poses from silhouettes'),
    'learn-prior': (
        'hmt_ros.app.learn_prior',
        'learn the prior of the joint angles from motion files',
    ),
    'learn-motion': (
        'hmt_ros.app.learn_motion',
        'learn how poses move, from recorded motions',
    ),
    'learn-lifter': (
        'hmt_ros.app.learn_lifter',
        'learn experts that tell depths from keypoints, from recorded motions',
    ),
    'learn-lengths': (
        'hmt_ros.app.learn_lengths',
        'learn how lengths vary over people, from the skeletons of motion files',
    ),
    'report': (
        'hmt_ros.app.report.command',
        'show the mixtures in a bag: pictures, and a page with a 3D view',
    ),
    'export': (
        'hmt_ros.app.export',
        'write the motion of a recorded run as BVH, a table or arrays',
    ),
    'evaluate': ('hmt_ros.app.evaluate', 'compare the mixtures in a bag with ground truth'),
}

HELP = """\
usage: python -m hmt_ros <command> [arguments]

Monocular 3D human motion tracking with mixtures.

commands:
{commands}

python -m hmt_ros <command> --help lists the arguments of a command. ROS 2 runs the same commands,
ros2 run hmt_ros <command>, and the nodes filter_node, smoother_node and bme_node.

options:
  -h, --help  show this help
  --version   show the version
"""


def main(argv: list[str] | None = None) -> int:
    """Runs a command; 0: done, 1: bad input, which one line on stderr explains."""
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
