"""The demonstration of `make demo`: tracks the person in a bag, prints the errors, writes a report.

    python tools/demonstration/demo.py bags/reach -o build/demo --live

Errors are those of the arm and leg joints that the detector has, relative to the middle of the
hips, over the images in which both have an answer. Other lines show the coverage of 90 % regions,
the number of images in which a present person is reported absent, and the mean error over the
clips of other people, from `benchmarks/results`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import notify_user
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.report.command import PAGE, ReportOptions, write_report
from hmt_ros.app.report.mixtures import Layer
from hmt_ros.app.report.page import Content
from hmt_ros.app.truth import recorded_truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, HIPS, relative_positions
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.image_inputs import KEYPOINTS
from msg_tools import BagReader

# Joints of the arms and legs, which all detectors have.
JOINTS = tuple(name for name in EVALUATED_JOINTS if name != 'neck')
REPORT = 'report'
RESULTS = Path(__file__).resolve().parents[2] / 'benchmarks' / 'results' / 'tracking.md'
# Titles of the lines.
DETECTORS, OURS, SMOOTHED = (
    "error of the detector's own 3D",
    'error of the most probable pose',
    'error of the most probable pose, smoothed',
)
REGIONS = 'true joints inside the region that holds them with 90 %'
NOBODY, RATE = 'nobody said to be there, wrongly', 'poses a second'
CLIPS = 'error on the clips of other people, in the mean'


def main(argv: list[str] | None = None) -> int:
    """Runs the demonstration; returns 0, or 1 after bad input, which one line explains."""
    return run_command(_parser(), _demonstrate, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'demo',
        'Tracks the person in a bag, says how well if the truth is known, and writes a report.',
    )
    parser.add_argument(
        'bag',
        type=Path,
        help='folder of a bag, with subject.yaml, background.png and truth.npz in it if known',
    )
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        required=True,
        metavar='DIR',
        help='folder for the new bag and the report',
    )
    parser.add_argument('--live', action='store_true', help='run the real nodes, over DDS')
    return parser


@dataclass(frozen=True)
class _Poses:
    """Joint names, and joint positions (K, J, 3) by timestamp, heaviest mode first."""

    names: tuple[str, ...]
    joints: dict[int, Array]

    @staticmethod
    def of(layer: Layer) -> _Poses:
        """The poses of the mixtures on a topic."""
        return _Poses(layer.joint_names, {t: x.joints for t, x in layer.mixtures.items()})

    def errors(self, truth: Truth, stamps: Iterable[int]) -> Array:
        """Mean joint errors (T,) of the heaviest pose at some timestamps, mm."""
        joints = [x for x in JOINTS if x in self.names and x in truth.joint_names]
        result = []
        for stamp in stamps:
            own = relative_positions(self.joints[stamp][:1], self.names, joints, HIPS)
            true = relative_positions(truth.joints[stamp], truth.joint_names, joints, HIPS)
            result.append(1e3 * np.linalg.norm(own[0] - true, axis=-1).mean())
        return np.array(result)


def _demonstrate(arguments: argparse.Namespace) -> int:
    source, folder = arguments.bag, arguments.output
    target, page = folder / source.resolve().name, folder / REPORT

    def beside(name: str) -> Path | None:
        return source / name if (source / name).is_file() else None

    options = ReplayOptions(
        overwrite=True, subject=beside('subject.yaml'), background=beside('background.png')
    )
    with BagReader(source) as bag:
        detected = recorded_input(bag).of(KEYPOINTS) is not None
    inputs = 'images and keypoints' if detected else 'images'
    how = f'{inputs}, in the real nodes' if arguments.live else inputs
    rate = _track(source, target, replace(options, live=arguments.live), how)
    truth = beside('truth.npz') if recorded_truth(target) is None else None
    shown, written = write_report(
        ReportOptions(target, page, overwrite=True, images=source, truth=truth)
    )
    if shown.truth is not None:
        scenes = _scenes(source / 'truth.npz')
        print('\n'.join(('', *_told(shown, shown.truth, rate, scenes), *_told_of_clips())))
    print(f'\nresults\n{target}: bag with {", ".join(_topics(target))}\n{written}')
    print(f'\nopen in a browser: {page / PAGE}')
    return 0


def _scenes(truth: Path) -> dict[str, int]:
    """End timestamps of the scenes by name; one scene if the truth has none."""
    if truth.is_file():
        with np.load(truth) as content:
            if {'scenes', 'until'} <= {*content}:
                return dict(zip(content['scenes'].tolist(), content['until'].tolist()))
    return {'all images': np.iinfo(np.int64).max}


def _told(shown: Content, truth: Truth, rate: float, scenes: dict[str, int]) -> Iterator[str]:
    """Lines on errors of poses, their calibration, and the rate."""
    found = {layer.kind: _Poses.of(layer) for layer in shown.mixtures.layers if layer.joint_names}
    poses = {OURS: found['posterior']}
    if shown.detector is not None:
        joints = {stamp: one[None] for stamp, one in shown.detector.joints.items()}
        poses = {DETECTORS: _Poses(shown.detector.joint_names, joints), **poses}
    if 'smoothed' in found:
        poses[SMOOTHED] = found['smoothed']
    # All are compared in the images in which each has an answer.
    common = sorted(truth.joints.keys() & set.intersection(*({*x.joints} for x in poses.values())))
    parts = np.split(np.array(common), np.searchsorted(common, [*scenes.values()])[:-1])
    yield _row('', *scenes)
    for what, each in poses.items():
        errors = (each.errors(truth, part.tolist()) for part in parts)
        yield _row(what, *(f'{x.mean():.0f} mm' if len(x) else '-' for x in errors))
    scores = next(iter(shown.scores.values())).scores.summary()
    yield _row(REGIONS, f'{100 * scores["joint_coverage_90"]:.0f} %')
    wrong = [t for t in shown.mixtures.empty if t in truth.joints]
    images = len({*truth.joints} & {*shown.stamps})
    yield _row(NOBODY, f'{len(wrong)} of {images} images')
    yield _row(RATE, f'{rate:.0f}')


def _told_of_clips() -> Iterator[str]:
    """Line on the mean over the clips of other people, if available."""
    if RESULTS.is_file():
        text = RESULTS.read_text('utf-8').partition('Other clips: errors')[2]
        rows = [[x.strip() for x in line.split('|')[1:-1]] for line in text.splitlines()]
        # The first table of several.
        means = {row[1]: row for row in reversed(rows) if row[:1] == ['mean']}
        head = next((row for row in rows if row[:1] == ['clip']), [])
        ours, theirs = means.get('images + keypoints'), means.get('MediaPipe 3D')
        if ours and theirs and {'heaviest', 'point'} <= {*head}:
            mine, other = ours[head.index('heaviest')], theirs[head.index('point')]
            yield _row(CLIPS, f"{mine} mm; detector's 3D {other}")


def _row(what: str, *values: str) -> str:
    return f'  {what:56s}{"".join(f"{value:8s}" for value in values)}'.rstrip()


def _track(source: Path, target: Path, options: ReplayOptions, inputs: str) -> float:
    """Tracks the person; returns poses per second."""
    print(f'tracking the person in {source} by {inputs}', flush=True)
    start = time.monotonic()
    replayed = replay_bag(source, target, options, partial(notify_user, 'replay'))
    spent = time.monotonic() - start
    print(f'{replayed} in {spent:.1f} s', flush=True)
    with BagReader(target) as bag:
        return bag.topic('pose_mixture').message_count / spent


def _topics(bag: Path) -> list[str]:
    with BagReader(bag) as reader:
        return [topic.name for topic in reader.topics.values() if topic.message_count]


if __name__ == '__main__':
    sys.exit(main())
