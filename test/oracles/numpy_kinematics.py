"""Energies over points of the body in vectorised numpy: what `evaluate_points` is tested against.

A small motion of a segment is a twist (v, w): the point p moves by v + w x p. A residual whose
derivative with respect to its point is a has b = (a, p x a) with respect to the twist. Summed from
the leaves to the root, g b and k b b^T give

    g_j = s_j . F_j,    H_ij = s_i . K_j s_j    for i on the path from the root to j,

with s_j the twist of degree of freedom j and F_j, K_j the sums over all that j moves.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from hmt_ros.body.kinematics import Frames
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array, Index


def twists(frames: Frames) -> Array:
    """Twists (d, 6, N) of the degrees of freedom: velocity of the point at the camera, rotation."""
    rotation = frames.skeleton.dof_is_rotation[:, None, None]
    result = np.empty((frames.skeleton.dimension, 6, frames.count))
    result[:, :3] = np.where(
        rotation, np.cross(frames.dof_origins, frames.axes, axis=1), frames.axes
    )
    result[:, 3:] = np.where(rotation, frames.axes, 0.0)
    return result


def segment_sums(
    segments: Index, points: Array, directions: Array, pull: Array, curvature: Array, count: int
) -> tuple[Array, Array]:
    """Sums of g b and k b b^T per segment, for residuals at points that stay on their segments.

    Args:
        segments: (M,) segment of each residual.
        points: (M, 3, N) point of each residual, camera frame, m.
        directions: (M, 3, N) derivative a of the residual with respect to its point.
        pull: (M, N) derivative g of the energy with respect to the residual.
        curvature: (M, N) second derivative k, not negative.
        count: number of segments, S.

    Returns:
        wrenches (S, 6, N) and stiffnesses (S, 6, 6, N), for `assemble`.
    """
    n = points.shape[-1]
    b = np.concatenate([directions, np.cross(points, directions, axis=1)], axis=1)
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
        frames: frames of the poses.
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
    every = twists(frames)
    segments = skeleton.dof_segments
    gradient = np.einsum('jan,jan->nj', every, force[segments])
    pushed = np.einsum('jabn,jbn->jan', stiffness[segments], every)
    rows, cols = _coupled_pairs(skeleton)
    values = np.einsum('pan,pan->np', every[rows], pushed[cols])
    hessian = np.zeros((frames.count, skeleton.dimension, skeleton.dimension))
    hessian[:, rows, cols] = values
    hessian[:, cols, rows] = values
    return gradient, hessian


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
