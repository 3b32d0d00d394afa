#!/usr/bin/env python3
"""A video file becomes the motion of a person, with a band that says how sure it is.

You learn to call track-video from a program, and to read the mixtures that it writes. Run
python examples/tutorials/video.py, or with a video of your own and an installed detector:
video.py walk.mp4 --fov 60. The picture shows images with the pose drawn in, and below how far the
right wrist is in front of the pelvis, with the band that should hold it 90 % of the time.
"""

from __future__ import annotations

import math
import sys
from argparse import REMAINDER, Namespace
from pathlib import Path

import cv2
import numpy as np
import tutorial
from matplotlib.figure import Figure

from hmt_ros.app import track_video
from hmt_ros.app.command_line import run_command
from hmt_ros.app.report.mixtures import intervals
from hmt_ros.app.truth import read_truth
from msg_tools import BagReader
from msg_tools.messages.pose_mixtures import pose_mixture_of

SECONDS, RATE, FRAMES = 4.0, 10.0, 5
STATURE = 1.72  # m, of the person in bags/living_room


def main(argv: list[str] | None = None) -> int:
    """Runs the tutorial; returns 1 for bad input."""
    parser = tutorial.parser_of(__file__, __doc__)
    parser.add_argument('video', nargs=REMAINDER, help='video, and options of track-video')
    return run_command(parser, run, argv)


def run(options: Namespace) -> int:
    """The video, its mixtures, and the picture."""
    folder = tutorial.folder_of(options.output)
    words = options.video or made_video(folder)
    if code := track_video.main([*words, '-o', str(folder), '--overwrite', '--quiet']):
        return code

    with BagReader(folder / 'tracked') as bag:
        found = [pose_mixture_of(x.message) for x in bag.messages(['smoothed_pose_mixture'])]
    found = [one for one in found if len(one.weights)]
    if not found:
        raise ValueError(f'{words[0]}: nobody is tracked')
    names = found[0].joint_names
    pelvis, wrist = names.index('pelvis'), names.index('right_wrist')
    # Quantiles of the mixture: each component is a Gaussian along the line of sight.
    bands = []
    for one in found:
        ahead = one.joint_positions[:, pelvis, 2] - one.joint_positions[:, wrist, 2]
        sigmas = np.sqrt(one.joint_covariances_relative[:, wrist, 2, 2])
        bands.append(intervals(one.weights, np.stack([ahead, sigmas])[..., None])[0])
    low, middle, high = np.array(bands).T
    camera, images = tutorial.read_images(folder / 'video')
    times = np.array([one.stamp_ns - min(images) for one in found]) * 1e-9
    print(f'{len(found)} of {len(images)} images have a pose')
    print(f'the wrist is {middle.min():.2f} to {middle.max():.2f} m in front of the pelvis')
    print(f'the 90 % band is {np.median(high - low):.2f} m wide (median)')

    figure = Figure((10, 6.5), layout='constrained')
    above, below = figure.subfigures(2, 1, height_ratios=[1.25, 1])
    axes, frames = below.subplots(), []
    for i in np.linspace(0, len(found) - 1, FRAMES).round().astype(int):
        heaviest = found[i].joint_positions[np.argmax(found[i].weights)]
        frames.append((f'{times[i]:.1f} s', images[found[i].stamp_ns], [(heaviest, tutorial.RED)]))
        axes.axvline(times[i], color=tutorial.GREY, linewidth=1, zorder=0)
    tutorial.show_strip(above, camera, names, frames)
    axes.fill_between(times, low, high, color=tutorial.BLUE, alpha=0.25, label='90 % band')
    axes.plot(times, middle, color=tutorial.BLUE, linewidth=2, label='median')
    if not options.video:
        truth = read_truth(tutorial.LIVING_ROOM / 'truth.npz')
        rows = [truth.joint_names.index(name) for name in ('pelvis', 'right_wrist')]
        true = np.array([truth.joints[one.stamp_ns][rows, 2] for one in found]) @ [1.0, -1.0]
        axes.plot(times, true, color='black', linestyle=':', linewidth=2, label='the truth')
        inside = np.mean((low <= true) & (true <= high))
        print(f'{100 * inside:.0f} % of the true places are in the band')
    axes.set(xlabel='time, s (lines: the images)', ylabel='right wrist in front\nof the pelvis, m')
    axes.legend(loc='upper left')
    figure.suptitle('A video becomes a motion, and each depth comes with its uncertainty')
    tutorial.save(figure, options.output)
    print(f'page: {folder / "report" / "report.html"}')
    return 0


def made_video(folder: Path) -> list[str]:
    """Writes a video, and what a detector found in it; returns arguments of track-video."""
    folder.mkdir(parents=True, exist_ok=True)
    camera, images = tutorial.read_images(tutorial.LIVING_ROOM)
    keypoints = tutorial.read_keypoints(tutorial.LIVING_ROOM)
    stamps = [stamp for stamp in images if stamp < min(images) + 1e9 * SECONDS]
    video, found = folder / 'walk.mp4', folder / 'walk.npz'
    size = (camera.width, camera.height)
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*'mp4v'), RATE, size)
    for stamp in stamps:
        writer.write(images[stamp])
    writer.release()
    seen = [keypoints[stamp] for stamp in stamps]
    np.savez(
        found,
        pixels=[one.pixels for one in seen],
        visibility=[one.confidences for one in seen],
        landmark_names=seen[0].names,
    )
    fov = math.degrees(2.0 * math.atan(0.5 * camera.width / camera.fx))
    known = ['--fov', f'{fov:.1f}', '--stature', str(STATURE)]
    return [str(video), '--keypoints', str(found), *known]


if __name__ == '__main__':
    sys.exit(main())
