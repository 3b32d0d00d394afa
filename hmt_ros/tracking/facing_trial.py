"""Which way a person faces: both ways are followed until the images have decided.

A silhouette does not tell a pose from its reversal in depth (`body.mirror`), and neither do the
first images of a track: who comes may as well go. Knees, elbows and feet give it away within a
second or two, as they move. So a track that starts from silhouettes alone is followed twice, once
for either way. Each following explains every image as well as it can; the logarithm of how much
better one of them did, summed over images, weighs the two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body

Array = NDArray[np.float64]

# Of two ways to face one is given up when it is less probable by this, nats.
DECIDED = 25.0


def left_directions(body: Body, poses: Array) -> Array:
    """Unit vectors (N, 3) to the left of the persons in poses (N, d), in the camera frame.

    Raises:
        ValueError: a body without shoulders and hips.
    """
    names = body.trunk_pairs
    if not names:
        raise ValueError(f'body {body.name} has neither shoulders nor hips: it faces nowhere')
    joints = body.joint_positions(poses)
    ends = [body.skeleton.joint_index(side) for side in zip(*names, strict=True)]
    left = joints[:, ends[0]].sum(1) - joints[:, ends[1]].sum(1)
    result: Array = left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-12)
    return result


def faces_like(body: Body, poses: Array, pose: Array) -> NDArray[np.bool_]:
    """Which of poses (N, d) face the same way as a pose (d,), within a right angle."""
    result: NDArray[np.bool_] = (
        left_directions(body, poses) @ left_directions(body, pose[None])[0] >= 0
    )
    return result


def log_shares(evidence: Sequence[float]) -> Array:
    """Log probabilities of ways to face from their log evidence."""
    values = np.asarray(evidence, dtype=np.float64)
    return np.asarray(values - np.logaddexp.reduce(values), dtype=np.float64)
