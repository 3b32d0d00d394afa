"""The demonstration of `make demo`: tracks the person in a bag, prints errors, writes a report.

`python -m hmt_ros.app.demo bags/reach -o build/demo --live`
"""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.evaluate import as_text, score_gravity
from hmt_ros.app.progress import tell_user
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.report.command import ReportOptions, write_report
from hmt_ros.app.report.page import Content
from hmt_ros.app.truth import read_truth, recorded_truth
from msg_tools import BagReader

REPORT = 'report'


def main(argv: list[str] | None = None) -> int:
    """Runs the demonstration; 0: done, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _demonstrate, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'demo',
        'Tracks the person in a bag, prints errors if the truth is known, and writes a report.',
    )
    parser.add_argument(
        'bag', type=Path,
        help='folder of a bag, with subject.yaml and, if available, background.png in it',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='DIR',
        help='folder for the new bag and the report',
    )  # fmt: skip
    parser.add_argument('--live', action='store_true', help='run the real nodes, over DDS')
    return parser


def _demonstrate(arguments: argparse.Namespace) -> int:
    source, folder = arguments.bag, arguments.output
    target = folder / source.resolve().name
    print(
        f'tracking {source} with {"the real nodes" if arguments.live else "the tracker"}',
        flush=True,
    )

    def beside(name: str) -> Path | None:
        return source / name if (source / name).is_file() else None

    options = ReplayOptions(
        overwrite=True,
        live=arguments.live,
        subject=beside('subject.yaml'),
        background=beside('background.png'),
    )
    start = time.monotonic()
    replayed = replay_bag(source, target, options, partial(tell_user, 'replay'))
    spent = time.monotonic() - start
    print(f'{replayed} in {spent:.1f} s')
    truth = beside('truth.npz') if recorded_truth(target) is None else None
    shown, written = write_report(
        ReportOptions(target, folder / REPORT, overwrite=True, images=source, truth=truth)
    )
    print(_modes(shown))
    if shown.truth is not None:
        known = beside('truth.npz')
        verticals = {} if known is None else score_gravity(target, read_truth(known))
        print(as_text(shown.scores, shown.truth, verticals, by_joint=False))
        print('docs/evaluation.md explains the numbers\n')
    print(f'results\n{target}: bag with {", ".join(_topics(target))}\n{written}')
    return 0


def _modes(shown: Content) -> str:
    (layer,) = (layer for layer in shown.mixtures.layers if layer.kind == 'posterior')
    moments = layer.mixtures.values()
    modes = np.mean([len(moment.weights) for moment in moments])
    heaviest = np.mean([moment.weights[0] for moment in moments])
    return (
        f'{modes:.1f} modes per image; the heaviest has {100 * heaviest:.0f} % of the weight on '
        'average\n'
    )


def _topics(bag: Path) -> list[str]:
    with BagReader(bag) as reader:
        return [topic.name for topic in reader.topics.values() if topic.message_count]


if __name__ == '__main__':
    sys.exit(main())
