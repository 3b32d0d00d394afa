"""The demonstration that `make demo` runs: a bag through the tracker, pictures, a table of errors.

`python -m hmt_ros.app.demo bags/reach -o build/demo --live`
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from hmt_ros.app import replay
from hmt_ros.app.bag_scores import score_bag
from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.evaluate import as_text
from hmt_ros.app.recorded_track import RecordedTrack, read_images, read_track
from hmt_ros.app.report_pictures import PICTURES, draw_track, shown_in_pictures
from hmt_ros.app.truth import Truth, read_truth, recorded_truth
from msg_tools import BagReader


def main(argv: list[str] | None = None) -> int:
    """Runs the demonstration; 0: done, 1: bad input, and one line on stderr says which."""
    return run_command(_parser(), _demonstrate, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='demo',
        description='Tracks the person of a bag, draws pictures of the track and, where the truth '
        'is known, prints errors.',
    )
    parser.add_argument(
        'bag',
        type=Path,
        help='folder of a bag with subject.yaml and, if there is one, background.png in it',
    )
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='DIR',
        help='folder for the bag of the track and the pictures',
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
    track = read_track(target)
    truth = _truth(source, target)
    pictures = draw(source, folder, track, truth)
    print(_summary(track, spent))
    if truth is not None:
        print(as_text(score_bag(target, truth), truth, by_joint=False))
        print('docs/evaluation.md tells what the numbers mean')
    print('\nwhat came out')
    for path, what in ((target, 'bag: ' + ', '.join(_topics(target))), *pictures):
        print(f'  {path!s:{max(len(str(x)) for x, _ in pictures)}}  {what}')
    return 0


def draw(
    source: Path, folder: Path, track: RecordedTrack, truth: Truth | None
) -> list[tuple[Path, str]]:
    """Draws all pictures of a track; each with what it shows.

    Args:
        source: bag of the images.
        folder: for the pictures.
        track: what was tracked.
        truth: None: not known.
    """
    camera, images = read_images(source, shown_in_pictures(track))
    what = PICTURES | ({'weights.png': f'{PICTURES["weights.png"]}, errors'} if truth else {})
    return [(folder / x, what[x]) for x in draw_track(folder, track, camera, images, truth)]


def _truth(source: Path, target: Path) -> Truth | None:
    """The truth in the bag, or beside its source."""
    recorded = recorded_truth(target)
    beside = source / 'truth.npz'
    return read_truth(beside) if recorded is None and beside.is_file() else recorded


def _summary(track: RecordedTrack, spent: float) -> str:
    count = len(track.moments)
    modes = np.mean([len(moment.weights) for moment in track.moments])
    heaviest = np.mean([moment.weights[0] for moment in track.moments])
    return (
        f'{spent:.1f} s for {count} images; {modes:.1f} modes an image, the heaviest with '
        f'{100 * heaviest:.0f} % of the weight on average\n'
    )


def _topics(bag: Path) -> list[str]:
    with BagReader(bag) as reader:
        return [topic.name for topic in reader.topics.values() if topic.message_count]


if __name__ == '__main__':
    sys.exit(main())
