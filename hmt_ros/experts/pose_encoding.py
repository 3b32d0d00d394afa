"""Encoding of poses as targets of experts: relative to the view, without wrap-around of angles.

A target has D = 6 + A numbers. The first six are the front axis and the up axis of the pelvis, in
the frame of the viewing ray: the levelled camera, turned so that its optical axis points at the
pelvis. A posture then has the same target everywhere in the image, and the target of a turning
person does not jump from +180 to -180 degrees. The other numbers are the A joint angles, whose
limits span less than a turn. The position of the person is not part of the target, because the
shape of a silhouette does not show it; see `root_placement`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import root_angles, root_rotations
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product, pseudo_inverse

AXES = 6
ROOT = ('root_tx', 'root_ty', 'root_tz')
TURNS = ('root_z', 'root_y', 'root_x')
# Minimum length of an axis in derivatives. The mean over opposite headings is a short vector, and
# its direction carries little information.
MIN_AXIS_LENGTH = 0.1
# Next and previous coordinate of each coordinate, cyclically.
NEXT_AXIS, PREVIOUS_AXIS = [1, 2, 0], [2, 0, 1]
MAX_MIDDLE_ANGLE = np.radians(
    86.0
)  # limit of the middle root angle; at 90 degrees the other axes align


@dataclass(frozen=True, eq=False)
class PoseEncoding:
    """Targets of the poses of a body.

    Attributes:
        body: Body whose root has the degrees of freedom tx, ty, tz, z, y, x in this order, as in
            the shipped bodies.

    Raises:
        ValueError: the root of the body has other degrees of freedom.
    """

    body: Body

    def __post_init__(self) -> None:
        skeleton = self.body.skeleton
        segments = skeleton.dof_segments
        if self.body.dof_names[:AXES] != ROOT + TURNS or (segments[:AXES] != 0).any():
            raise ValueError(
                f'body {self.body.name} has the root {self.body.dof_names[:AXES]}, wanted '
                f'{ROOT + TURNS}: take one such as human37'
            )

    @property
    def size(self) -> int:
        """Length of a target, D."""
        return self.body.dimension

    def encode(self, poses: ArrayLike) -> Array:
        """Targets (N, D) of poses (N, d), whose roots lie in front of the camera.

        Raises:
            ValueError: poses have a wrong shape, are not finite, or lie at the camera's centre.
        """
        poses = np.asarray(poses, dtype=np.float64)
        turned = root_rotations(self.body, poses)
        seen = product(self._from_view(poses[:, :3]).transpose(0, 2, 1), turned)
        axes = seen[:, :, 1:].transpose(0, 2, 1).reshape(-1, AXES)
        return np.concatenate([axes, poses[:, AXES:]], axis=1)

    def decode(self, targets: ArrayLike, roots: ArrayLike) -> Array:
        """Poses (N, d) of targets (N, D) with roots (N, 3) in the camera frame, m.

        The up axis is made perpendicular to the front axis. Joint angles are clipped to the limits
        of the body.
        """
        targets, roots = self._checked(targets, roots)
        poses = np.empty((len(targets), self.body.dimension))
        poses[:, :3] = roots
        turned = product(self._from_view(roots), _orthogonal(targets[:, :AXES]))
        poses[:, 3:AXES] = root_angles(self.body, turned)
        lower, upper = self.body.lower[AXES:], self.body.upper[AXES:]
        poses[:, AXES:] = np.clip(targets[:, AXES:], lower, upper)
        return poses

    def jacobians(self, targets: ArrayLike, roots: ArrayLike) -> tuple[Array, Array]:
        """Derivatives of `decode` with respect to targets (N, d, D) and roots (N, d, 3).

        Clipping of joint angles is ignored, so that their variance is kept.
        """
        targets, roots = self._checked(targets, roots)
        n, d = len(targets), self.body.dimension
        poses = self.decode(targets, roots)
        # The inverse of the matrix of rotation axes maps a small rotation to changes of root
        # angles.
        axes = forward(self.body.skeleton, poses).axes[3:AXES].transpose(2, 1, 0)  # (N, 3, angle)
        from_rotation = pseudo_inverse(axes, float(elementary.cos(MAX_MIDDLE_ANGLE)) / 2)
        by_target, by_root = np.zeros((n, d, d)), np.zeros((n, d, 3))
        to_camera = self._from_view(roots)
        by_target[:, 3:AXES, :AXES] = product(
            product(from_rotation, to_camera), _rotation_by_axes(targets[:, :AXES])
        )
        by_target[:, AXES:, AXES:] = np.eye(d - AXES)
        by_root[:, :3] = np.eye(3)
        by_root[:, 3:AXES] = product(from_rotation, self._view_by_root(roots))
        return by_target, by_root

    def encoding_jacobians(self, poses: ArrayLike) -> Array:
        """Derivatives (N, D, d) of `encode` at poses (N, d)."""
        poses = np.asarray(poses, dtype=np.float64)
        d = self.body.dimension
        result = np.zeros((len(poses), d, d))
        to_ray = self._from_view(poses[:, :3]).transpose(0, 2, 1)
        axes = forward(self.body.skeleton, poses).axes[3:AXES].transpose(2, 1, 0)  # (N, 3, angle)
        turned = root_rotations(self.body, poses)  # camera frame
        # The frame of the ray turns as the root moves; in this frame, axes turn the other way.
        turns = np.concatenate([-self._view_by_root(poses[:, :3]), axes], axis=2)
        for k in range(2):  # front and up
            moved = np.cross(turns, turned[:, :, k + 1, None], axis=1)
            result[:, 3 * k : 3 * k + 3, :AXES] = product(to_ray, moved)
        result[:, AXES:, AXES:] = np.eye(d - AXES)
        return result

    def _from_view(self, points: Array) -> Array:
        """Rotations (N, 3, 3) from a levelled camera looking at points (N, 3) to the camera."""
        level = self.body.level
        return np.asarray(product(level, ray_rotations(product(points, level))))

    def _view_by_root(self, points: Array) -> Array:
        """Derivatives (N, 3, 3) of `_from_view` with respect to the points, camera frame."""
        level = self.body.level
        return np.asarray(
            product(product(level, _rotation_by_root(product(points, level))), level.T)
        )

    def _checked(self, targets: ArrayLike, roots: ArrayLike) -> tuple[Array, Array]:
        targets = np.asarray(targets, dtype=np.float64)
        roots = np.asarray(roots, dtype=np.float64)
        if targets.shape != (len(targets), self.size) or roots.shape != (len(targets), 3):
            raise ValueError(
                f'targets {targets.shape} and roots {roots.shape}, wanted (N, {self.size}), (N, 3)'
            )
        return targets, roots


def ray_rotations(points: Array) -> Array:
    """The smallest rotations (N, 3, 3) that turn the optical axis towards points (N, 3).

    Raises:
        ValueError: a point lies at the camera's centre or straight behind it.
    """
    distance = np.linalg.norm(points, axis=1)
    if not (distance > 0).all() or not (points[:, 2] > -0.99 * distance).all():
        raise ValueError('the root must lie before the camera')
    a, b, c = (points / distance[:, None]).T
    k = 1.0 / (1.0 + c)
    result = np.empty((len(points), 3, 3))
    result[:, 0, 0], result[:, 1, 1], result[:, 2, 2] = 1 - k * a * a, 1 - k * b * b, c
    result[:, 0, 1] = result[:, 1, 0] = -k * a * b
    result[:, 0, 2], result[:, 1, 2], result[:, 2, 0], result[:, 2, 1] = a, b, -a, -b
    return result


def _rotation_by_root(points: Array) -> Array:
    """Derivatives (N, 3, 3) of `ray_rotations` with respect to points (N, 3), camera frame."""
    distance = np.linalg.norm(points, axis=1)
    direction = points / distance[:, None]
    a, b, c = direction.T
    k = 1.0 / (1.0 + c)
    zero, one = np.zeros_like(a), np.ones_like(a)
    by_a = [[-2 * k * a, -k * b, one], [-k * b, zero, zero], [-one, zero, zero]]
    by_b = [[zero, -k * a, zero], [-k * a, -2 * k * b, one], [zero, -one, zero]]
    by_c = [
        [k * k * a * a, k * k * a * b, zero],
        [k * k * a * b, k * k * b * b, zero],
        [zero, zero, one],
    ]
    change = np.array([by_a, by_b, by_c]).transpose(3, 0, 1, 2)  # (N, component, 3, 3)
    skew = product(change, ray_rotations(points)[:, None].transpose(0, 1, 3, 2))
    # A unit vector only changes perpendicular to itself.
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    across /= distance[:, None, None]
    skew = np.einsum('ncij,ncd->ndij', skew, across)
    return np.stack([skew[:, :, 2, 1], skew[:, :, 0, 2], skew[:, :, 1, 0]], axis=1)


def _orthogonal(axes: Array) -> Array:
    """Rotations (N, 3, 3) with columns 2 and 3 from front and up axes (N, 6)."""
    front = _unit(axes[:, :3])
    up = axes[:, 3:] - (axes[:, 3:] * front).sum(1, keepdims=True) * front
    up = _unit(up)
    result = np.empty((len(axes), 3, 3))
    result[:, :, 0], result[:, :, 1], result[:, :, 2] = cross(front, up), front, up
    return result


def _rotation_by_axes(axes: Array) -> Array:
    """Derivatives (N, 3, 6) of `_orthogonal` with respect to axes (N, 6), in the ray's frame."""
    front, up = axes[:, :3], axes[:, 3:]
    frame = _orthogonal(axes)
    y, z = frame[:, :, 1], frame[:, :, 2]
    result = np.empty((len(axes), 3, AXES))
    eye = np.eye(3)
    across = eye - y[:, :, None] * y[:, None, :]
    dy = across / np.maximum(np.linalg.norm(front, axis=1), MIN_AXIS_LENGTH)[:, None, None]
    along = (up * y).sum(1)[:, None, None]
    rest = np.linalg.norm(up - along[:, :, 0] * y, axis=1)
    # d(up - (up y) y) with respect to the front axis, through y, and to the up axis.
    by_front = -(y[:, :, None] * product(up[:, None, :], dy)) - along * dy
    flat = eye - z[:, :, None] * z[:, None, :]
    flat /= np.maximum(rest, MIN_AXIS_LENGTH)[:, None, None]
    dz = [product(flat, by_front), product(flat, across)]
    dys = [dy, np.zeros_like(dy)]
    x = frame[:, :, 0]
    for k in range(2):
        # dy = w x y and dz = w x z give w = x (dy z) + y (dz x) + z (dx y), with dx y = -x dy.
        result[:, :, 3 * k : 3 * k + 3] = (
            x[:, :, None] * product(z[:, None], dys[k])
            + y[:, :, None] * product(x[:, None], dz[k])
            - z[:, :, None] * product(x[:, None], dys[k])
        )
    return result


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3); four times as fast as numpy's for few vectors."""
    return np.asarray(
        a[..., NEXT_AXIS] * b[..., PREVIOUS_AXIS] - a[..., PREVIOUS_AXIS] * b[..., NEXT_AXIS]
    )


def _unit(vectors: Array) -> Array:
    """Unit vectors (N, 3); a zero vector gives the direction to the camera."""
    norm = np.sqrt((vectors * vectors).sum(1, keepdims=True))
    result: Array = vectors / np.maximum(norm, 1e-9)
    result[norm[:, 0] <= 1e-9] = 0.0, 0.0, -1.0
    return result
