"""Clips for the benchmark `live`: rendered, with known truth.

dance      a dancer, always in view
large      the same with more pixels, at a lower rate
visit      a person walks into an empty scene, and backwards out of it
people N   dancers side by side, with detections of all
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.clips import COMPRESSED, read_messages
from hmt_learning.app import make_bag
from hmt_learning.app.rendered_bag import Take, write_people
from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.scene import Scene
from hmt_ros.app.truth import read_truth
from hmt_ros.body import Camera, load_body
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.headers import FRAME_ID
from msg_tools.messages.keypoints import keypoints_message

RATE, SLOWER = 30.0, 15.0  # images per second
MOTION = 'dance'
LARGE, VISIT, PEOPLE = 'large', 'visit', 'people'
# Standard deviation of keypoints relative to the height of the person in the image.
NOISE = 0.01
# Distance between two neighbouring people, m.
APART = 1.3
# Duration of walking into the image, and of the empty scene before and after, s.
WALK, AWAY = 3.5, 3.0
# Start of the walk, m to the left of the middle of the image.
OUTSIDE = 3.6
CAMERA = Camera(660.0, 660.0, 319.5, 239.5, 640, 480)


def make_clip(folder: Path, name: str, seconds: float) -> Path:
    """Renders a clip unless it exists; returns its folder.

    Raises:
        ValueError: rendering fails.
    """
    target = folder / name
    if not target.exists():
        kind, _, number = name.partition(' ')
        if kind == PEOPLE:
            _make_people(target, int(number), seconds)
        elif kind == VISIT:
            _make_visit(target)
        elif kind == LARGE:
            _make_bag(MOTION, target, seconds, '--size', '1280x720', '--fps', f'{SLOWER:g}')
        else:
            _make_bag(MOTION, target, seconds)
    return target


def rate_of(name: str) -> float:
    """Images per second of a clip."""
    return SLOWER if name == LARGE else RATE


def _make_bag(motion: str, target: Path, seconds: float, *given: str) -> None:
    run(make_bag.main, [motion, '--duration', f'{seconds:g}', '--quiet', '-o', str(target), *given])


def run(command: Callable[[list[str]], int], arguments: list[str]) -> None:
    """Runs a command of the package.

    Raises:
        ValueError: the command fails.
    """
    if code := command(arguments):
        raise ValueError(f'{" ".join(arguments)} ended with {code}')


def _make_visit(target: Path) -> None:
    body, viewpoint = load_body('human37'), Viewpoint()
    walk = procedural_motion('walk', body, WALK, RATE, heading=np.pi / 2, viewpoint=viewpoint)
    walk[:, 0] -= walk[0, 0] + OUTSIDE
    stays = np.repeat(walk[:1], round(AWAY * RATE), axis=0)
    poses = np.concatenate([stays, walk, walk[::-1], stays])
    write_people(target, [Take('a visit', body, poses, RATE)], CAMERA, Scene(viewpoint=viewpoint))


def _make_people(target: Path, count: int, seconds: float) -> None:
    """Renders dancers side by side, centred in the image."""
    body, viewpoint = load_body('human37'), Viewpoint()
    takes = []
    for number in range(count):
        poses = procedural_motion(MOTION, body, seconds, RATE, number, viewpoint=viewpoint)
        poses[:, 0] += (number - (count - 1) / 2) * APART
        takes.append(Take(f'dancer {number}', body, poses, RATE))
    write_people(target, takes, CAMERA, Scene(viewpoint=viewpoint))


def noisy_keypoints(clip: Path) -> Path:
    """A bag with `keypoints` of each image: the true joints with detector noise."""
    target = clip / 'keypoints'
    if target.exists():
        return target
    truth = read_truth(clip / 'truth.npz')
    info, _ = read_messages(clip, [COMPRESSED], 1)
    camera = np.asarray(info.k).reshape(3, 3)
    stamps = sorted(truth.joints)
    joints = np.array([truth.joints[stamp] for stamp in stamps])
    known = np.isfinite(joints).all((0, 2))
    seen = joints[:, known] @ camera.T
    pixels = seen[..., :2] / seen[..., 2:]
    height = np.ptp(pixels[..., 1], axis=1)[:, None, None]
    pixels += NOISE * height * np.random.default_rng(0).standard_normal(pixels.shape)
    names = tuple(np.array(truth.joint_names)[known].tolist())
    unknown, messages = np.full((len(names), 2, 2), np.nan), RosbagsMessages()
    with BagWriter(target) as bag:
        for stamp, each in zip(stamps, pixels, strict=True):
            found = Keypoints(names, each, unknown, np.ones(len(names)))
            bag.write('keypoints', stamp, keypoints_message(messages, found, stamp, FRAME_ID))
    return target


def shares_in_view(clip: Path) -> dict[int, float]:
    """Share of the visitor's joints that lie in the image, by timestamp."""
    info, _ = read_messages(clip, [COMPRESSED], 1)
    with np.load(clip / 'truth_a.npz') as truth:
        pixels, stamps = truth['pixels'], truth['stamps']
    inside = (pixels >= 0).all(-1) & (pixels < (info.width, info.height)).all(-1)
    return dict(zip(stamps.tolist(), inside.mean(1).tolist(), strict=True))
