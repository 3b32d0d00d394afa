"""The demonstration of `make demo`: tracks the person in a bag, prints the errors, writes a report.

    python tools/demonstration/demo.py bags/reach -o build/demo --live

The person is tracked twice if the bag has keypoints of a detector: by the images alone, and by the
images and the keypoints. Errors are those of the joints of the arms and legs that the detector has,
with the middle of the hips in its true place.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import tell_user
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.report.command import PAGE, ReportOptions, write_report
from hmt_ros.app.report.mixtures import Layer, read_mixtures
from hmt_ros.app.truth import recorded_truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, HIPS, relative_positions
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.image_inputs import KEYPOINTS
from msg_tools import BagReader

# Joints of the arms and legs, which all detectors have.
JOINTS = tuple(name for name in EVALUATED_JOINTS if name != 'neck')
REPORT, ALONE = 'report', 'images_alone'


def main(argv: list[str] | None = None) -> int:
    """Runs the demonstration; 0: done, 1: bad input, which one line on stderr explains."""
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
    """Poses (K, J, 3) by stamp, the heaviest first, of joints with names."""

    names: tuple[str, ...]
    joints: dict[int, Array]

    @staticmethod
    def of(layer: Layer) -> _Poses:
        """The poses of the mixtures on a topic."""
        return _Poses(layer.joint_names, {t: x.joints for t, x in layer.mixtures.items()})

    def errors(self, truth: Truth) -> Array:
        """Mean errors (T, 2) of the heaviest pose and of the best, mm."""
        joints = [x for x in JOINTS if x in self.names and x in truth.joint_names]
        result = []
        for stamp in sorted(self.joints.keys() & truth.joints.keys()):
            own = relative_positions(self.joints[stamp], self.names, joints, HIPS)
            true = relative_positions(truth.joints[stamp], truth.joint_names, joints, HIPS)
            each = 1e3 * np.linalg.norm(own - true, axis=-1).mean(-1)
            result.append((each[0], each.min()))
        return np.array(result).reshape(-1, 2)


def _demonstrate(arguments: argparse.Namespace) -> int:
    source, folder = arguments.bag, arguments.output
    target, page = folder / source.resolve().name, folder / REPORT

    def beside(name: str) -> Path | None:
        return source / name if (source / name).is_file() else None

    options = ReplayOptions(
        overwrite=True, subject=beside('subject.yaml'), background=beside('background.png')
    )
    with BagReader(source) as bag:
        recorded = recorded_input(bag)
    poses, inputs = {}, 'images'
    if recorded.of(KEYPOINTS) is not None:
        alone = replace(options, with_smoother=False, settings=('use_keypoints=false',))
        _track(source, folder / ALONE, alone, 'images alone')
        layer, *_ = read_mixtures(folder / ALONE, topics=('pose_mixture',)).layers
        poses['images alone'] = _Poses.of(layer)
        inputs = 'images and keypoints'
    how = f'{inputs}, in the real nodes' if arguments.live else inputs
    _track(source, target, replace(options, live=arguments.live), how)
    truth = beside('truth.npz') if recorded_truth(target) is None else None
    shown, written = write_report(
        ReportOptions(target, page, overwrite=True, images=source, truth=truth)
    )
    found = {layer.kind: _Poses.of(layer) for layer in shown.mixtures.layers if layer.joint_names}
    if shown.detector is not None:
        joints = {stamp: one[None] for stamp, one in shown.detector.joints.items()}
        poses = {"the detector's own 3D": _Poses(shown.detector.joint_names, joints), **poses}
    poses[inputs] = found['posterior']
    if 'smoothed' in found:
        poses[f'{inputs}, smoothed'] = found['smoothed']
    if shown.truth is not None:
        print('\nmean error of the joints of arms and legs, mm')
        for what, each in poses.items():
            print(f'  {what:40s}{each.errors(shown.truth)[:, 0].mean():4.0f}')
        nearest = poses[inputs].errors(shown.truth)[:, 1].mean()
        print(f'  {"the nearest of the poses of each image":40s}{nearest:4.0f}')
    print(f'\nresults\n{target}: bag with {", ".join(_topics(target))}\n{written}')
    print(f'\nopen in a browser: {page / PAGE}')
    return 0


def _track(source: Path, target: Path, options: ReplayOptions, inputs: str) -> None:
    print(f'tracking the person in {source} by {inputs}', flush=True)
    start = time.monotonic()
    replayed = replay_bag(source, target, options, partial(tell_user, 'replay'))
    print(f'{replayed} in {time.monotonic() - start:.1f} s', flush=True)


def _topics(bag: Path) -> list[str]:
    with BagReader(bag) as reader:
        return [topic.name for topic in reader.topics.values() if topic.message_count]


if __name__ == '__main__':
    sys.exit(main())
