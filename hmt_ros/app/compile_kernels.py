"""compile: compiles all kernels, so that the first image of a node or a command does not wait.

It runs the same work as the nodes do before they are active. Compiled code is kept (see
`hmt_ros.compiled_code`).
"""

from __future__ import annotations

import argparse
import time

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import say, show_progress
from hmt_ros.compiled_code import compiled_functions, folder_in_use
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.bme_session import BmeSession
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import SmootherSession
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: done, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _compile, argv)


def _parser() -> CommandParser:
    parser = CommandParser('compile', 'Compiles all kernels, so that no first image waits for it.')
    parser.add_argument('--quiet', action='store_true', help='print only warnings and errors')
    return parser


def _compile(arguments: argparse.Namespace) -> int:
    compiled, start = compiled_functions(), time.monotonic()
    before = compiled.count
    with show_progress('kernels', quiet=arguments.quiet):
        TrackingSession(FilterParameters(), lambda output: None).prepare()
        SmootherSession(SmootherParameters(), lambda output: None).prepare()
        BmeSession(BmeParameters(), lambda output: None).prepare()
    if not arguments.quiet:
        count, spent = compiled.count - before, time.monotonic() - start
        say(f'{count} functions compiled in {spent:.0f} s, kept in {folder_in_use()}')
    return 0
