"""Mixtures over poses in a stationary frame, instead of the frame of a moving camera.

The root of a pose refers to a frame with the axes of a camera: x right, y down, z forward. Mixtures
are therefore published in the frame `<fixed_frame>_optical`, which has the origin of `fixed_frame`
and these axes. The z axis of `fixed_frame` must point up: the root angles of a standing person are
then far from their poles, whichever way the person faces. The transform is published on `/tf`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.mirror import propagated, root_rotation_dofs
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import length, product
from hmt_ros.sessions.transform_buffer import Transform
from hmt_ros.tracking.camera_motion import CameraMotion

# Rotation to (x forward, y left, z up) from (x right, y down, z forward).
OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Sine of the angle between optical axis and vertical below which the camera has no heading.
_MIN_HEADING_SINE = 1e-3


@dataclass(frozen=True, eq=False)
class FixedFrame:
    """A stationary frame, with the pose of the camera at one image.

    Attributes:
        name: name of the frame, whose z axis points up.
        camera: pose of the camera in the frame: p_fixed = R p_camera + t.
        turn: angle about z that the transform added to the root at the previous image, rad; it
            determines the number of whole turns at this image.
    """

    name: str
    camera: Transform
    turn: float = 0.0

    @property
    def optical(self) -> str:
        """Name of the frame with the axes of a camera."""
        return f'{self.name}_optical'

    @property
    def motion(self) -> CameraMotion:
        """Transform from the frame of the camera to the frame `optical`."""
        back = OPTICAL_TO_BODY.T
        return CameraMotion(
            product(back, self.camera.rotation), product(back, self.camera.translation)
        )

    def placed(
        self, body: Body, mixture: GaussianMixture, velocities: Array | None = None
    ) -> tuple[GaussianMixture, Array | None]:
        """Transform a mixture and its velocities (K, d), if known, to the frame `optical`.

        Returns:
            Mixture and velocities in the frame `optical`, with root angles relative to its axes.
            Means are transformed exactly, covariances and velocities with the Jacobian at the
            means.
        """
        motion, upright = self.motion, body.levelled(np.eye(3))
        means = motion.free_poses(body, mixture.means, self.turn, upright)
        jacobians = motion.jacobians(body, mixture.means, means, upright)
        covariances = propagated(jacobians, mixture.covariances)
        if velocities is not None:
            velocities = np.einsum('kij,kj->ki', jacobians, velocities)
        return GaussianMixture(mixture.weights, means, covariances), velocities

    def turn_of(self, body: Body, pose: Array) -> float:
        """Return the angle about z, rad, that the transform adds to the root of a pose (d,)."""
        about_z = root_rotation_dofs(body.skeleton)[0]
        upright = body.levelled(np.eye(3))
        placed = self.motion.free_poses(body, pose[None], self.turn, upright)[0]
        return float(placed[about_z] - pose[about_z])


def upright(up: Array) -> Array:
    """Return the rotation (3, 3) from a frame with x forward and z up to the camera frame.

    If the camera looks straight up or down, x points to the upper edge of the image.

    Args:
        up: (3,) unit vector against gravity, camera frame.
    """
    forward = np.array([0.0, 0.0, 1.0])
    forward = forward - product(forward, up) * up
    if length(forward) < _MIN_HEADING_SINE:
        forward = np.array([0.0, -1.0, 0.0])
        forward = forward - product(forward, up) * up
    forward = forward / length(forward)
    return np.stack([forward, np.cross(up, forward), up], axis=1)
