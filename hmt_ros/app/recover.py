"""recover: copies the undamaged messages of a damaged or unfinished bag into a new bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import show_progress
from msg_tools.bags.bag_recovery import recover_bag

# Maximum number of lines about losses.
_MOST_LINES = 10

EPILOG = """\
BROKEN is a .mcap file or its folder, with or without metadata.yaml, from any recorder. If replay or
another command was killed while it wrote a bag, give the name that the bag would have had: the
hidden folder .NAME.*.partial beside it is found.

A bag written by this package loses at most the messages of its last chunk, one mebibyte. All whole
chunks and whole messages outside of chunks, according to the checksums of the file, are saved, with
their topics, definitions and quality of service. BROKEN is not changed.

examples:
  recover out -o recovered
  recover recording_0.mcap -o recovered

exit code: 0 something was saved, 1 nothing could be saved or bad input (one line on stderr)
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the new bag is there, 1: it is not, as one line explains."""
    return run_command(_parser(), _recover, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'recover',
        'Copies the undamaged messages of a damaged or unfinished bag into a new bag.',
        EPILOG,
    )
    parser.add_argument('bag', type=Path, metavar='BROKEN', help='damaged bag: a folder or a file')
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='OUT', help='folder of the new bag'
    )
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    return parser


def _recover(arguments: argparse.Namespace) -> int:
    with show_progress(str(arguments.output), 'messages', quiet=arguments.quiet) as bar:

        def saved(total: int | None) -> None:
            bar.total = total
            bar.update()

        found = recover_bag(arguments.bag, arguments.output, saved)
    print(f'{arguments.output}: {found.messages} messages of {found.topics} topics saved')
    if found.lost_messages is None:
        print('lost: the bag does not tell how many messages')
    elif found.lost_messages:
        print(f'lost: {found.lost_messages} messages')
    for line in found.losses[:_MOST_LINES]:
        print(f'  {line}')
    if len(found.losses) > _MOST_LINES:
        print(f'  and {len(found.losses) - _MOST_LINES} more places')
    if not found.losses and not found.lost_messages:
        print('lost: nothing')
    return 0
