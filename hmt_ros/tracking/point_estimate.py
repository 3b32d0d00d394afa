"""One pose for those who want one: the expected pose of one way to face, steady over time.

    m      = the mode of least expected joint error     sum_k w_k d(m, k), among those that face as
                                                        the estimate before
    x_t^0  = sum_k w_k x_k / sum_k w_k                  over the modes that face like m
    x_t    = p_t + a (x_t^0 - p_t),    p_t = x_(t-1) + c v_(t-1)
    v_t    = c v_(t-1) + b (x_t^0 - p_t)

A mean over poses that face opposite ways is no pose: the estimate keeps its way until modes of the
other have `SWITCH` of the weight, and then takes the other at once. The filter with gains a and b
takes away what trembles from image to image; errors that last stay.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import left_directions, root_angles, root_rotation_dofs, root_rotations
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.hypotheses import relative_joints

# Weight of the other way to face above which the estimate turns about.
SWITCH = 0.6
# Gains a and b, and the share c of the velocity that lasts, from image to image at 30 Hz.
GAIN, VELOCITY_GAIN, KEPT = 0.45, 0.08, 0.9
RATE = 30.0  # Hz
# Errors of a joint count up to this, m.
CAP = 0.4


class PointEstimate:
    """The point estimate of a track.

    Attributes:
        pose: (d,); None: there is none yet.
    """

    def __init__(self) -> None:
        self.pose: Array | None = None
        self._velocity = np.zeros(0)

    def carry(self, body: Body, motion: CameraMotion) -> None:
        """Takes the estimate into the camera frame of the next image."""
        if self.pose is None:
            return
        before = self.pose[None]
        self.pose = motion.poses(body, before)[0]
        self._velocity = motion.jacobians(body, before, self.pose[None])[0] @ self._velocity

    def update(self, body: Body, poses: Array, weights: Array, dt: float) -> Array:
        """Takes in the modes of an image; returns the pose (d,).

        Args:
            body: of the poses.
            poses: (K, d).
            weights: (K,), not all 0.
            dt: since the last image, s; 0: there was none.
        """
        weights = weights / weights.sum()
        alike, steady = self._way(body, poses, weights)
        share = np.where(alike, weights, 0.0)
        leader = _least_expected_error(body, poses, share)
        near = left_directions(body, poses) @ left_directions(body, poses[leader][None])[0] > 0
        share = np.where(near, share, 0.0)
        expected = _mean_pose(body, poses, share / share.sum(), leader)
        if self.pose is None or not steady or dt <= 0:
            self.pose, self._velocity = expected, np.zeros_like(expected)
            return expected
        images = dt * RATE
        kept = KEPT**images
        predicted = self.pose + kept * images * self._velocity
        offset = expected - predicted
        root = root_rotation_dofs(body.skeleton)
        offset[root] = (offset[root] + np.pi) % (2.0 * np.pi) - np.pi
        pose = predicted + (1.0 - (1.0 - GAIN) ** images) * offset
        self._velocity = kept * self._velocity + VELOCITY_GAIN / images * offset
        self.pose = np.clip(pose, body.lower, body.upper)
        return self.pose

    def _way(self, body: Body, poses: Array, weights: Array) -> tuple[Mask, bool]:
        """Modes (K,) that face as the estimate does from now on, and whether it did before."""
        if self.pose is None:
            return np.ones(len(poses), dtype=np.bool_), False
        before = left_directions(body, self.pose[None])[0]
        alike = left_directions(body, poses) @ before >= 0
        if weights[~alike].sum() > SWITCH or not alike.any():
            return np.asarray(~alike, dtype=np.bool_), False
        return np.asarray(alike, dtype=np.bool_), True


def _least_expected_error(body: Body, poses: Array, weights: Array) -> int:
    """The mode with the least expected distance of its joints from those of the others."""
    joints = relative_joints(body, poses)
    apart = np.linalg.norm(joints[:, None] - joints[None], axis=3)
    cost = np.minimum(apart, CAP).mean(2) @ weights
    return int(np.argmin(np.where(weights > 0, cost, np.inf)))


def _mean_pose(body: Body, poses: Array, weights: Array, leader: int) -> Array:
    """Weighted mean (d,) of poses (K, d); rotations of the root as rotations."""
    mean: Array = weights @ poses
    u, _, v = np.linalg.svd(np.einsum('k,kij->ij', weights, root_rotations(body, poses)))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    root = root_rotation_dofs(body.skeleton)
    angles = root_angles(body, rotation[None])[0]
    # The turn nearest to that of the leader.
    turns = np.round((poses[leader, root] - angles) / (2.0 * np.pi))
    mean[root] = angles + 2.0 * np.pi * turns
    result: Array = np.clip(mean, body.lower, body.upper)
    return result
