#!/usr/bin/env python3
"""One image of an arm that rises towards the camera has two answers: in front, or behind.

You learn to load a body and a camera, to start a track from keypoints, and to read the mixture
over poses that one image gives. Run python examples/tutorials/one_image.py, or name a bag with
keypoints and a time: one_image.py BAG --at SECONDS. The picture shows both answers on the image,
where they look the same, and from the side, where they do not.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

import cv2
import numpy as np
import tutorial
from matplotlib.figure import Figure

from hmt_ros.app.command_line import run_command
from hmt_ros.body import load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import Subject, Tracker, TrackerSettings


def main(argv: list[str] | None = None) -> int:
    """Runs the tutorial; returns 1 for bad input."""
    parser = tutorial.parser_of(__file__, __doc__)
    parser.add_argument('bag', type=Path, nargs='?', default=tutorial.LIVING_ROOM)
    parser.add_argument('--at', type=float, default=1.5, help='time of the image in the bag, s')
    return run_command(parser, run, argv)


def run(options: Namespace) -> int:
    """One image, its mixture, and the picture."""
    camera, images = tutorial.read_images(options.bag)
    keypoints = tutorial.read_keypoints(options.bag)
    stamp = tutorial.nearest(keypoints, options.at)
    body = load_body('human37')
    # The detector names landmarks; the tracker takes joints of the body.
    seen, _ = keypoints[stamp].named_for(body)

    # The empty scene gives the silhouette. Without it, keypoints alone count.
    scene = cv2.imread(str(options.bag / 'background.png'))
    background = None if scene is None else BackgroundModel.from_image(scene)
    tracker = Tracker(body, camera, TrackerSettings(max_hypotheses=8), background, seed=0)
    tracker.reset(Subject(stamp, seen, {}))
    posterior, _ = tracker.step(images[stamp], stamp, keypoints=seen)
    if posterior is None:
        raise ValueError(f'{options.bag}: nobody is found at {options.at:g} s')

    body = tracker.estimate.body  # with the lengths of this person
    names, joints = body.joint_names, body.joint_positions(posterior.means)
    shoulder, wrist = names.index('right_shoulder'), names.index('right_wrist')
    for weight, depth in zip(posterior.weights, joints[:, wrist, 2] - joints[:, shoulder, 2]):
        print(
            f'mode of {100 * weight:2.0f} %: the right wrist is {depth:+.2f} m beyond the shoulder'
        )

    # Modes that agree on the side are one answer, drawn as the heaviest of them.
    answers = tutorial.answers_of(posterior.weights, joints, names)
    true = tutorial.true_joints(options.bag, names, stamp)
    for _, text, pose, _ in answers:
        if true is not None:
            text += f', its wrist {tutorial.error(pose, true, names):.2f} m from the truth'
        print(text)
    apart = np.ptp([pose[wrist, 2] for _, _, pose, _ in answers])
    print(f'the wrists of the answers are {apart:.2f} m apart in depth')

    figure = Figure((10, 5.8), layout='constrained')
    image, side = figure.subplots(1, 2, width_ratios=[1, 1.5])
    tutorial.show_answers(image, images[stamp], camera, names, answers)
    tutorial.show_side(side, names, answers, true)
    image.set_title('On the image both answers fit')
    side.set_title(f'From the side their wrists are {apart:.2f} m apart')
    figure.suptitle('One image cannot tell whether an arm is in front of the body or behind it')
    tutorial.save(figure, options.output)
    return 0


if __name__ == '__main__':
    sys.exit(main())
