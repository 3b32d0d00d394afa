"""Forward kinematics, exact Jacobians, and energies over points of the body, for N poses at once.

`core/residuals.h` explains how derivatives with respect to points give derivatives with respect to
poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import (
    derive_along,
    derive_points,
    evaluate_points,
    lift_origins,
    place_points,
    place_poses,
)
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of the segments at N poses; camera frame, m.

    Attributes:
        skeleton: skeleton of the segments.
        poses: (N, d) poses at which the frames are computed.
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
        """Transform points from segment frames to the camera frame.

        Args:
            segments: (P,) the segment of each point.
            local: (P, 3), or (P, 3, N) if the points differ between poses, m.

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
        """Transform points (P, 3) from segment frames to the camera frame, (N, P, 3) m."""
        columns, origins = self.segments
        turned = product(local[:, None], columns[:, segments])[..., 0, :]
        return np.asarray(origins[:, segments] + turned)

    def directions(self, segments: Index, local: Array) -> Array:
        """Rotate directions (P, 3) from segment frames to the camera frame, (P, 3, N)."""
        result: Array = np.einsum('pixn,pi->pxn', self.columns[segments], local)
        return result

    def joints(self) -> Array:
        """Joint positions, (J, 3, N) m."""
        return self.points(self.skeleton.joint_segments, self.skeleton.joint_offsets)

    def by_pose(self) -> tuple[Array, Array]:
        """Axes (N, S, 3, 3) and origins (N, S, 3) of the segments, pose by pose."""
        return self.segments

    def dofs_by_pose(self) -> tuple[Array, Array]:
        """Axes of the degrees of freedom and points on the axes (N, d, 3), pose by pose."""
        return self.dofs

    def rotations(self) -> Array:
        """Rotation matrices (N, S, 3, 3) from the segments' frames to the camera frame."""
        return np.ascontiguousarray(self.segments[0].swapaxes(2, 3))


def forward(skeleton: Skeleton, poses: ArrayLike) -> Frames:
    """Frames of all segments for poses (N, d).

    Raises:
        ValueError: poses do not have d columns or are not finite.
    """
    q = _checked(skeleton, poses)
    n, s, d = len(q), len(skeleton.parents), skeleton.dimension
    segments, dofs = (np.empty((n, s, 3, 3)), np.empty((n, s, 3))), np.zeros((2, n, d, 3))
    place_poses(placing_of(skeleton), q, *segments, *dofs)
    return Frames(skeleton, q, segments, (dofs[0], dofs[1]))


def joint_positions(skeleton: Skeleton, poses: ArrayLike, *, relative: bool = False) -> Array:
    """Joint positions (N, J, 3) of poses (N, d), camera frame or relative to the first joint, m.

    Raises:
        ValueError: see `forward`.
    """
    return point_positions(
        skeleton, poses, skeleton.joint_segments, skeleton.joint_offsets, relative=relative
    )


def point_positions(
    skeleton: Skeleton, poses: ArrayLike, segments: Index, local: Array, *, relative: bool = False
) -> Array:
    """Return positions (N, P, 3) of points, local (P, 3) on segments (P,), at poses (N, d), m.

    Args:
        relative: whether positions are relative to the first point instead of the camera.

    Raises:
        ValueError: see `forward`.
    """
    q = _checked(skeleton, poses)
    result = np.empty((len(q), len(segments), 3))
    place_points(placing_of(skeleton), q, segments, local, relative, result)
    return result


def _checked(skeleton: Skeleton, poses: ArrayLike) -> Array:
    """Poses (N, d) as an array; the core checks that they are finite.

    Raises:
        ValueError: the poses do not have d columns.
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
    """Return derivatives of points along given directions for each degree of freedom.

    Args:
        frames: frames of one pose.
        segments: (M,) segments of the points.
        points, directions: (M, 3) camera frame.

    Returns:
        (M, d) derivatives a . dp / dx of the points p along the directions a.
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


def point_energy(
    frames: Frames, segments: Index, local: Array, targets: Array, across: Array
) -> tuple[Array, Array, Array]:
    """Return the energy 1/2 sum |A (p - t)|^2 of points p with targets t.

    Args:
        frames: frames of N poses.
        segments: (P,) segments of the points.
        local: (P, 3) positions of the points in the frames of the segments, m.
        targets: (N, P, 3) targets t, camera frame, m.
        across: (N, P, R, 3) matrices A of R rows, such as a projection perpendicular to a ray,
            divided by a standard deviation, 1/m.

    Returns:
        Value (N,), gradient (N, d), Gauss-Newton Hessian (N, d, d).
    """
    n, d = frames.count, frames.skeleton.dimension
    value, gradient, hessian = np.empty(n), np.empty((n, d)), np.empty((n, d, d))
    evaluate_points(
        tree_of(frames.skeleton), *frames.by_pose(), *frames.dofs_by_pose(), segments,
        *map(np.ascontiguousarray, (local, targets, across)), value, gradient, hessian,
    )  # fmt: skip
    return value, gradient, hessian


class Placing(NamedTuple):
    """The skeleton, for forward kinematics in compiled code.

    Attributes:
        parents: (S,) parent of each segment; -1: none.
        first_dofs: (S + 1,) index of the first degree of freedom of each segment.
        dof_axes, dof_is_rotation: (d,) axis and kind of each degree of freedom.
        mounts, offsets: (S, 3, 3), (S, 3) mounts and offsets of the segments, see `Skeleton`.
    """

    parents: NDArray[np.int64]
    first_dofs: NDArray[np.int64]
    dof_axes: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]
    mounts: Array
    offsets: Array


@lru_cache(maxsize=16)
def placing_of(skeleton: Skeleton) -> Placing:
    """The skeleton as compiled code reads it."""
    counts = [len(own) for own in skeleton.segment_dofs]
    return Placing(
        np.array(skeleton.parents, dtype=np.int64),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.array(skeleton.dof_axes, dtype=np.int64),
        np.array(skeleton.dof_is_rotation),
        np.ascontiguousarray(skeleton.mounts, dtype=np.float64),
        np.ascontiguousarray(skeleton.offsets, dtype=np.float64),
    )


class Tree(NamedTuple):
    """The tree of the degrees of freedom, for compiled code.

    Attributes:
        parents: (S,) parent of each segment; -1: none.
        dof_segments: (d,) segment of each degree of freedom.
        dof_parents: (d,) previous degree of freedom on the path from the root; -1: none.
        dof_is_rotation: (d,).
    """

    parents: NDArray[np.int64]
    dof_segments: NDArray[np.int64]
    dof_parents: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]


@lru_cache(maxsize=16)
def tree_of(skeleton: Skeleton) -> Tree:
    """The skeleton as compiled code reads it."""
    last_of: list[int] = []  # the last degree of freedom on the path to each segment
    before = np.full(skeleton.dimension, -1)
    for segment, parent in enumerate(skeleton.parents):
        last = last_of[parent] if parent >= 0 else -1
        for dof in skeleton.segment_dofs[segment]:
            before[dof] = last
            last = dof
        last_of.append(last)
    return Tree(
        np.array(skeleton.parents, dtype=np.int64),
        np.array(skeleton.dof_segments, dtype=np.int64),
        before.astype(np.int64),
        np.array(skeleton.dof_is_rotation),
    )
