"""What keypoints say of whether somebody is in view, and whether a track can start from them."""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.image.terms.keypoints import Keypoints

# Fewest keypoints that are a person, as a number of joints.
FEWEST_KEYPOINTS = 6
# A keypoint of this confidence is where it says.
CONFIDENT = 0.5
# Detectors find small people in the legs of a table and in leaves, with full confidence. Keypoints
# of no larger extent than this say nothing, of twice as much all that they can, px.
LEAST_EXTENT = 50.0


def keypoint_evidence(keypoints: Keypoints) -> float:
    """How far a detector sees somebody, from -1, nobody, to 1.

    It is 1 where the confidences sum to as much as the fewest keypoints that are a person have, and
    -1 below a third of that. Fewer joints are no person; they are no empty image, either. Nor is a
    pattern of a few pixels.
    """
    seen = keypoints.confidences[keypoints.seen]
    most = 0.0
    if len(seen) >= FEWEST_KEYPOINTS:
        extent = float(np.ptp(keypoints.pixels[keypoints.seen], axis=0).max())
        most = min(max(extent / LEAST_EXTENT - 1.0, 0.0), 1.0)
    whole = float(seen.sum()) / (FEWEST_KEYPOINTS * CONFIDENT)
    return float(np.clip(3.0 * whole - 2.0, -1.0, most))


def suffices(keypoints: Keypoints | None, body: Body) -> bool:
    """Whether keypoints tell at once where a person is and which way the person faces.

    They do with all joints of the trunk but one.
    """
    if keypoints is None:
        return False
    names = _confident(keypoints)
    trunk = [name for pair in body.trunk_pairs for name in pair]
    of_trunk = sum(name in names for name in trunk)
    return len(names) >= FEWEST_KEYPOINTS and of_trunk >= len(trunk) - 1


def shows_a_part(keypoints: Keypoints | None, body: Body) -> bool:
    """Whether keypoints are a person, and tell which way the person faces."""
    if keypoints is None or keypoint_evidence(keypoints) < 1.0:
        return False
    names = _confident(keypoints)
    return any(left in names and right in names for left, right in body.trunk_pairs)


def _confident(keypoints: Keypoints) -> set[str]:
    sure = keypoints.seen & (keypoints.confidences >= CONFIDENT)
    return {keypoints.names[i] for i in np.flatnonzero(sure)}
