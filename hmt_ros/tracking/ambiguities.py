"""Which large ambiguities tell hypotheses apart: heading, lean of the trunk, legs.

    class = [faces another way than the reference] + 2 [trunk leans the other way in depth]
            + 4 [legs are exchanged in the image]

A camera hardly tells these apart, and a wrong one does not come right by small steps: each class
that the evidence does not rule out keeps a mode.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import faces_back
from hmt_ros.inference.arrays import Array, Index

# A trunk that leans less than this out of the image plane leans neither way, as sine of the angle.
LEAN = 0.25
# Ankles that are nearer to each other than this can not be told apart, m.
APART = 0.12


def ambiguity_classes(body: Body, poses: Array, reference: Array) -> Index:
    """Classes (N,) of poses (N, d) relative to a reference pose (d,), which has class 0."""
    joints = body.joint_positions(np.concatenate([reference[None], poses]))

    def at(name: str) -> Array:
        return joints[:, body.skeleton.joint_index([name])[0]]

    result: Index = faces_back(body, poses, reference).astype(np.intp)
    ray = joints[:, 0] / np.linalg.norm(joints[:, 0], axis=1, keepdims=True)
    trunk = at('neck') - joints[:, 0]
    lean = (trunk * ray).sum(1) / np.linalg.norm(trunk, axis=1)
    result += 2 * ((lean[1:] * lean[0] < 0) & (np.abs(lean[1:] - lean[0]) > 2 * LEAN))
    # Across the line of sight.
    gap = at('left_ankle') - at('right_ankle')
    gap = gap - (gap * ray).sum(1, keepdims=True) * ray
    apart = np.linalg.norm(gap, axis=1)
    exchanged = (gap[1:] @ gap[0] < 0) & (apart[1:] > APART) & (apart[0] > APART)
    result += 4 * exchanged
    return result
