"""What the tutorials share: their options, the images of a bag, and how a pose is drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from hmt_ros.app.command_line import CommandParser
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.app.report.skeletons import bones_of
from hmt_ros.app.truth import read_truth
from hmt_ros.sessions.image_inputs import KEYPOINTS
from msg_tools import BagReader
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image
from msg_tools.messages.keypoints import keypoints_of

ROOT = Path(__file__).resolve().parents[2]
LIVING_ROOM = ROOT / 'bags' / 'living_room'
# Two answers in colours that colour-blind people can distinguish; the truth is wide and grey.
BLUE, RED, GREY = '#0072b2', '#d55e00', '#c8c8c8'
MIN_WEIGHT = 0.01  # minimum weight of an answer that is shown
mpl.rcParams.update({'font.size': 11.0, 'axes.titlesize': 12.0, 'legend.frameon': False})


def parser_of(script: str, text: str | None) -> CommandParser:
    """The options of a script, with its docstring as help; --output is the picture."""
    name = Path(script).stem
    parser = CommandParser(name, text or '')
    picture = ROOT / 'build' / 'tutorials' / f'{name}.png'
    parser.add_argument('-o', '--output', type=Path, default=picture, help='the picture (PNG)')
    return parser


def folder_of(picture: Path) -> Path:
    """A folder beside the picture, for what else a script writes."""
    return picture.with_name(f'{picture.stem}_files')


def read_images(path: Path) -> tuple[Any, dict[int, Any]]:
    """The camera of a bag, and its images (H, W, 3), BGR, by stamp in ns."""
    with BagReader(path) as bag:
        found = recorded_input(bag)
        info = next(bag.messages([found.camera_info.name])).message
        stored = bag.messages([found.image.name])
        images = {time_ns(x.message.header.stamp): decode_image(x.message) for x in stored}
    return camera_from_info(info), images


def read_keypoints(path: Path) -> dict[int, Any]:
    """What a detector found in the images of a bag, by stamp in ns."""
    with BagReader(path) as bag:
        topic = recorded_input(bag).of(KEYPOINTS)
        if topic is None:
            raise ValueError(f'{path} has no keypoints, on a topic of hmt_msgs/Keypoints2D')
        stored = bag.messages([topic.name])
        return {time_ns(x.message.header.stamp): keypoints_of(x.message) for x in stored}


def true_joints(bag: Path, names: Sequence[str], stamp: int) -> Any:
    """True positions (J, 3) of joints, m; None: the bag does not say."""
    file = bag / 'truth.npz'
    if not file.is_file():
        return None
    truth = read_truth(file)
    joints = truth.joints.get(stamp)
    return None if joints is None else joints[[truth.joint_names.index(name) for name in names]]


def nearest(stamps: Iterable[int], seconds: float) -> int:
    """The stamp nearest to a time after the first."""
    known = sorted(stamps)
    if not known:
        raise ValueError('the bag has no image with keypoints')
    return min(known, key=lambda stamp: abs(stamp - known[0] - 1e9 * seconds))


def error(joints: Any, true: Any, names: Sequence[str], joint: str = 'right_wrist') -> float:
    """Distance of a joint from the truth, m, both seen from the pelvis."""
    own, pelvis = names.index(joint), names.index('pelvis')
    off = (joints[own] - joints[pelvis]) - (true[own] - true[pelvis])
    return float(np.linalg.norm(off))


def answers_of(weights: Any, joints: Any, names: Sequence[str], arm: str = 'right') -> Any:
    """The modes (K,) with joints (K, J, 3), heaviest first, by where a wrist is.

    Returns:
        Of each answer its weight, a text, the joints (J, 3) of its heaviest mode, and its colour.
    """
    shoulder, wrist = names.index(f'{arm}_shoulder'), names.index(f'{arm}_wrist')
    behind = joints[:, wrist, 2] > joints[:, shoulder, 2]
    answers = []
    for what, which, colour in (('in front', ~behind, BLUE), ('behind', behind, RED)):
        share = float(weights[which].sum())
        if share >= MIN_WEIGHT:
            answers.append(
                (share, f'{100 * share:.0f} %: the arm is {what}', joints[which][0], colour)
            )
    return answers


def from_side(joints: Any, names: Sequence[str]) -> Any:
    """Joints (..., J, 2) from the pelvis: towards the camera, and up, m."""
    pelvis = joints[..., names.index('pelvis'), :][..., None, :]
    return (pelvis - joints)[..., [2, 1]]


def add_skeleton(
    axes: Any, points: Any, names: Sequence[str], colour: str, width: float = 3.0, **style: Any
) -> None:
    """Draws the bones between points (J, 2)."""
    lines = [points[[a, b]] for a, b, _ in bones_of(tuple(names))]
    lines = [line for line in lines if np.isfinite(line).all()]
    drawn = LineCollection(lines, colors=colour, linewidths=width, capstyle='round', **style)
    axes.add_collection(drawn)


def show_side(axes: Any, names: Sequence[str], answers: Any, true: Any = None) -> None:
    """Draws poses from the side, the camera to the right.

    Args:
        answers: see `answers_of`.
        true: joints (J, 3); None: unknown.
    """
    if true is not None:
        add_skeleton(axes, from_side(true, names), names, GREY, 9.0, label='the truth')
    for share, text, joints, colour in answers:
        alpha = min(0.4 + share, 1.0)
        add_skeleton(axes, from_side(joints, names), names, colour, label=text, alpha=alpha)
    axes.set(xlim=(-0.7, 0.9), ylim=(-1.15, 1.15), aspect='equal')
    axes.set(xlabel='towards the camera, m', ylabel='above the pelvis, m')
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(0.5))
    axes.legend(loc='upper left', handlelength=1.2, borderaxespad=0.2)


def show_image(axes: Any, image: Any, pixels: Any, title: str = '') -> None:
    """The part of an image, BGR, around the points (..., 2)."""
    low, high = (f(pixels.reshape(-1, 2), 0) for f in (np.nanmin, np.nanmax))
    more = 0.12 * (high[1] - low[1])
    axes.imshow(image[..., ::-1])
    axes.set(xlim=(low[0] - more, high[0] + more), ylim=(high[1] + more, low[1] - more))
    axes.set_title(title)
    axes.set_axis_off()


def show_answers(axes: Any, image: Any, camera: Any, names: Sequence[str], answers: Any) -> None:
    """Draws the answers on their image, the second one below, and wider."""
    every = np.array([joints for _, _, joints, _ in answers])
    show_image(axes, image, camera.project(every))
    for i, (_, _, joints, colour) in reversed([*enumerate(answers)]):
        width = 6.0 if i else 2.5
        add_skeleton(axes, camera.project(joints), names, colour, width)


def show_strip(
    figure: Any, camera: Any, names: Sequence[str], frames: Sequence[tuple[str, Any, Any]]
) -> None:
    """Draws images side by side, each with its title and poses, which have joints and a colour."""
    every = np.array([joints for *_, poses in frames for joints, _ in poses])
    if not len(every):
        raise ValueError('nobody is tracked in the images that are shown')
    for axes, (title, image, poses) in zip(figure.subplots(1, len(frames)), frames):
        show_image(axes, image, camera.project(every), title)
        for joints, colour in poses:
            add_skeleton(axes, camera.project(joints), names, colour)


def save(figure: Figure, path: Path) -> None:
    """Writes a picture, and says where."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, format='png', facecolor='white')
    print(f'picture: {path}')
