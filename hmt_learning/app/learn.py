"""learn: learns from motion files what the tracker knows of people.

learn WHAT FILES_OR_FOLDERS ...      WHAT: lengths, lifter, motion, prior
"""

from __future__ import annotations

import argparse
import importlib

from hmt_ros.app.command_line import CommandParser, run_command

WHAT = ('lengths', 'lifter', 'motion', 'prior')


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: done, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _learn, argv)


def _parser() -> CommandParser:
    parser = CommandParser('learn', 'Learns from motion files what the tracker knows of people.')
    parser.add_argument('what', choices=WHAT, help='what is learned')
    parser.add_argument('rest', nargs=argparse.REMAINDER, help='see learn WHAT --help')
    return parser


def _learn(arguments: argparse.Namespace) -> int:
    module = importlib.import_module(f'hmt_learning.app.learn_{arguments.what}')
    return int(module.main(arguments.rest))
