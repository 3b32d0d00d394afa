"""Gravity at the start of a track: people are upright against it, whatever the camera's axes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.ground_terms import FloorPlane, GroundSettings, GroundTerm
from hmt_ros.body.mirror import root_angles, root_rotation_dofs, root_rotations
from hmt_ros.inference.arrays import Array
from hmt_ros.tracking.ground import IMAGE_UP


@dataclass(frozen=True, eq=False)
class Gravity:
    """What is known of gravity when a track starts; of the floor nothing is.

    Attributes:
        plane: with the direction against gravity and its deviation; the height is not used.
        weight: factor on the energy of the lean, more than 0.
    """

    plane: FloorPlane
    weight: float = 1.0

    def term(self, body: Body) -> GroundTerm:
        """The energy of the lean of pelvis and trunk of a body."""
        plane = replace(self.plane, height=None, height_sigma=np.inf)
        return GroundTerm(body, GroundSettings(self.weight, 0.0), plane)

    def turned(self, body: Body, poses: Array) -> Array:
        """Poses (N, d) upright in the image, turned the shortest way to be upright in space."""
        turn = shortest_turn(IMAGE_UP, self.plane.up)
        result = poses.copy()
        angles = root_rotation_dofs(body.skeleton)
        result[:, angles] = root_angles(body, turn @ root_rotations(body, poses))
        return np.clip(result, body.lower, body.upper)


def shortest_turn(start: Array, end: Array) -> Array:
    """The rotation (3, 3) by the least angle that takes a unit vector to another.

    Of opposite ones, where no rotation is the shortest, that about the optical axis, as when the
    camera hangs upside down; they lie in the plane of the image.
    """
    cosine = float(start @ end)
    if cosine <= -1.0 + 1e-9:
        return np.diag([-1.0, -1.0, 1.0])
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    result: Array = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    return result
