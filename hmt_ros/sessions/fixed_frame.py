"""Mixtures over poses in a frame that stands still, in place of that of a camera that moves.

A pose has its root in a frame with the axes of a camera: x right, y down, z forward. So mixtures
go to the frame `<fixed_frame>_optical`, which has the origin of `fixed_frame` and these axes where
z of `fixed_frame` points up: somebody who stands is far from the poles of the root's angles,
whichever way the person faces. `/tf` tells where it is.
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
FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# A direction of view that is this near to the vertical has no heading, as sine of the angle.
_VERTICAL = 1e-3


@dataclass(frozen=True, eq=False)
class FixedFrame:
    """A frame that stands still, as the camera sees it at one image.

    Attributes:
        name: of the frame, whose z axis points up.
        camera: pose of the camera in it: p_fixed = R p_camera + t.
        turn: angle about z by which the root was turned in the image before, up to whole turns,
            rad.
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
        """From the frame of the camera to that frame."""
        back = FROM_OPTICAL.T
        return CameraMotion(
            product(back, self.camera.rotation), product(back, self.camera.translation)
        )

    def placed(
        self, body: Body, mixture: GaussianMixture, velocities: Array | None = None
    ) -> tuple[GaussianMixture, Array | None]:
        """A mixture over poses of a body in the camera frame, and velocities (K, d), if known.

        Returns:
            Both in the frame `optical`, against whose axes root angles are measured. Means are
            carried over exactly, covariances and velocities with the Jacobian at the means.
        """
        motion, upright = self.motion, body.levelled(np.eye(3))
        means = motion.free_poses(body, mixture.means, self.turn, upright)
        jacobians = motion.jacobians(body, mixture.means, means, upright)
        covariances = propagated(jacobians, mixture.covariances)
        if velocities is not None:
            velocities = np.einsum('kij,kj->ki', jacobians, velocities)
        return GaussianMixture(mixture.weights, means, covariances), velocities

    def turn_of(self, body: Body, pose: Array) -> float:
        """The angle about z by which the root of a pose (d,) is turned, rad; see `turn`."""
        about_z = root_rotation_dofs(body.skeleton)[0]
        upright = body.levelled(np.eye(3))
        placed = self.motion.free_poses(body, pose[None], self.turn, upright)[0]
        return float(placed[about_z] - pose[about_z])


def upright(up: Array) -> Array:
    """Rotation (3, 3) to a camera from the frame that looks its way with z up: x forward.

    A camera that looks straight up or down has its upper edge for forward.

    Args:
        up: (3,) unit vector against gravity, camera frame.
    """
    forward = np.array([0.0, 0.0, 1.0])
    forward = forward - product(forward, up) * up
    if length(forward) < _VERTICAL:
        forward = np.array([0.0, -1.0, 0.0])
        forward = forward - product(forward, up) * up
    forward = forward / length(forward)
    return np.stack([forward, np.cross(up, forward), up], axis=1)
