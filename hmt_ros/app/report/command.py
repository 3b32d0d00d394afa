"""report: figures of the mixtures in a bag, and one page with a 3D view of them, for a browser."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from hmt_ros.app.bag_scores import chosen_topics, score_bag
from hmt_ros.app.command_line import CommandParser, run_command, whole_number
from hmt_ros.app.recorded_bodies import body_topics
from hmt_ros.app.report.film_strip import FilmStrip, ImageSource, film_strip, image_source
from hmt_ros.app.report.page import Content, data_size, page_html
from hmt_ros.app.report.recorded_mixtures import RecordedMixtures, read_mixtures
from hmt_ros.app.report.report_pictures import PICTURES, draw_pictures, shown_in_pictures
from hmt_ros.app.truth import Truth, read_truth, recorded_truth
from msg_tools import BagReader
from msg_tools.files.new_folder import FolderKind

PAGE = 'report.html'
# Bytes of the page at most, and what of it data may take before times are left out.
PAGE_BYTES = 19_500_000
DATA_BYTES = 12_000_000
# Bytes of all that does not grow with time: program and scores.
REST_BYTES = 200_000
MAX_TIMES = 600
_FOLDER = FolderKind('a report', PAGE, tuple(PICTURES))

EPILOG = """\
DIR gets report.html, which needs nothing but a browser, neither network nor other files: images
with the modes on them, all modes in a 3D view that turns with the mouse, a slider through time,
weights, free energy of trajectories and, where the truth is known, errors and calibration. Beside
it lie pictures (PNG) for documents. DIR is written whole or not at all.

Images are those of --images, else those that OUT has itself (replay --with-images), else its
overlay/compressed, on which the heaviest modes are drawn already. The page never exceeds 20 MB:
images are scaled down as needed.

examples:
  report out -o report --images bags/reach
  report out -o report --images walk.mcap --truth truth.npz
  report out.mcap -o report --topic pose_mixture --topic smoothed_pose_mixture

exit code: 0 done, 1 bad input (one line on stderr says which), 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the report is there, 1: bad input, and one line on stderr says which."""
    return run_command(_parser(), _report, argv, whole_or_nothing=True)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='report',
        description='Figures of the mixtures in a bag, and one page with a 3D view of them.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'bag', type=Path, metavar='OUT', help='bag with mixtures: a folder, or a file'
    )
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='DIR', help='folder of the report'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace the report that is there')
    parser.add_argument('--quiet', action='store_true', help='neither progress bar nor summary')
    parser.add_argument(
        '--images', type=Path, metavar='IN', help='bag of the images that were tracked'
    )
    parser.add_argument(
        '--truth',
        type=Path,
        metavar='FILE',
        help='true joint positions: a .npz file with stamps, joint_names and joints, or a bag with '
        'ground truth (that of OUT, where it has one)',
    )
    parser.add_argument(
        '--topic',
        action='append',
        default=[],
        metavar='NAME',
        help='show this topic of mixtures only; may be given several times (all)',
    )
    parser.add_argument(
        '--times',
        type=whole_number(1, 5000),
        default=MAX_TIMES,
        metavar='N',
        help=f'show at most so many times, evenly spread; scores are of all ({MAX_TIMES})',
    )
    parser.add_argument('--image-topic', metavar='NAME', help='images, as for replay')
    parser.add_argument('--camera-info-topic', metavar='NAME', help='calibration, as for replay')
    parser.add_argument(
        '--body',
        metavar='MODEL',
        help='body model whose poses they are: a name or a YAML file (the one that OUT names)',
    )
    return parser


def _report(options: argparse.Namespace) -> int:
    _, summary = _write_report(options)
    if not options.quiet:
        print(summary)
    return 0


def write_report(arguments: Sequence[str]) -> tuple[Content, str]:
    """Writes a report.

    Args:
        arguments: of the command.

    Returns:
        What it shows, and lines that sum up what came out.

    Raises:
        ValueError, OSError: bad input; one line that says why.
    """
    return _write_report(_parser().parse_args(arguments))


def _write_report(options: argparse.Namespace) -> tuple[Content, str]:
    _FOLDER.check_place(options.output, overwrite=options.overwrite)
    with BagReader(options.bag) as bag:
        bag.raise_damage()
    source = image_source(
        options.bag, options.images, options.image_topic, options.camera_info_topic
    )
    # None: shown where stderr is a terminal.
    with tqdm(unit='message', desc=str(options.output), disable=options.quiet or None) as bar:
        content = _content(options, source, bar)
        with _FOLDER.new(options.output, overwrite=options.overwrite) as folder:
            folder.mkdir()
            page = page_html(content).encode('utf-8')
            (folder / PAGE).write_bytes(page)
            drawn = draw_pictures(
                folder, content.mixtures, content.images, content.truth, content.scores
            )
    lines = [f'{options.output / PAGE}: {len(content.stamps)} times, {len(page) / 1e6:.1f} MB']
    lines += [f'{options.output / name}: {PICTURES[name]}' for name in drawn]
    return content, '\n'.join([*lines, *content.notes])


def _content(options: argparse.Namespace, source: ImageSource | None, bar: tqdm) -> Content:
    """What is to be shown."""
    named = options.truth is not None
    truth = read_truth(options.truth) if named else recorded_truth(options.bag)
    with BagReader(options.bag) as bag:
        topics = chosen_topics(bag, options.topic)
        bar.total = bag.message_count({*topics, *body_topics(bag)}) * (1 if truth is None else 2)
    if source is not None:
        with BagReader(source.bag) as bag:
            bar.total += bag.message_count([source.topic])
    everything = read_mixtures(
        options.bag, topics=topics, body_model=options.body, progress=bar.update
    )
    scores = {}
    if truth is not None:
        scores = score_bag(
            options.bag,
            truth,
            topics=_with_truth(everything, truth),
            body_model=options.body,
            progress=bar.update,
        )
    stamps = _shown(everything, options.times)
    mixtures = everything.at(stamps)
    notes = []
    if len(stamps) < len(everything.stamps):
        notes.append(f'{len(stamps)} of {len(everything.stamps)} times are shown')
    notes += [
        f'the trajectories on {topic.topic} are not drawn and have no errors: the bag does not '
        'tell of which body they are'
        for topic in everything.trajectories
        if not topic.ends
    ]
    notes += [
        f'{name} has no likelihood and no coverage: {topic.note}'
        for name, topic in scores.items()
        if topic.note
    ]
    images = FilmStrip()
    if source is not None:
        images = _images(source, stamps, mixtures, bar)
        if len(images.jpegs) < len(stamps):
            notes.append(f'{len(stamps) - len(images.jpegs)} times are shown without an image')
    title = f'{options.bag.resolve().name}: mixtures over poses'
    return Content(title, stamps, mixtures, images, truth, scores, notes)


def _with_truth(mixtures: RecordedMixtures, truth: Truth) -> list[str]:
    """Topics that can be scored; all, where none can be, so that it is told why."""
    stamps = {
        layer.topic: {moment.stamp_ns for moment in layer.track.moments}
        for layer in mixtures.layers
    }
    for topic in mixtures.trajectories:
        if topic.ends:  # without a body there are no joints
            stamps[topic.topic] = {stamp for window in topic.windows for stamp in window.stamps_ns}
    known = [name for name, own in stamps.items() if not own.isdisjoint(truth.joints)]
    layers = [layer.topic for layer in mixtures.layers]
    return known or [*layers, *(one.topic for one in mixtures.trajectories)]


def _shown(mixtures: RecordedMixtures, most: int) -> list[int]:
    """Times that are shown: all, or every so many if the page would get too large."""
    stamps = mixtures.stamps
    most = min(most, int(len(stamps) * min(DATA_BYTES / data_size(mixtures), 1.0)))
    return stamps[:: -(-len(stamps) // max(most, 1))]


def _images(
    source: ImageSource, stamps: list[int], mixtures: RecordedMixtures, bar: tqdm
) -> FilmStrip:
    left = PAGE_BYTES - REST_BYTES - data_size(mixtures)
    keep = shown_in_pictures(mixtures.layers[0].track) if mixtures.layers else set()
    # In base64 three bytes take four.
    return film_strip(source, stamps, left * 3 // 4, keep=keep, progress=bar.update)


if __name__ == '__main__':
    sys.exit(main())
