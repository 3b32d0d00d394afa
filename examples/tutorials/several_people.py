#!/usr/bin/env python3
"""Two people walk past each other, and each keeps an identity.

You learn to make a bag of two people, to track everybody in it, and to read who is where. Run
python examples/tutorials/several_people.py, or name a bag with detections, as import-video
--people writes it. The picture shows images with a colour for each identity, and the ways of the
people from above.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tutorial
from matplotlib.figure import Figure

from hmt_learning.app.make_bag import main as make_bag
from hmt_ros.app.command_line import run_command
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.truth import read_truth
from hmt_ros.sessions.track import person_of
from msg_tools import BagReader
from msg_tools.messages.pose_mixtures import PoseMixture, pose_mixture_of

COLOURS = (tutorial.BLUE, tutorial.RED, '#009e73', '#cc79a7')
MADE = ('--seed', '1', '--duration', '3', '--fps', '10', '--size', '480x360', '--overwrite')


def main(argv: list[str] | None = None) -> int:
    """Runs the tutorial; returns 1 for bad input."""
    parser = tutorial.parser_of(__file__, __doc__)
    parser.add_argument('bag', type=Path, nargs='?', help='default: made here')
    return run_command(parser, run, argv)


def run(options: Namespace) -> int:
    """The bag, its people, and the picture."""
    folder = tutorial.folder_of(options.output)
    bag = options.bag or made_bag(folder / 'crossing')
    scene = bag / 'background.png'
    background = scene if scene.is_file() else None
    settings = ReplayOptions(overwrite=True, quiet=True, people=True, background=background)
    print(replay_bag(bag, folder / 'tracked', settings, print))

    camera, images = tutorial.read_images(bag)
    # True ways by stamp, of a bag that has them.
    truths = [read_truth(x) for x in sorted(bag.glob('truth_*.npz'))]
    true = [{t: of_pelvis(x.joint_names, j) for t, j in x.joints.items()} for x in truths]
    stamps = sorted(images)
    # Before, while, and after they meet.
    frames = {stamps[round(share * (len(stamps) - 1))]: [] for share in (0.2, 0.5, 0.85)}
    figure = Figure((10, 6.6), layout='constrained')
    above, below = figure.subfigures(2, 1, height_ratios=[1, 1.5])
    axes = below.subplots()
    for (person, track), colour in zip(tracks(folder / 'tracked').items(), COLOURS):
        names = next(iter(track.values())).joint_names
        poses = {stamp: x.joint_positions[np.argmax(x.weights)] for stamp, x in track.items()}
        for stamp in frames.keys() & poses.keys():
            frames[stamp].append((poses[stamp], colour))
        way = np.array([of_pelvis(names, pose) for pose in poses.values()])
        axes.plot(*way.T, color=colour, linewidth=3, label=f'{person}, from its dot on')
        axes.plot(*way[0], 'o', color=colour, markersize=10)
        print(
            f'{person}: in {len(way)} of {len(images)} images, from {way[0][0]:+.1f} m to '
            f'{way[-1][0]:+.1f} m across, {way[:, 1].mean():.1f} m away'
        )
        if true:
            away = np.linalg.norm(way[:, None] - [[x[t] for x in true] for t in poses], axis=2)
            owners = np.bincount(away.argmin(1))
            print(
                f'{person}: it is person {owners.argmax() + 1} in {owners.max()} images, '
                f'{np.median(away.min(1)):.2f} m from the truth'
            )
    for i, each in enumerate(true):
        label = '_' if i else 'the truth'
        axes.plot(*np.transpose([*each.values()]), 'k:', label=label)
    axes.set(xlabel='to the right of the camera, m', ylabel='away from the camera, m')
    axes.set(aspect='equal', title='From above: people who are taller than assumed seem nearer')
    axes.legend(loc='center left', bbox_to_anchor=(1.0, 0.5))
    shown = [(f'{1e-9 * (t - stamps[0]):.1f} s', images[t], x) for t, x in frames.items()]
    tutorial.show_strip(above, camera, names, shown)
    figure.suptitle('Two people walk past each other, and each keeps an identity')
    tutorial.save(figure, options.output)
    return 0


def made_bag(bag: Path) -> Path:
    """Renders two people who walk past each other, with what a detector sees of them."""
    if code := make_bag(['crossing', '-o', str(bag), *MADE, '--quiet']):
        raise SystemExit(code)
    return bag


def of_pelvis(names: Sequence[str], joints: Any) -> Any:
    """Place (2,) of a pose (J, 3): to the right of the camera, and away from it, m."""
    return joints[names.index('pelvis'), [0, 2]]


def tracks(bag: Path) -> dict[str, dict[int, PoseMixture]]:
    """The mixtures of each person by identity and stamp."""
    found: dict[str, dict[int, PoseMixture]] = {}
    with BagReader(bag) as read:
        topics = [x for x in read.topics if x.endswith('/pose_mixture')]
        for stored in read.messages(topics):
            content = pose_mixture_of(stored.message)
            if len(content.weights):
                person = person_of(stored.topic.removeprefix('/'))
                found.setdefault(person, {})[content.stamp_ns] = content
    return found


if __name__ == '__main__':
    sys.exit(main())
