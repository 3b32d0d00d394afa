"""Forward kinematics, exact Jacobians, and the assembly of energies over points into pose space.

Everything works on a batch of N poses with the batch on the last axis, so that every operation runs
over contiguous memory, and touches only the degrees of freedom that move a segment.

An energy that depends on the pose through points on segments needs no Jacobian of the points. A
small motion of a segment is a twist (v, w): the point p moves by v + w x p. A residual whose
derivative with respect to its point is the 3-vector a therefore has, with respect to the twist, the
6-vector b = (a, p x a), and a Gauss-Newton term adds `k b b^T` (6 x 6) and `g b` (6) to its
segment. Summed from the leaves to the root these are all that gradient and Hessian need:

    g_j = s_j . F_j,    H_ij = s_i . K_j s_j    for i on the path from the root to j,

with s_j the twist of degree of freedom j and F_j, K_j the sums over all that j moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import derive_along, derive_points, lift_origins, place_points, place_poses
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of the segments at N poses; camera frame, m.

    Attributes:
        skeleton: the skeleton.
        poses: (N, d) whose frames they are.
        segments: columns (N, S, 3, 3) and origins (N, S, 3): columns[n, s, i] is the i-th axis of
            segment s.
        dofs: unit vectors of the degrees of freedom, and points on the axes of rotations,
            (N, d, 3).
    """

    skeleton: Skeleton
    poses: Array
    segments: tuple[Array, Array]
    dofs: tuple[Array, Array]

    @property
    def count(self) -> int:
        """Number of poses, N."""
        return len(self.poses)

    @cached_property
    def columns(self) -> Array:
        """The axes of the segments, (S, 3, 3, N)."""
        return _poses_last(self.segments[0])

    @cached_property
    def origins(self) -> Array:
        """The origins of the segments, (S, 3, N)."""
        return _poses_last(self.segments[1])

    @cached_property
    def axes(self) -> Array:
        """The unit vectors of the degrees of freedom, (d, 3, N)."""
        return _poses_last(self.dofs[0])

    @cached_property
    def dof_origins(self) -> Array:
        """Points on the axes of rotations, (d, 3, N)."""
        return _poses_last(self.dofs[1])

    def points(self, segments: Index, local: Array) -> Array:
        """Points given in segment frames, in the camera frame.

        Args:
            segments: (P,) the segment of each point.
            local: (P, 3), or (P, 3, N) where the points differ from pose to pose, m.

        Returns:
            (P, 3, N) m.
        """
        if local.ndim == 2:
            local = local[:, :, None]
        c = self.columns[segments]
        result = c[:, 0] * local[:, 0, None]
        result += c[:, 1] * local[:, 1, None]
        result += c[:, 2] * local[:, 2, None]
        result += self.origins[segments]
        return result

    def places(self, segments: Index, local: Array) -> Array:
        """Points (N, P, 3) given in segment frames (P, 3), in the camera frame, pose by pose, m."""
        columns, origins = self.segments
        turned = product(local[:, None], columns[:, segments])[..., 0, :]
        return np.asarray(origins[:, segments] + turned)

    def directions(self, segments: Index, local: Array) -> Array:
        """Directions given in segment frames (P, 3), in the camera frame, (P, 3, N)."""
        result: Array = np.einsum('pixn,pi->pxn', self.columns[segments], local)
        return result

    def joints(self) -> Array:
        """Joint positions, (J, 3, N) m."""
        return self.points(self.skeleton.joint_segments, self.skeleton.joint_offsets)

    def twists(self) -> Array:
        """Twists (d, 6, N) of the degrees of freedom.

        First the velocity of the point at the camera, then the rotation.
        """
        rotation = self.skeleton.dof_is_rotation[:, None, None]
        result = np.empty((self.skeleton.dimension, 6, self.count))
        result[:, :3] = np.where(rotation, _cross(self.dof_origins, self.axes), self.axes)
        result[:, 3:] = np.where(rotation, self.axes, 0.0)
        return result

    def by_pose(self) -> tuple[Array, Array]:
        """Columns (N, S, 3, 3) and origins (N, S, 3), pose by pose in memory."""
        return self.segments

    def dofs_by_pose(self) -> tuple[Array, Array]:
        """Axes and points on them (N, d, 3) of the degrees of freedom, pose by pose in memory."""
        return self.dofs

    def rotations(self) -> Array:
        """Rotation matrices (N, S, 3, 3) from the segments' frames to the camera frame."""
        return np.ascontiguousarray(self.segments[0].swapaxes(2, 3))


def forward(skeleton: Skeleton, poses: ArrayLike) -> Frames:
    """Frames of all segments for poses (N, d).

    Raises:
        ValueError: poses that do not have d columns or are not finite.
    """
    q = _checked(skeleton, poses)
    n, s, d = len(q), len(skeleton.parents), skeleton.dimension
    segments, dofs = (np.empty((n, s, 3, 3)), np.empty((n, s, 3))), np.zeros((2, n, d, 3))
    place_poses(placing_of(skeleton), q, *segments, *dofs)
    return Frames(skeleton, q, segments, (dofs[0], dofs[1]))


def joint_positions(skeleton: Skeleton, poses: ArrayLike, *, relative: bool = False) -> Array:
    """Joint positions (N, J, 3) of poses (N, d), camera frame or relative to the first joint, m.

    Raises:
        ValueError: as `forward`.
    """
    return point_positions(
        skeleton, poses, skeleton.joint_segments, skeleton.joint_offsets, relative=relative
    )


def point_positions(
    skeleton: Skeleton, poses: ArrayLike, segments: Index, local: Array, *, relative: bool = False
) -> Array:
    """Positions (N, P, 3) of points on segments (P,) at places there (P, 3) at poses (N, d), m.

    Args:
        relative: to the first point, instead of in the camera frame.

    Raises:
        ValueError: as `forward`.
    """
    q = _checked(skeleton, poses)
    result = np.empty((len(q), len(segments), 3))
    place_points(placing_of(skeleton), q, segments, local, relative, result)
    return result


def _checked(skeleton: Skeleton, poses: ArrayLike) -> Array:
    """Poses (N, d) as an array; the core checks that they are finite.

    Raises:
        ValueError: they do not have d columns.
    """
    q = np.ascontiguousarray(poses, dtype=np.float64)
    if q.ndim != 2 or q.shape[1] != skeleton.dimension:
        raise ValueError(
            f'poses of {skeleton.name} must have shape (N, {skeleton.dimension}), saw {q.shape}'
        )
    return q


def _poses_last(array: Array) -> Array:
    return np.ascontiguousarray(np.moveaxis(array, 0, -1))


def point_jacobians(frames: Frames, segments: Index, points: Array) -> Array:
    """Derivatives (N, P, 3, d) of points (N, P, 3) fixed to segments (P,)."""
    skeleton, places = frames.skeleton, np.ascontiguousarray(points)
    result = np.empty((*points.shape, skeleton.dimension))
    derive_points(skeleton.moves, skeleton.dof_is_rotation, *frames.dofs, segments, places, result)
    return result


def directed_derivatives(
    frames: Frames, segments: Index, points: Array, directions: Array
) -> Array:
    """How far points move in given directions with each degree of freedom.

    Args:
        frames: of one pose.
        segments: (M,) that carry the points.
        points, directions: (M, 3) camera frame.

    Returns:
        (M, d) a . dp / dx.
    """
    skeleton = frames.skeleton
    axes, origins = (x[0] for x in frames.dofs)
    points, directions = (np.ascontiguousarray(x) for x in (points, directions))
    result = np.empty((len(points), skeleton.dimension))
    derive_along(
        skeleton.moves,
        skeleton.dof_is_rotation,
        axes,
        origins,
        segments,
        points,
        directions,
        result,
    )
    return result


def origin_length_jacobians(skeleton: Skeleton, frames: Frames) -> Array:
    """Derivatives (N, S, 3, L) of the origins of the segments with respect to the lengths."""
    columns = frames.segments[0]
    result = np.empty((*columns.shape[:3], len(skeleton.lengths)))
    lift_origins(placing_of(skeleton).parents, skeleton.offset_basis, columns, result)
    return result


def joint_length_jacobians(skeleton: Skeleton, poses: ArrayLike) -> Array:
    """Derivatives (N, J, 3, L) of the joint positions with respect to the lengths."""
    frames = forward(skeleton, poses)
    segments = skeleton.joint_segments
    result = product(frames.rotations()[:, segments], skeleton.joint_basis)
    result += origin_length_jacobians(skeleton, frames)[:, segments]
    return np.asarray(result)


def segment_sums(
    segments: Index, points: Array, directions: Array, pull: Array, curvature: Array, count: int
) -> tuple[Array, Array]:
    """Sums of g b and k b b^T per segment, for residuals at points that stay on their segments.

    Args:
        segments: (M,) the segment of each residual.
        points: (M, 3, N) where it acts, camera frame, m.
        directions: (M, 3, N) derivative a of the residual with respect to its point.
        pull: (M, N) derivative g of the energy with respect to the residual.
        curvature: (M, N) second derivative k, not negative.
        count: number of segments, S.

    Returns:
        wrenches (S, 6, N) and stiffnesses (S, 6, 6, N), for `assemble`.
    """
    n = points.shape[-1]
    b = np.concatenate([directions, _cross(points, directions)], axis=1)
    wrenches = np.zeros((count, 6, n))
    stiffnesses = np.zeros((count, 6, 6, n))
    weighted = curvature[:, None] * b
    order = np.argsort(segments, kind='stable')
    present, starts = np.unique(segments[order], return_index=True)
    for s, rows in zip(present, np.split(order, starts[1:]), strict=True):
        wrenches[s] = np.einsum('mn,man->an', pull[rows], b[rows])
        stiffnesses[s] = np.einsum('man,mbn->abn', weighted[rows], b[rows])
    return wrenches, stiffnesses


def assemble(frames: Frames, wrenches: Array, stiffnesses: Array) -> tuple[Array, Array]:
    """Gradient (N, d) and Gauss-Newton Hessian (N, d, d) from sums over the points of each segment.

    Args:
        frames: of the poses.
        wrenches: (S, 6, N) sum of g b.
        stiffnesses: (S, 6, 6, N) sum of k b b^T, symmetric.
    """
    skeleton = frames.skeleton
    force, stiffness = wrenches.copy(), stiffnesses.copy()
    for s in range(len(skeleton.parents) - 1, 0, -1):
        parent = skeleton.parents[s]
        if parent >= 0:
            force[parent] += force[s]
            stiffness[parent] += stiffness[s]
    twists = frames.twists()
    segments = skeleton.dof_segments
    gradient = np.einsum('jan,jan->nj', twists, force[segments])
    pushed = np.einsum('jabn,jbn->jan', stiffness[segments], twists)
    rows, cols = _coupled_pairs(skeleton)
    values = np.einsum('pan,pan->np', twists[rows], pushed[cols])
    hessian = np.zeros((frames.count, skeleton.dimension, skeleton.dimension))
    hessian[:, rows, cols] = values
    hessian[:, cols, rows] = values
    return gradient, hessian


def point_energy(
    frames: Frames,
    segments: Index,
    local: Array,
    targets: Array,
    weights: Array,
    across: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Energy 1/2 sum w |A (p - t)|^2 of points p that should be at targets t.

    Args:
        frames: of N poses.
        segments: (P,) that carry the points.
        local: (P, 3) places in the frames of the segments, m.
        targets: (P, 3, N) camera frame, m.
        weights: (P, N) w, 1/m^2.
        across: (P, 3, 3, N) A, such as the projection across a ray; the identity when None.

    Returns:
        Value (N,), gradient (N, d), Gauss-Newton Hessian (N, d, d).
    """
    points = frames.points(segments, local)
    error = points - targets
    if across is None:
        across = np.broadcast_to(np.eye(3)[..., None], (len(points), 3, 3, frames.count))
    else:
        error = np.einsum('jikn,jkn->jin', across, error)
    value = 0.5 * np.einsum('jn,jin,jin->n', weights, error, error)
    rows = np.repeat(weights, 3, axis=0)
    sums = segment_sums(
        np.repeat(segments, 3),
        np.repeat(points, 3, axis=0),
        across.reshape(-1, 3, frames.count),
        rows * error.reshape(-1, frames.count),
        rows,
        len(frames.skeleton.parents),
    )
    gradient, hessian = assemble(frames, *sums)
    return value, gradient, hessian


class Placing(NamedTuple):
    """The skeleton as compiled code places it.

    Attributes:
        parents: (S,) segment above; -1: none.
        first_dofs: (S + 1,) the degrees of freedom of segment s start here.
        dof_axes, dof_is_rotation: (d,).
        mounts, offsets: (S, 3, 3), (S, 3) of the segments on their parents.
    """

    parents: NDArray[np.int64]
    first_dofs: NDArray[np.int64]
    dof_axes: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]
    mounts: Array
    offsets: Array


@lru_cache(maxsize=16)
def placing_of(skeleton: Skeleton) -> Placing:
    """The compiled code's view of a skeleton."""
    counts = [len(own) for own in skeleton.segment_dofs]
    return Placing(
        np.array(skeleton.parents, dtype=np.int64),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.array(skeleton.dof_axes, dtype=np.int64),
        np.array(skeleton.dof_is_rotation),
        np.ascontiguousarray(skeleton.mounts, dtype=np.float64),
        np.ascontiguousarray(skeleton.offsets, dtype=np.float64),
    )


@lru_cache(maxsize=16)
def _coupled_pairs(skeleton: Skeleton) -> tuple[Index, Index]:
    """Pairs (i, j) of degrees of freedom with i on the path from the root to j, or i = j."""
    moves = skeleton.moves[skeleton.dof_segments]  # (d, d): column moves the segment of the row
    rows: list[np.intp] = []
    cols: list[int] = []
    for j in range(skeleton.dimension):
        before = np.flatnonzero(moves[j])
        before = before[before <= j]
        rows.extend(before)
        cols.extend([j] * len(before))
    return np.array(rows, dtype=np.intp), np.array(cols, dtype=np.intp)


def _cross(a: Array, b: Array) -> Array:
    """Cross product over the axis before the last."""
    return np.stack(
        [
            a[..., 1, :] * b[..., 2, :] - a[..., 2, :] * b[..., 1, :],
            a[..., 2, :] * b[..., 0, :] - a[..., 0, :] * b[..., 2, :],
            a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :],
        ],
        axis=-2,
    )
