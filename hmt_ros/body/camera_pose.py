"""Pose of a camera in a static frame: p_fixed = C p + c."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.camera import AXES, Camera
from hmt_ros.body.rotations import rotation_vectors, rotations_of
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import determinant, length, product

# Maximum deviation of an entry of R R' from the identity for a valid rotation R.
ROTATION_TOLERANCE = 1e-3
# Default distance of people and of the scene, m.
USUAL_DISTANCE = 3.0


class CameraPose(NamedTuple):
    """Pose of the camera optical frame in a static frame: p_fixed = C p + c.

    Attributes:
        rotation: C (3, 3).
        position: c (3,), m.
    """

    rotation: Array
    position: Array

    @classmethod
    def of(cls, position: ArrayLike, rotation: ArrayLike) -> CameraPose:
        """A pose from position (3,), m, and rotation (3, 3).

        Raises:
            ValueError: a shape is wrong, a number is not finite, or the matrix is not a rotation.
        """
        place, turn = np.array(position, dtype=np.float64), np.array(rotation, dtype=np.float64)
        if place.shape != AXES[0].shape or not np.isfinite(place).all():
            raise ValueError(
                f'the position of the camera must be three finite numbers, saw {place.tolist()}'
            )
        if (
            turn.shape != AXES.shape
            or not np.abs(product(turn, turn.T) - AXES).max() < ROTATION_TOLERANCE
            or determinant(turn) < 0
        ):
            raise ValueError(
                f'the rotation of the camera must be a rotation matrix (3, 3), saw {turn.tolist()}'
            )
        return cls(turn, place)

    def equals(self, other: CameraPose) -> bool:
        """Whether the other pose has exactly the same numbers."""
        return all(np.array_equal(a, b) for a, b in zip(self, other, strict=True))

    def shift(self, other: CameraPose, camera: Camera) -> float:
        """Approximate the image shift of static points between the two poses, px."""
        angle = length(rotation_vectors(product(self.rotation.T, other.rotation)))
        apart = length(self.position - other.position)
        return float(max(camera.fx, camera.fy) * (angle + apart / USUAL_DISTANCE))

    def towards(self, other: CameraPose, share: float) -> CameraPose:
        """Interpolate at constant speed from this pose (share 0) to another pose (share 1)."""
        turn = rotation_vectors(product(self.rotation.T, other.rotation))
        rotation = product(self.rotation, rotations_of(share * turn))
        return CameraPose(rotation, self.position + share * (other.position - self.position))
