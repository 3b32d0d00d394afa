"""recover: a bag anew from what is whole in one whose writing was cut off, or which is damaged."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, run_command
from msg_tools.bags.bag_recovery import recover_bag

# More lines about losses than this tell nothing more.
_MOST_LINES = 10

EPILOG = """\
BROKEN may be the .mcap file or its folder, with or without metadata.yaml, of any recorder. Where
replay, or another command that writes a bag, was killed, the bag is not in its place: give the name
that it would have had, and the hidden folder .NAME.*.partial beside it is found.

A bag that this package writes loses at most the messages of its last chunk, a mebibyte. Saved is
what is whole by the checksums of the file, whole chunks and whole messages outside of chunks, with
topics, definitions and quality of service. BROKEN stays as it is.

examples:
  recover out -o recovered
  recover recording_0.mcap -o recovered

exit code: 0 something was saved, 1 nothing could be saved or bad input (one line on stderr)
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the new bag is there, 1: it is not, and one line on stderr says why."""
    return run_command(_parser(), _recover, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='recover',
        description='Makes a bag of what is whole in one whose writing was cut off, or which is '
        'damaged.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('bag', type=Path, metavar='BROKEN', help='folder or file')
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='OUT', help='folder of the new bag'
    )
    return parser


def _recover(options: argparse.Namespace) -> int:
    found = recover_bag(options.bag, options.output)
    print(f'{options.output}: {found.messages} messages of {found.topics} topics saved')
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


if __name__ == '__main__':
    sys.exit(main())
