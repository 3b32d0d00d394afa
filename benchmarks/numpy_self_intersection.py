"""Self-intersection in vectorised numpy, as `hmt_ros.body.self_intersection` compiles it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames
from hmt_ros.body.self_intersection import TOLERANCE, _pairs

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def self_intersection_energy(
    body: Body, frames: Frames, *, sigma: float = 0.02
) -> tuple[Array, Array, Array]:
    """As `hmt_ros.body.self_intersection.self_intersection_energy`, of the same pairs of parts."""
    first, second = _pairs(body)
    n, d = frames.count, body.dimension
    if len(first) == 0:
        return np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
    segments = np.array([p.segment for p in body.flesh.parts])
    p, q, direction, depth = _overlaps(body, frames, first, second)
    overlap = (depth - TOLERANCE) / sigma
    touching = overlap > 0
    value = 0.5 * np.where(touching, overlap * overlap, 0.0).sum(0)
    gradient, hessian = np.zeros((n, d)), np.zeros((n, d, d))
    pairs, poses = np.nonzero(touching)
    if len(pairs):
        moved = _relative_motion(
            frames, segments[first[pairs]], segments[second[pairs]],
            p[pairs, :, poses], q[pairs, :, poses], direction[pairs, :, poses], poses,
        )  # fmt: skip
        rows = -moved / sigma  # derivative of the overlap with respect to the pose, (X, d)
        np.add.at(gradient, poses, overlap[pairs, poses][:, None] * rows)
        np.add.at(hessian, poses, rows[:, :, None] * rows[:, None, :])
    return value, gradient, hessian


def _overlaps(
    body: Body, frames: Frames, first: Index, second: Index
) -> tuple[Array, Array, Array, Array]:
    """Nearest points of pairs of parts and the direction between, (X, 3, N); overlap (X, N)."""
    segments = np.array([p.segment for p in body.flesh.parts])
    radii = np.array([p.radii for p in body.flesh.parts])
    # The axis of a capsule of the part's length.
    half = np.maximum(radii[:, 2] - radii[:, :2].mean(1), 0.0)
    middle = frames.points(segments, np.array([p.centre for p in body.flesh.parts]))
    axis = frames.columns[segments, 2] * half[:, None, None]
    p, q = _nearest_points(middle, axis, first, second)
    offset = p - q
    distance = np.sqrt((offset * offset).sum(1))
    direction = offset / np.maximum(distance, 1e-9)[:, None]
    reach = _radius_along(frames, segments, radii, first, direction)
    reach += _radius_along(frames, segments, radii, second, direction)
    return p, q, direction, reach - distance


def _nearest_points(middle: Array, axis: Array, first: Index, second: Index) -> tuple[Array, Array]:
    """Nearest points (X, 3, N) of the axes middle + s axis, s in [-1, 1], of pairs of parts."""
    c1, c2, u, v = middle[first], middle[second], axis[first], axis[second]
    w = c1 - c2
    a, b, c = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    d, e = (u * w).sum(1), (v * w).sum(1)
    small = 1e-9
    denominator = np.maximum(a * c - b * b, small)
    s = np.clip((b * e - c * d) / denominator, -1.0, 1.0)
    t = np.clip((b * s + e) / np.maximum(c, small), -1.0, 1.0)
    s = np.clip((b * t - d) / np.maximum(a, small), -1.0, 1.0)
    return c1 + s[:, None] * u, c2 + t[:, None] * v


def _radius_along(
    frames: Frames, segments: Index, radii: Array, parts: Index, direction: Array
) -> Array:
    """Extent (X, N) of the cross-section of parts along directions (X, 3, N)."""
    columns = frames.columns[segments[parts]]
    x = (columns[:, 0] * direction).sum(1) * radii[parts, 0][:, None]
    y = (columns[:, 1] * direction).sum(1) * radii[parts, 1][:, None]
    z = (columns[:, 2] * direction).sum(1) * radii[parts, :2].mean(1)[:, None]
    result: Array = np.sqrt(x * x + y * y + z * z)
    return result


def _relative_motion(
    frames: Frames, first: Index, second: Index, p: Array, q: Array, direction: Array, poses: Index
) -> Array:
    """Derivative (X, d) of direction . (p - q) with respect to the poses."""
    moves = frames.skeleton.moves
    twists = frames.twists().transpose(2, 0, 1)[poses]  # (X, d, 6)
    at_p = np.concatenate([direction, np.cross(p, direction)], axis=1)
    at_q = np.concatenate([direction, np.cross(q, direction)], axis=1)
    result: Array = np.einsum('xda,xa->xd', twists, at_p) * moves[first]
    result -= np.einsum('xda,xa->xd', twists, at_q) * moves[second]
    return result
