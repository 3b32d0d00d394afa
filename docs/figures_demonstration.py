"""Draws the picture and the animation of README, from the bag that `make demo` writes.

    python docs/figures_demonstration.py

The picture shows a moment when the hand, raised towards the camera, may also be behind the body.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from body_pictures import add_skeleton
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from hmt_ros.app.report.mixtures import Layer, Moment, read_mixtures
from hmt_ros.app.report.skeletons import STYLE, bones_of, save_picture
from hmt_ros.app.truth import read_truth
from hmt_ros.inference.arrays import Array
from msg_tools import BagReader
from msg_tools.messages.headers import START_NS, time_ns
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).resolve().parents[1]
BAG, TRACKED = ROOT / 'bags' / 'living_room', ROOT / 'build' / 'demo' / 'living_room'
MOMENT, AFTER = 1.4, 1.9  # times of the two images, s
WRIST, BODY = 'right_wrist', 'neck'
FIRST, LAST = 0.8, 6.0  # start and end of the animation, s
SIDE = 260  # width of the side view in the animation, px
GREY = '#cccccc'


def main() -> int:
    """Draws the picture and the animation."""
    if not TRACKED.is_dir():
        sys.stderr.write(f'{TRACKED} is not there: run "make demo" first\n')
        return 1
    layers = {x.kind: x for x in read_mixtures(TRACKED).layers if x.joint_names}
    images, truth = read_images(), read_truth(BAG / 'truth.npz')
    with plt.rc_context({**STYLE, 'font.size': 11.0, 'axes.titlesize': 11.0}):
        draw_picture(layers, images, truth)
    draw_animation(layers, images)
    return 0


def read_images() -> dict[int, Array]:
    """The images (H, W, 3), BGR, by timestamp."""
    with BagReader(BAG) as bag:
        return {
            time_ns(x.message.header.stamp): decode_image(x.message)
            for x in bag.messages(['image/compressed'])
        }


def nearest(stamps: Any, seconds: float) -> int:
    """The timestamp nearest to a time after the start."""
    return min(stamps, key=lambda stamp: abs(stamp - START_NS - seconds * 1e9))


def draw_picture(layers: dict[Any, Layer[Moment]], images: dict[int, Array], truth: Any) -> None:
    """Draws `docs/overview.png`."""
    figure, axes = plt.subplots(
        1,
        5,
        figsize=(12.6, 3.9),
        width_ratios=[1.0, 0.85, 0.85, 1.0, 0.85],
        layout='constrained',
        dpi=110,
    )
    posterior, smoothed = layers['posterior'], layers['smoothed']
    stamp, later = (nearest(posterior.mixtures, x) for x in (MOMENT, AFTER))
    moment = posterior.mixtures[stamp]
    names = posterior.joint_names
    ahead = moment.joints[:, names.index(WRIST), 2] < moment.joints[:, names.index(BODY), 2]
    show_image(axes[0], images[stamp], 'one image')
    for ax, chosen, what in ((axes[1], ahead, 'in front'), (axes[2], ~ahead, 'behind')):
        weight = float(moment.weights[chosen].sum())
        ax.set_title(f'{100 * weight:.0f} %: {what}')
        show_side(ax, names, moment.joints[np.flatnonzero(chosen)[0]], truth, stamp)
    show_image(axes[3], images[later], f'{AFTER - MOMENT:.1f} s later')
    after = smoothed.mixtures[later]
    share = after.joints[:, names.index(WRIST), 2] < after.joints[:, names.index(BODY), 2]
    axes[4].set_title(f'{100 * float(after.weights[share].sum()):.0f} %: in front')
    show_side(axes[4], smoothed.joint_names, after.joints[0], truth, later)
    save_picture(figure, ROOT / 'docs' / 'overview.png')
    plt.close(figure)


def show_image(axes: Axes, image: Array, title: str) -> None:
    """Shows the part of an image with the person."""
    axes.imshow(image[40:340, 235:395, ::-1])
    axes.set_title(title)
    axes.set_axis_off()


def show_side(axes: Axes, names: tuple[str, ...], joints: Array, truth: Any, stamp: int) -> None:
    """Draws a pose over the true one (wide, grey), aligned at the pelvis; camera on the right."""
    true = truth.joints[stamp]
    for own, which, colour, width in (
        (truth.joint_names, true, GREY, 7.0),
        (names, joints, None, 3.0),
    ):
        flat = (which[own.index('pelvis')] - which)[:, [2, 1]]
        add_skeleton(axes, flat, own, colour, width)
    axes.set_xlim(-0.55, 0.75)
    axes.set_ylim(-1.1, 0.95)
    axes.set_aspect('equal')
    axes.set_axis_off()


def draw_animation(layers: dict[Any, Layer[Moment]], images: dict[int, Array]) -> None:
    """Draws `docs/overview.webp`: images, and all modes from the side, likelier ones darker."""
    layer, frames = layers['posterior'], []
    for stamp in sorted(images):
        if not FIRST <= (stamp - START_NS) * 1e-9 <= LAST or stamp not in layer.mixtures:
            continue
        image = np.ascontiguousarray(images[stamp])
        side = np.full((len(image), SIDE, 3), 255, dtype=np.uint8)
        moment = layer.mixtures[stamp]
        middle = moment.joints[0, layer.joint_names.index('pelvis')]
        for weight, joints in sorted(zip(moment.weights, moment.joints), key=lambda x: float(x[0])):
            flat = (joints - middle)[:, [2, 1]] * [-165.0, 165.0] + [0.42 * SIDE, 0.52 * len(image)]
            for a, b, usual in bones_of(layer.joint_names):
                bgr = np.array(to_rgb(usual)[::-1])
                colour = 255 * (1 - (1 - bgr) * min(0.15 + 1.7 * float(weight), 1.0))
                ends = [tuple(int(x) for x in np.rint(flat[i] * 16)) for i in (a, b)]
                cv2.line(side, ends[0], ends[1], colour.tolist(), 4, cv2.LINE_AA, 4)
        frames.append(np.hstack([image, side]))
    animation = cv2.Animation()
    animation.frames, animation.durations = frames, [100] * len(frames)
    target = str(ROOT / 'docs' / 'overview.webp')
    cv2.imwriteanimation(target, animation, [cv2.IMWRITE_WEBP_QUALITY, 75])


if __name__ == '__main__':
    sys.exit(main())
