"""report: draws the mixtures in a bag as pictures, and as one HTML page with a 3D view."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, run_command, whole_number
from hmt_ros.app.evaluate import chosen_topics, score_bag
from hmt_ros.app.progress import Progress, say, show_progress
from hmt_ros.app.recorded_bodies import BODY, read_grounds
from hmt_ros.app.report.detector import read_detector
from hmt_ros.app.report.images import FilmStrip, ImageSource, film_strip, image_source
from hmt_ros.app.report.mixtures import RecordedMixtures, read_mixtures
from hmt_ros.app.report.page import Content, data_size, page_html
from hmt_ros.app.report.pictures import PICTURES, draw_pictures, shown_in_pictures
from hmt_ros.app.truth import read_truth, recorded_truth
from hmt_ros.evaluation.track_scores import Truth
from msg_tools import BagReader
from msg_tools.files.new_folder import FolderKind

PAGE = 'report.html'
# Maximum sizes, bytes: the page; its data (times that do not fit are left out); its images, as a
# constant and an equal addition per second.
PAGE_BYTES = 19_500_000
DATA_BYTES = 12_000_000
IMAGE_BYTES = 700_000
# Size of program and scores, which is the same for any number of times, bytes.
REST_BYTES = 200_000
MAX_TIMES = 600
_FOLDER = FolderKind('a report', PAGE, tuple(PICTURES))

EPILOG = """\
DIR gets report.html, a page that needs only a browser, neither network nor other files: images
with the modes on them, all modes in a 3D view that turns with the mouse, a slider through time,
weights, probabilities of the image cues, free energy of trajectories and, if the truth is known,
errors and calibration. DIR also gets the pictures (PNG) for documents. It is written completely or
not at all.

The images come from --images, else from OUT itself (replay --with-images), else from its topic
overlay/compressed, on which the heaviest modes are already drawn. Images are scaled down to a
total of 0.7 MB plus 0.7 MB per second, and the page never exceeds 20 MB.

examples:
  report out -o report --images bags/reach
  report out -o report --images walk.mcap --truth truth.npz
  report out.mcap -o report --topic pose_mixture --topic smoothed_pose_mixture

exit code: 0 done, 1 bad input (one line on stderr explains it), 130 interrupted
"""


@dataclass(frozen=True)
class ReportOptions:
    """Arguments of the command, see its help; `notes` are additional lines on the page."""

    bag: Path
    output: Path
    overwrite: bool = False
    quiet: bool = False
    images: Path | None = None
    truth: Path | None = None
    topics: Sequence[str] = ()
    times: int = MAX_TIMES
    image_topic: str | None = None
    camera_info_topic: str | None = None
    body: str | None = None
    notes: Sequence[str] = ()


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _report, argv, whole_or_nothing=True)


def _parser() -> CommandParser:
    parser = CommandParser(
        'report',
        'Shows the mixtures in a bag: pictures, and one page with a 3D view of the modes.',
        EPILOG,
    )
    parser.add_mixtures('show')
    parser.add_output('DIR', 'report', 'folder of the report')
    parser.add_argument(
        '--images', type=Path, metavar='IN', help='bag of the images that were tracked'
    )
    parser.add_argument(
        '--times',
        type=whole_number(1, 5000),
        default=MAX_TIMES,
        metavar='N',
        help=f'show at most N times, evenly spread; scores use all times (default: {MAX_TIMES})',
    )
    parser.add_argument('--image-topic', metavar='NAME', help='topic of the images, as for replay')
    parser.add_argument(
        '--camera-info-topic', metavar='NAME', help='topic of the calibration, as for replay'
    )
    return parser


def _report(arguments: argparse.Namespace) -> int:
    options = ReportOptions(**vars(arguments))
    _, summary = write_report(options)
    if not options.quiet:
        say(summary)
    return 0


def write_report(options: ReportOptions) -> tuple[Content, str]:
    """Writes a report.

    Returns:
        The content of the page, and lines of text that list the files.

    Raises:
        ValueError, OSError: bad input, explained in one line.
    """
    _FOLDER.check_place(options.output, overwrite=options.overwrite)
    source = image_source(
        options.bag, options.images, options.image_topic, options.camera_info_topic
    )
    with show_progress(str(options.output), 'messages', quiet=options.quiet) as bar:
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


def _content(options: ReportOptions, source: ImageSource | None, bar: Progress) -> Content:
    """Reads and scores the content of the page."""
    truth = read_truth(options.truth) if options.truth else recorded_truth(options.bag)
    with BagReader(options.bag) as bag:
        topics = chosen_topics(bag, options.topics)
        counted = {*topics, *(x.name for x in bag.topics_of(BODY))}
        total = bag.message_count(counted) * (1 if truth is None else 2)
        first = next(bag.messages(topics[:1]), None)
    frame = '' if first is None else first.message.header.frame_id
    grounds = read_grounds(options.bag, topics[0], frame)
    if source is not None:
        with BagReader(source.bag) as bag:
            total += bag.message_count([source.topic])
    bar.total = total
    everything = read_mixtures(
        options.bag, topics=topics, body_model=options.body, grounds=grounds, progress=bar.update
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
    notes = [*options.notes]
    if everything.empty:
        told = f'nobody is found at {len(everything.empty)} of {len(everything.stamps)} times'
        why = Counter(everything.answered[stamp] for stamp in everything.empty).most_common(1)[0][0]
        notes.append(f'{told}: {why}' if why else told)
    if len(stamps) < len(everything.stamps):
        notes.append(f'{len(stamps)} of {len(everything.stamps)} times are shown')
    notes += [
        f'the trajectories on {topic.topic} are neither drawn nor scored: the bag does not name '
        'their body'
        for topic in everything.trajectories
        if not topic.joint_names
    ]
    notes += [
        f'{name} has no likelihood and no coverage: {topic.note}'
        for name, topic in scores.items()
        if topic.note
    ]
    images = FilmStrip()
    if source is not None:
        usual = int(IMAGE_BYTES * (1 + (stamps[-1] - stamps[0]) * 1e-9))
        left = min(PAGE_BYTES - REST_BYTES - data_size(mixtures), usual)
        keep = shown_in_pictures(mixtures.layers[0]) if mixtures.layers else set()
        # Base64 turns three bytes into four.
        images = film_strip(source, stamps, left * 3 // 4, keep=keep, progress=bar.update)
        if len(images.jpegs) < len(stamps):
            notes.append(f'{len(stamps) - len(images.jpegs)} times are shown without an image')
    detector = None
    if mixtures.layers:
        bags = [options.bag] if source is None else [options.bag, source.bag]
        read = (read_detector(bag, mixtures.layers[0]) for bag in dict.fromkeys(bags))
        detector = next(filter(None, read), None)
    title = f'{options.bag.resolve().name}: mixtures over poses'
    return Content(title, stamps, mixtures, images, truth, scores, notes, grounds, detector)


def _with_truth(mixtures: RecordedMixtures, truth: Truth) -> list[str]:
    """Topics that have ground truth, or else all topics, so that scoring raises the error."""
    stamps = {layer.topic: set(layer.mixtures) for layer in mixtures.layers}
    for layer in mixtures.trajectories:
        if layer.joint_names:  # without a body there are no joints
            windows = layer.mixtures.values()
            stamps[layer.topic] = {stamp for window in windows for stamp in window.stamps_ns}
    known = [name for name, own in stamps.items() if not own.isdisjoint(truth.joints)]
    layers = [layer.topic for layer in mixtures.layers]
    return known or [*layers, *(layer.topic for layer in mixtures.trajectories)]


def _shown(mixtures: RecordedMixtures, most: int) -> list[int]:
    """Stamps to show: all, or every n-th if there are too many for the page."""
    stamps = mixtures.stamps
    most = min(most, int(len(stamps) * min(DATA_BYTES / max(data_size(mixtures), 1), 1.0)))
    return stamps[:: -(-len(stamps) // max(most, 1))]
