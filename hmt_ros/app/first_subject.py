"""Makes a subject file, which starts a track, from the keypoints in one image of a bag.

The keypoint schemes define the joint of each landmark (`hmt_ros.image.keypoint_schemes`). Eyes,
ears and nose are left out, because they are not at a joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.body import Body
from hmt_ros.image.keypoint_schemes import landmarks_of
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagReader
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.headers import time_ns
from msg_tools.messages.keypoints import keypoints_of

# Joints that the first image of the track should show, and how many of them are enough.
WANTED_JOINTS = tuple(
    f'{side}_{joint}'
    for joint in ('hip', 'shoulder', 'knee', 'ankle', 'elbow', 'wrist')
    for side in ('left', 'right')
)
ENOUGH_JOINTS = 10
MIN_JOINTS = 4  # minimum number of joints in a subject file
MIN_CONFIDENCE = 0.5
# Name of the landmark at the joint of the head.
_CENTRE_OF_HEAD = 'centre_of_head'
# Standard deviation of a keypoint as a fraction of the person's image size, and the minimum
# standard deviation, px.
SIGMA, MIN_SIGMA = 0.03, 2.0


@dataclass(frozen=True)
class Seen:
    """Joints in an image.

    Attributes:
        stamp_ns: stamp of the image.
        joints: joints with sufficient confidence, under their names in the body.
    """

    stamp_ns: int
    joints: Keypoints

    @property
    def count(self) -> int:
        """Number of wanted joints that were seen."""
        return len({*self.joints.names} & {*WANTED_JOINTS})

    @property
    def is_enough(self) -> bool:
        """Whether a track can start well from these joints."""
        return self.count >= ENOUGH_JOINTS and {*WANTED_JOINTS[:4]} <= {*self.joints.names}


def find_start(path: Path, body: Body) -> Seen:
    """Finds the image of a bag from which a track starts, and the joints in it.

    It is the first image that shows `ENOUGH_JOINTS` of the `WANTED_JOINTS` joints with confidence,
    including hips and shoulders, or else the image with the most joints.

    Raises:
        ValueError: the bag has no keypoints, or too few in each image.
    """
    best: Seen | None = None
    with BagReader(path) as bag:
        topic = recorded_input(bag).of('keypoints')
        if topic is None:
            raise ValueError(f'{path} has no keypoints: import them with the video')
        for stored in bag.messages([topic.name]):
            stamp = time_ns(stored.message.header.stamp)
            seen = Seen(stamp, joints_of(keypoints_of(stored.message, MIN_SIGMA), body))
            if best is None or seen.count > best.count:
                best = seen
                if seen.is_enough:
                    break
    count = 0 if best is None else len(best.joints.names)
    if best is None or count < MIN_JOINTS:
        raise ValueError(
            f'{path}: {count} joints of {body.name} are seen with confidence in each image, wanted '
            f'{MIN_JOINTS} at least'
        )
    return best


def joints_of(keypoints: Keypoints, body: Body) -> Keypoints:
    """The joints of a body that have confident landmarks, under their names in the body.

    A joint is at the landmark of the same name. If the detector has no such landmark, the joint is
    at the mean of several landmarks, for example the hand at the mean of the fingers.
    """
    names, known = keypoints.names, body.joint_names
    sure = keypoints.seen & (keypoints.confidences >= MIN_CONFIDENCE)
    places: dict[str, list[int]] = {}
    for i, mark in enumerate(landmarks_of(names, known)):
        joint = names[i] if mark is None else mark.joint
        stands_for_it = names[i] == joint or joint not in names
        beside_it = mark is not None and joint == 'head' and mark.name != _CENTRE_OF_HEAD
        if sure[i] and joint in known and stands_for_it and not beside_it:
            places.setdefault(joint, []).append(i)
    if not places:
        return NO_KEYPOINTS
    pixels = np.array([keypoints.pixels[i].mean(0) for i in places.values()])
    covariances = np.array([keypoints.covariances[i].mean(0) for i in places.values()])
    confidences = np.array([keypoints.confidences[i].mean() for i in places.values()])
    return Keypoints(tuple(places), pixels, covariances, confidences)


def subject_text(seen: Seen, stature: float) -> str:
    """Text of a subject file with the seen joints and the stature of the person, m."""
    pixels = seen.joints.pixels
    sigma = max(SIGMA * float(np.ptp(pixels, axis=0).max()), MIN_SIGMA)
    lines = [
        '# joints in one image, as a detector found them',
        f'stamp_ns: {seen.stamp_ns}',
        f'sigma_px: {sigma:.1f}',
        "keypoints:  # name: [u, v] in pixels; left and right are the person's own",
    ]
    for name, (u, v) in zip(seen.joints.names, pixels, strict=True):
        lines.append(f'  {name}: [{u:.1f}, {v:.1f}]')
    lines.append(f'stature_m: {stature:g}')
    return '\n'.join(lines) + '\n'
