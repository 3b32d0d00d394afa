"""Soft prior against parts of the body that run through each other (KJS 2).

Two parts overlap by the sum of their radii minus the distance of their axes, taken along the line
that connects the axes where they are nearest; the overlap is penalised quadratically.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.inference.arrays import Array, Index

TOLERANCE = 0.02  # m of overlap without cost: flesh is soft, and ellipsoids fit roughly
SMALL = 1e-9


class _Axes(NamedTuple):
    """The parts as capsules with elliptic cross-sections, as the compiled code reads them.

    Attributes:
        segments: (B,) that carry them.
        centres: (B, 3) of the axes in the segments' frames, m.
        halves: (B,) half lengths of the axes, m.
        radii: (B, 3) along x, y and, for the caps, z, m.
        reaches: (B,) from the middle to the farthest point, m.
    """

    segments: NDArray[np.int64]
    centres: Array
    halves: Array
    radii: Array
    reaches: Array


class Overlaps(NamedTuple):
    """Parts, the pairs (Q,) of them that may overlap, and the variables that move them.

    Attributes:
        parts: of the body.
        first, second: (Q,) of the pairs.
        dof_is_rotation, moves: (d,), (S, d) of the skeleton.
        sigma: overlap with energy 1/2, m.
    """

    parts: _Axes
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    sigma: float


@dataclass(frozen=True, eq=False)
class SelfIntersection:
    """The prior against parts of the body that run through each other.

    Its derivatives are those of the distance: that an elliptic cross-section turns is left out.

    Attributes:
        body: whose parts; those that are neighbours along the skeleton are left out.
        sigma: overlap that costs 1/2, m; inf: none costs anything.
    """

    body: Body
    sigma: float

    @property
    def compiled(self) -> Overlaps:
        """As compiled code reads it."""
        return overlaps_of(self.body, self.sigma)


@lru_cache(maxsize=16)
def overlaps_of(body: Body, sigma: float) -> Overlaps:
    """The parts of a body as compiled code reads them; sigma: overlap with energy 1/2, m."""
    first, second = _pairs(body)
    skeleton = body.skeleton
    return Overlaps(
        _axes_of(body),
        first.astype(np.int64),
        second.astype(np.int64),
        skeleton.dof_is_rotation,
        skeleton.moves,
        float(sigma),
    )


@lru_cache(maxsize=16)
def _axes_of(body: Body) -> _Axes:
    parts = body.flesh.parts
    radii = np.array([p.radii for p in parts]).reshape(-1, 3)
    mean = radii[:, :2].mean(1)
    halves = np.maximum(radii[:, 2] - mean, 0.0)
    return _Axes(
        np.array([p.segment for p in parts], dtype=np.int64),
        np.array([p.centre for p in parts]).reshape(-1, 3),
        halves,
        np.column_stack([radii[:, :2], mean]),
        halves + radii[:, :2].max(1, initial=0.0),
    )


@lru_cache(maxsize=16)
def _pairs(body: Body) -> tuple[Index, Index]:
    """Pairs of parts that are no neighbours along the skeleton and do not touch at rest."""
    parts = body.flesh.parts
    parents = body.skeleton.parents
    fleshy = {p.segment for p in parts}

    def fleshy_parent(s: int) -> int:
        """The nearest segment above that carries flesh."""
        step = parents[s]
        while step >= 0 and step not in fleshy:
            step = parents[step]
        return step

    pairs = []
    for i in range(len(parts)):
        for j in range(i + 1, len(parts)):
            a, b = parts[i].segment, parts[j].segment
            if a != b and fleshy_parent(a) != b and fleshy_parent(b) != a:
                pairs.append((i, j))
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    rest = body.prior_mean.copy()
    rest[~body.skeleton.dof_is_rotation] = 0.0
    (columns,), (origins,) = forward(body.skeleton, rest[None]).by_pose()
    axes = _axes_of(body)
    centres = np.empty((len(parts), 3))
    _place_centres(axes, columns, origins, centres)
    apart = [
        _overlap(axes, i, j, columns, centres)[9] < TOLERANCE
        for i, j in zip(first, second, strict=True)
    ]
    return first[apart], second[apart]


@njit(cache=True, nogil=True)
def _overlap(parts, i, j, columns, centres):  # type: ignore[no-untyped-def]
    """Nearest points p and q of the axes of two parts, the direction between, and the overlap.

    The axes are middle + s axis, s in [-1, 1]; all ten numbers are scalars, as small arrays would
    cost more than the arithmetic.
    """
    a, b = parts.segments[i], parts.segments[j]
    c0, c1, c2 = centres[i, 0], centres[i, 1], centres[i, 2]
    e0, e1, e2 = centres[j, 0], centres[j, 1], centres[j, 2]
    h, g = parts.halves[i], parts.halves[j]
    u0, u1, u2 = columns[a, 2, 0] * h, columns[a, 2, 1] * h, columns[a, 2, 2] * h
    v0, v1, v2 = columns[b, 2, 0] * g, columns[b, 2, 1] * g, columns[b, 2, 2] * g
    w0, w1, w2 = c0 - e0, c1 - e1, c2 - e2
    uu = u0 * u0 + u1 * u1 + u2 * u2
    uv = u0 * v0 + u1 * v1 + u2 * v2
    vv = v0 * v0 + v1 * v1 + v2 * v2
    uw = u0 * w0 + u1 * w1 + u2 * w2
    vw = v0 * w0 + v1 * w1 + v2 * w2
    s = min(max((uv * vw - vv * uw) / max(uu * vv - uv * uv, SMALL), -1.0), 1.0)
    t = min(max((uv * s + vw) / max(vv, SMALL), -1.0), 1.0)
    s = min(max((uv * t - uw) / max(uu, SMALL), -1.0), 1.0)
    p0, p1, p2 = c0 + s * u0, c1 + s * u1, c2 + s * u2
    q0, q1, q2 = e0 + t * v0, e1 + t * v1, e2 + t * v2
    d0, d1, d2 = p0 - q0, p1 - q1, p2 - q2
    distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    away = max(distance, SMALL)
    d0, d1, d2 = d0 / away, d1 / away, d2 / away
    reach = _width(parts, i, columns, d0, d1, d2) + _width(parts, j, columns, d0, d1, d2)
    return p0, p1, p2, q0, q1, q2, d0, d1, d2, reach - distance


@njit(cache=True, nogil=True, inline='always')
def _width(parts, i, columns, d0, d1, d2):  # type: ignore[no-untyped-def]
    """How far a part reaches from its axis along a unit vector."""
    s = parts.segments[i]
    total = 0.0
    for k in range(3):
        x = columns[s, k, 0] * d0 + columns[s, k, 1] * d1 + columns[s, k, 2] * d2
        x *= parts.radii[i, k]
        total += x * x
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def _place_centres(parts, columns, origins, centres):  # type: ignore[no-untyped-def]
    """Fills the middles (B, 3) of the parts in the camera frame."""
    for i in range(len(parts.segments)):
        s = parts.segments[i]
        for x in range(3):
            total = 0.0
            for k in range(3):
                total += columns[s, k, x] * parts.centres[i, k]
            centres[i, x] = total + origins[s, x]


@njit(cache=True, nogil=True, inline='always')
def _far(parts, i, j, centres):  # type: ignore[no-untyped-def]
    """Whether two parts are too far from each other to overlap by more than is allowed."""
    x = centres[i, 0] - centres[j, 0]
    y = centres[i, 1] - centres[j, 1]
    z = centres[i, 2] - centres[j, 2]
    reach = parts.reaches[i] + parts.reaches[j] - TOLERANCE
    return x * x + y * y + z * z > reach * reach


@njit(cache=True, nogil=True)
def add_overlaps(  # type: ignore[no-untyped-def]
    overlaps, columns, origins, dof_axes, dof_origins, wanted, value, gradient, hessian
):
    """Adds energy (1,), gradient (d,) and Gauss-Newton Hessian (d, d) of one pose.

    Args:
        overlaps: pairs of parts.
        columns, origins: (S, 3, 3), (S, 3) frames of the segments.
        dof_axes, dof_origins: (d, 3) of the degrees of freedom.
        wanted: whether derivatives are wanted.
        value, gradient, hessian: added to.
    """
    parts, first, second, sigma = overlaps.parts, overlaps.first, overlaps.second, overlaps.sigma
    is_rotation, moves = overlaps.dof_is_rotation, overlaps.moves
    d = len(dof_axes)
    row = np.zeros(d)
    centres = np.empty((len(parts.segments), 3))
    _place_centres(parts, columns, origins, centres)
    for pair in range(len(first)):
        i, j = first[pair], second[pair]
        if _far(parts, i, j, centres):
            continue
        p0, p1, p2, q0, q1, q2, d0, d1, d2, depth = _overlap(parts, i, j, columns, centres)
        overlap = (depth - TOLERANCE) / sigma
        if overlap <= 0.0:
            continue
        value[0] += 0.5 * overlap * overlap
        if not wanted:
            continue
        a, b = parts.segments[i], parts.segments[j]
        for k in range(d):
            moved = 0.0
            x0, x1, x2 = dof_axes[k, 0], dof_axes[k, 1], dof_axes[k, 2]
            if not is_rotation[k]:
                along = x0 * d0 + x1 * d1 + x2 * d2
                if moves[a, k]:
                    moved += along
                if moves[b, k]:
                    moved -= along
            else:
                o0, o1, o2 = dof_origins[k, 0], dof_origins[k, 1], dof_origins[k, 2]
                # direction . (axis x arm) = axis . (arm x direction)
                if moves[a, k]:
                    r0, r1, r2 = p0 - o0, p1 - o1, p2 - o2
                    moved += x0 * (r1 * d2 - r2 * d1) + x1 * (r2 * d0 - r0 * d2)
                    moved += x2 * (r0 * d1 - r1 * d0)
                if moves[b, k]:
                    r0, r1, r2 = q0 - o0, q1 - o1, q2 - o2
                    moved -= x0 * (r1 * d2 - r2 * d1) + x1 * (r2 * d0 - r0 * d2)
                    moved -= x2 * (r0 * d1 - r1 * d0)
            row[k] = -moved / sigma
        for k in range(d):
            if row[k] == 0.0:
                continue
            gradient[k] += overlap * row[k]
            for m in range(d):
                hessian[k, m] += row[k] * row[m]
