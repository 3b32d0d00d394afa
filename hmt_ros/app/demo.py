"""The demonstration that `make demo` runs: a bag through the tracker, a table of errors, a report.

`python -m hmt_ros.app.demo bags/reach -o build/demo --live`
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.evaluate import as_text
from hmt_ros.app.replay import command as replay
from hmt_ros.app.report.command import write_report
from hmt_ros.app.report.page import Content
from hmt_ros.app.truth import recorded_truth
from msg_tools import BagReader

REPORT = 'report'


def main(argv: list[str] | None = None) -> int:
    """Runs the demonstration; 0: done, 1: bad input, and one line on stderr says which."""
    return run_command(_parser(), _demonstrate, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='demo',
        description='Tracks the person of a bag, prints errors, where the truth is known, and '
        'leaves pictures and a page for a browser.',
    )
    parser.add_argument(
        'bag',
        type=Path,
        help='folder of a bag with subject.yaml and, if there is one, background.png in it',
    )
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='DIR',
        help='folder for the bag of the track and the report',
    )  # fmt: skip
    parser.add_argument('--live', action='store_true', help='through the real node, over DDS')
    return parser


def _demonstrate(options: argparse.Namespace) -> int:
    source, folder = options.bag, options.output
    target = folder / source.resolve().name
    how = 'the real nodes' if options.live else 'the tracker'
    print(f'{source} through {how}', flush=True)
    arguments = [str(source), '-o', str(target), '--overwrite']
    for option, name in (('--subject', 'subject.yaml'), ('--background', 'background.png')):
        if (source / name).is_file():
            arguments += [option, str(source / name)]
    start = time.monotonic()
    code = replay.main([*arguments, *(['--live'] if options.live else [])])
    if code != 0:
        return code
    spent = time.monotonic() - start
    beside = source / 'truth.npz'
    arguments = [str(target), '-o', str(folder / REPORT), '--overwrite', '--images', str(source)]
    if beside.is_file() and recorded_truth(target) is None:
        arguments += ['--truth', str(beside)]
    shown, made = write_report(arguments)
    print(_summary(shown, spent))
    if shown.truth is not None:
        print(as_text(shown.scores, shown.truth, by_joint=False))
        print('docs/evaluation.md tells what the numbers mean\n')
    print(f'what came out\n{target}: bag of {", ".join(_topics(target))}\n{made}')
    return 0


def _summary(shown: Content, spent: float) -> str:
    (track,) = (x.track for x in shown.mixtures.layers if x.topic == 'pose_mixture')
    modes = np.mean([len(moment.weights) for moment in track.moments])
    heaviest = np.mean([moment.weights[0] for moment in track.moments])
    return (
        f'{spent:.1f} s; {modes:.1f} modes an image, the heaviest with {100 * heaviest:.0f} % of '
        'the weight on average\n'
    )


def _topics(bag: Path) -> list[str]:
    with BagReader(bag) as reader:
        return [topic.name for topic in reader.topics.values() if topic.message_count]


if __name__ == '__main__':
    sys.exit(main())
