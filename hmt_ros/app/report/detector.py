"""Skeletons of a detector that lifts by itself, beside the mixtures."""

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

_MIDDLES = {ORIGIN: HIPS, 'neck': ('left_shoulder', 'right_shoulder')}


@dataclass(frozen=True, eq=False)
class Detector:
    """The skeletons on a topic of hmt_msgs/Keypoints3D.

    Attributes:
        topic: name of the topic.
        joint_names: (J,) joints of the body, those that its landmarks are at.
        joints: (J, 3) by stamp in ns, m, camera optical frame, the middle of the hips at that of
            the heaviest mode; NaN where a joint was not seen.
        confidences: by stamp, the mean of all landmarks.
    """

    topic: str
    joint_names: tuple[str, ...]
    joints: dict[int, Array]
    confidences: dict[int, float]


def read_detector(path: Path, layer: Layer[Moment]) -> Detector | None:
    """The detector's skeletons at the times of a layer, on whose hips they are put.

    Args:
        path: path of the bag.
        layer: the mixtures that are shown; the detector is on the topic of the same namespace, or
            else on the only one of the bag.

    Returns:
        The skeletons; None: the bag has none with hips at these times.

    Raises:
        ValueError: a message that can not be understood.
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
    """Positions of joints: the mean of the landmarks that vary the least between people."""
    found: dict[str, dict[float, list[Array]]] = {}
    marks = landmarks_of(positions.names, names)
    for name, mark, place in zip(positions.names, marks, positions.positions, strict=True):
        joint, sigma = (name, 0.0) if mark is None else (mark.joint, mark.sigma)
        if joint in names and np.isfinite(place).all():
            found.setdefault(joint, {}).setdefault(sigma, []).append(place)
    return {joint: np.mean(places[min(places)], axis=0) for joint, places in found.items()}


def _with_middles(joints: dict[str, Array]) -> dict[str, Array]:
    """The joints, with pelvis and neck in the middle of hips and shoulders that are known."""
    middles = {
        name: np.mean([joints[end] for end in ends], axis=0)
        for name, ends in _MIDDLES.items()
        if set(ends) <= joints.keys()
    }
    return {**joints, **middles}
