"""Evidence of keypoints for a person in the image, and tests whether they can start a track."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array

# Minimum number of keypoints of a person.
MIN_KEYPOINTS = 6
# Minimum confidence of a keypoint whose position is trusted.
MIN_CONFIDENCE = 0.5
# Magnification, px/m, up to which keypoints are no evidence of a person; from twice this value they
# are full evidence. Detectors find small people in table legs and in leaves, with full confidence.
MIN_MAGNIFICATION = 22.0


def keypoint_evidence(keypoints: Keypoints, body: Body) -> float:
    """Evidence from a detector for a person in the image, from -1 (nobody) to 1.

    The evidence is 1 if the sum of the confidences reaches `MIN_KEYPOINTS` times `MIN_CONFIDENCE`,
    and -1 below a third of this value. With fewer keypoints, or for a very small person, it is at
    most 0.
    """
    seen = keypoints.confidences[keypoints.seen]
    most = 0.0
    if len(seen) >= MIN_KEYPOINTS:
        most = min(max(_magnification(keypoints, body) / MIN_MAGNIFICATION - 1.0, 0.0), 1.0)
    whole = float(seen.sum()) / (MIN_KEYPOINTS * MIN_CONFIDENCE)
    return float(np.clip(3.0 * whole - 2.0, -1.0, most))


def suffices(keypoints: Keypoints | None, body: Body) -> bool:
    """Whether the keypoints of one image determine position and facing of a person.

    The keypoints must include all joints of the trunk except at most one.
    """
    if keypoints is None:
        return False
    names = _confident(keypoints)
    trunk = [name for pair in body.trunk_pairs for name in pair]
    of_trunk = sum(name in names for name in trunk)
    return len(names) >= MIN_KEYPOINTS and of_trunk >= len(trunk) - 1


def shows_a_part(keypoints: Keypoints | None, body: Body) -> bool:
    """Whether keypoints are evidence of a person and determine the facing."""
    if keypoints is None or keypoint_evidence(keypoints, body) <= 0.0:
        return False
    names = _confident(keypoints)
    return any(left in names and right in names for left, right in body.trunk_pairs)


def _confident(keypoints: Keypoints) -> set[str]:
    sure = keypoints.seen & (keypoints.confidences >= MIN_CONFIDENCE)
    return {keypoints.names[i] for i in np.flatnonzero(sure)}


def _magnification(keypoints: Keypoints, body: Body) -> float:
    """Approximate magnification, px/m, from the extent of the keypoints if the person stands."""
    standing = _standing(body)
    known = [i for i in np.flatnonzero(keypoints.seen) if keypoints.names[i] in standing]
    if not known:
        return math.inf
    joints = np.array([standing[keypoints.names[i]] for i in known])
    extent = np.ptp(keypoints.pixels[known], axis=0).max()
    return float(extent / max(np.ptp(joints, axis=0).max(), 1e-3))


@lru_cache(maxsize=8)
def _standing(body: Body) -> dict[str, Array]:
    """Positions (3,) of the joints of a standing person, m, by name."""
    joints = body.joint_positions(body.prior_mean[None])[0]
    return dict(zip(body.joint_names, joints, strict=True))
