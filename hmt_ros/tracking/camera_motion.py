"""Motion of the camera between images, in a fixed frame.

    p' = R p + t                     a fixed point in the camera frames of two images, m
    R = C'^T C,  t = C'^T (c - c')   from poses of the camera, p_fixed = C p + c

A mixture over poses is in the camera frame. Before prediction it is transformed from the previous
camera frame to the present camera frame, so that velocities and predictions are relative to the
fixed frame. With the angular velocity w = A(a) da/dt of the root's angles a,

    place' = R place + t,   Q(a') = R Q(a),   da' = A(a')^-1 R A(a) da

and the mean velocities and the covariances of states are transformed with this Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera_pose import CameraPose
from hmt_ros.body.mirror import propagated, turn_jacobians, turned
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import seconds
from hmt_ros.inference.linear_algebra import product
from hmt_ros.tracking.classes import ways
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.settings import MAX_EXTRAPOLATION_TIME


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Transform between the camera frames of two images: p' = R p + t.

    Attributes:
        rotation: rotation R (3, 3).
        translation: translation t (3,), m.
    """

    rotation: Array
    translation: Array

    @classmethod
    def between(cls, before: CameraPose, now: CameraPose) -> CameraMotion | None:
        """Motion between two poses of the camera; None if the poses are equal."""
        if before.equals(now):
            return None
        back = now.rotation.T
        return cls(product(back, before.rotation), product(back, before.position - now.position))

    def points(self, points: Array) -> Array:
        """Transforms fixed points (..., 3), m."""
        return self.directions(points) + self.translation

    def directions(self, directions: Array) -> Array:
        """Transforms fixed directions (..., 3)."""
        result: Array = product(directions, self.rotation.T)
        return result

    def poses(self, body: Body, poses: Array) -> Array:
        """Transforms poses (N, d) of a body, and clips them to its limits."""
        return np.clip(self.free_poses(body, poses), body.lower, body.upper)

    def free_poses(
        self, body: Body, poses: Array, turn: float = 0.0, to: Body | None = None
    ) -> Array:
        """Transforms poses (N, d) of a body, without regard to its limits.

        Args:
            body: body of the poses.
            poses: (N, d) poses.
            turn: approximate rotation of the root about z, rad, which determines the whole turns in
                the resulting angle.
            to: body with the level of the result; None: the level is unchanged.
        """
        offset = body.skeleton.offsets[0]
        result = turned(body, poses, body if to is None else to, self.rotation, turn)
        result[:, :3] = self.points(poses[:, :3] + offset) - offset
        return result

    def jacobians(self, body: Body, before: Array, after: Array, to: Body | None = None) -> Array:
        """Derivatives (N, d, d) of `free_poses` at poses `before`, with the results `after`."""
        result = turn_jacobians(body, before, body if to is None else to, after, self.rotation)
        result[:, :3, :3] = self.rotation
        return result

    def modes(self, body: Body, modes: Modes) -> Modes:
        """Transforms modes to the new camera frame."""
        poses = self.poses(body, modes.poses)
        jacobians = self.jacobians(body, modes.poses, poses)
        joints = body.joint_positions(poses)
        count = modes.state_covariances.shape[1] // body.dimension
        states = np.zeros_like(modes.state_covariances)
        for i in range(count):
            own = slice(i * body.dimension, (i + 1) * body.dimension)
            states[:, own, own] = jacobians
        return replace(
            modes,
            poses=poses,
            back=ways(body, joints, joints[0]),
            expected=self.poses(body, modes.expected),
            soles=self.points(modes.soles),
            velocities=product(jacobians, modes.velocities[..., None])[..., 0],
            covariances=propagated(jacobians, modes.covariances),
            filtered=propagated(jacobians, modes.filtered),
            state_covariances=propagated(states, modes.state_covariances),
        )


class CameraPath:
    """Path of the camera, from poses that are given for most images.

    For an image without a pose, the motion between the last two given poses is extrapolated for at
    most `MAX_EXTRAPOLATION_TIME`; after that the motion is unknown until the next given pose. A
    given pose corrects the extrapolation: the pose at the previous image is then interpolated.

    Attributes:
        known: whether the motion to the present image is given or extrapolated.
    """

    def __init__(self) -> None:
        self.known = False
        self._given: list[tuple[int, CameraPose]] = []
        self._last_stamp = 0

    def advance(self, stamp: int, pose: CameraPose | None) -> CameraMotion | None:
        """Advances to the next image; returns the motion in between, None if zero or unknown.

        Args:
            stamp: timestamp of the image, ns.
            pose: pose of the camera; None: not given.
        """
        last, self._last_stamp = self._last_stamp, stamp
        if pose is not None:
            self.known = True
            before = self._given[-1:]
            self._given = [*before, (stamp, pose)]
            if not before:
                return None
            return CameraMotion.between(_pose_at(before[0], (stamp, pose), last), pose)
        self.known = (
            len(self._given) == 2 and seconds(stamp - self._given[-1][0]) <= MAX_EXTRAPOLATION_TIME
        )
        if not self.known:
            return None
        first, second = self._given
        return CameraMotion.between(_pose_at(first, second, last), _pose_at(first, second, stamp))


def _pose_at(
    first: tuple[int, CameraPose], second: tuple[int, CameraPose], stamp: int
) -> CameraPose:
    """Interpolates or extrapolates two poses with timestamps, ns, to another timestamp."""
    (start, a), (end, b) = first, second
    if stamp == end or a.equals(b):
        return b
    if stamp == start:
        return a
    return a.towards(b, (stamp - start) / (end - start))
