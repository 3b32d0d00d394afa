#!/usr/bin/env python3
"""A bag is tracked: the mixture keeps two answers while images cannot decide, then one.

You learn to replay a bag, and to read the mixtures of filter and smoother from the result. Run
python examples/tutorials/two_answers.py, or name a bag, an arm and a time: two_answers.py BAG
--arm left --at SECONDS. The picture shows an arm that rises towards the camera, with both answers
from the side, half a second later, and what the smoother makes of the first image.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

import tutorial
from matplotlib.figure import Figure

from hmt_ros.app.command_line import run_command
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.report.mixtures import read_mixtures
from msg_tools import BagReader, BagWriter, typestore

AFTER, REST = 0.5, 1.0  # s, from the moment to the second picture, and from there to the end


def main(argv: list[str] | None = None) -> int:
    """Runs the tutorial; returns 1 for bad input."""
    parser = tutorial.parser_of(__file__, __doc__)
    parser.add_argument('bag', type=Path, nargs='?', default=tutorial.LIVING_ROOM)
    parser.add_argument('--at', type=float, default=1.4, help='time in the bag, s')
    parser.add_argument('--arm', choices=('left', 'right'), default='right')
    return run_command(parser, run, argv)


def run(options: Namespace) -> int:
    """The part of the bag, its mixtures, and the picture."""
    folder = tutorial.folder_of(options.output)
    part = copied(options.bag, folder / 'part', options.at + AFTER + REST)
    # Who it is and the empty scene, where they are known; keypoints are in the bag.
    subject, scene = (options.bag / name for name in ('subject.yaml', 'background.png'))
    settings = ReplayOptions(
        overwrite=True,
        quiet=True,
        subject=subject if subject.is_file() else None,
        background=scene if scene.is_file() else None,
    )
    print(replay_bag(part, folder / 'tracked', settings, print))

    camera, images = tutorial.read_images(part)
    layers = {layer.kind: layer for layer in read_mixtures(folder / 'tracked').layers}
    figure = Figure((10, 8.2), layout='constrained')
    grid = figure.subplots(2, 3, height_ratios=[1, 1.15])
    for (image, side), (kind, seconds, what) in zip(
        grid.T,
        (
            ('posterior', options.at, 'filter'),
            ('posterior', options.at + AFTER, 'filter'),
            ('smoothed', options.at, 'smoother'),
        ),
    ):
        layer = layers[kind]
        stamp = tutorial.nearest(images, seconds)
        if stamp not in layer.mixtures:
            raise ValueError(f'{options.bag}: nobody is tracked at {seconds:g} s')
        moment, names = layer.mixtures[stamp], layer.joint_names
        answers = tutorial.answers_of(moment.weights, moment.joints, names, options.arm)
        print(f'{seconds:.1f} s, {what}: ' + ', '.join(text for _, text, _, _ in answers))
        true = tutorial.true_joints(options.bag, names, stamp)
        tutorial.show_answers(image, images[stamp], camera, names, answers)
        tutorial.show_side(side, names, answers, true)
        image.set_title(f'{seconds:.1f} s, {what}')
    figure.suptitle(
        'The filter keeps two answers until images decide; the smoother corrects the past'
    )
    tutorial.save(figure, options.output)
    return 0


def copied(bag: Path, target: Path, seconds: float) -> Path:
    """Writes the first seconds of a bag into a new one, without messages of unknown types."""
    with BagReader(bag) as read, BagWriter(target, overwrite=True) as written:
        topics = [x for x in read.topics.values() if x.msgtype in typestore().fielddefs]
        for topic in topics:
            written.add_topic(topic.name, topic.msgtype, latched='static' in topic.name)
        start = None
        for stored in read.messages([topic.name for topic in topics]):
            start = start or stored.log_time_ns
            if stored.log_time_ns > start + 1e9 * seconds:
                break
            written.write_serialised(stored.topic, stored.log_time_ns, stored.data)
    return target


if __name__ == '__main__':
    sys.exit(main())
