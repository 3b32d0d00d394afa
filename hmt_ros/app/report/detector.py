"""Skeletons of a detector that gives 3D positions, for comparison with the mixtures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hmt_ros.app.recorded_bodies import topic_beside
from hmt_ros.app.report.mixtures import Layer, Moment
from hmt_ros.evaluation.pose_scores import HIPS, ORIGIN
from hmt_ros.image.keypoint_schemes import landmarks_of
from hmt_ros.inference.arrays import Array
from msg_tools import BagReader
from msg_tools.messages.headers import time_ns
from msg_tools.messages.keypoints import KEYPOINTS_3D, Positions, positions_of

_MIDDLE_JOINTS = {ORIGIN: HIPS, 'neck': ('left_shoulder', 'right_shoulder')}


@dataclass(frozen=True, eq=False)
class Detector:
    """The skeletons on a topic of hmt_msgs/Keypoints3D.

    Attributes:
        topic: name of the topic.
        joint_names: (J,) joints of the body at which the detector has landmarks.
        joints: (J, 3) joint positions, m, camera optical frame, shifted to the pelvis of the
            heaviest mode, by stamp in ns; NaN if a joint was not seen.
        confidences: mean confidence of all landmarks, by stamp.
    """

    topic: str
    joint_names: tuple[str, ...]
    joints: dict[int, Array]
    confidences: dict[int, float]


def read_detector(path: Path, layer: Layer[Moment]) -> Detector | None:
    """Reads the detector's skeletons at the times of a layer, shifted to the layer's pelvis.

    Args:
        path: path of the bag.
        layer: the mixtures to show; the topic of the detector is in the same namespace, or else the
            bag's only Keypoints3D topic.

    Returns:
        The skeletons; None if no skeleton at these times has a pelvis or hips.

    Raises:
        ValueError: an invalid message.
    """
    names, found, confidences = layer.joint_names, {}, {}
    with BagReader(path) as bag:
        topic = topic_beside(bag, KEYPOINTS_3D, layer.topic)
        for stored in [] if topic is None else bag.messages([topic]):
            stamp = time_ns(stored.message.header.stamp)
            if stamp not in layer.mixtures:
                continue
            joints = _with_middles(_at_joints(stored.content(positions_of), names))
            ours = _with_middles(dict(zip(names, layer.mixtures[stamp].joints[0], strict=True)))
            if ORIGIN in joints and ORIGIN in ours:
                shift = ours[ORIGIN] - joints[ORIGIN]
                found[stamp] = {name: joint + shift for name, joint in joints.items()}
                known = len(stored.message.confidence)
                confidences[stamp] = float(np.mean(stored.message.confidence)) if known else np.nan
    if topic is None or not found:
        return None
    seen = dict.fromkeys(name for joints in found.values() for name in joints)
    nowhere = np.full(3, np.nan)
    rows = {t: np.stack([one.get(x, nowhere) for x in seen]) for t, one in found.items()}
    return Detector(topic, tuple(seen), rows, confidences)


def _at_joints(positions: Positions, names: tuple[str, ...]) -> dict[str, Array]:
    """Position of each joint: the mean of the landmarks that vary least between people."""
    found: dict[str, dict[float, list[Array]]] = {}
    marks = landmarks_of(positions.names, names)
    for name, mark, place in zip(positions.names, marks, positions.positions, strict=True):
        joint, sigma = (name, 0.0) if mark is None else (mark.joint, mark.sigma)
        if joint in names and np.isfinite(place).all():
            found.setdefault(joint, {}).setdefault(sigma, []).append(place)
    return {joint: np.mean(places[min(places)], axis=0) for joint, places in found.items()}


def _with_middles(joints: dict[str, Array]) -> dict[str, Array]:
    """Sets pelvis and neck to the middle of the hips and of the shoulders, if these are known."""
    middles = {
        name: np.mean([joints[end] for end in ends], axis=0)
        for name, ends in _MIDDLE_JOINTS.items()
        if set(ends) <= joints.keys()
    }
    return {**joints, **middles}
