"""Robust residuals at points of the body, and their gradient and Hessian over the pose.

    rho(r) = 1/2 w r^2 / (1 + r^2 / c^2)                                       Geman-McClure (KJS 2)

A residual at the point p of a segment has a derivative a with respect to the point. A small motion
of the segment is a twist (v, w) that moves p by v + w x p, so the residual adds `g b` and
`k b b^T` to its segment, b = (a, p x a), g the derivative and k the curvature of rho. Sums over the
segments that a degree of freedom moves give its row of the gradient and of the Hessian. It is the
compiled counterpart of `body.kinematics.segment_sums` and `assemble`, one pose at a time.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.skeleton import Skeleton


class Tree(NamedTuple):
    """The skeleton as the compiled code reads it.

    Attributes:
        parents: (S,) segment above; -1: none.
        dof_segments: (d,) segment of each degree of freedom.
        dof_parents: (d,) the degree of freedom before it on the path from the root; -1: none.
        dof_is_rotation: (d,).
    """

    parents: NDArray[np.int64]
    dof_segments: NDArray[np.int64]
    dof_parents: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]


@lru_cache(maxsize=16)
def tree_of(skeleton: Skeleton) -> Tree:
    """The compiled code's view of a skeleton."""
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


@njit(cache=True, nogil=True, inline='always')
def geman_mcclure(residual, scale, weight):  # type: ignore[no-untyped-def]
    """Geman-McClure kernel: value, derivative and Gauss-Newton curvature.

        rho(r) = 1/2 w r^2 / (1 + r^2 / c^2)

    Quadratic near zero, at most w c^2 / 2. The curvature is the weight rho'(r) / r of iteratively
    reweighted least squares, which is positive everywhere.

    Args:
        residual: r, in standard deviations.
        scale: c, in standard deviations.
        weight: w, factor on the energy.
    """
    square = residual * residual
    shrink = 1.0 / (1.0 + square / (scale * scale))
    curvature = weight * shrink * shrink
    return 0.5 * weight * square * shrink, curvature * residual, curvature


@njit(cache=True, nogil=True, inline='always')
def contour_sigma(term, noise):  # type: ignore[no-untyped-def]
    """Standard deviation of a contour point, px, whose noise on the body is given in m."""
    blur = term.magnification * noise
    return np.sqrt(term.sigma * term.sigma + blur * blur)


# Fewer visible points than this do not make each of them count more.
FEWEST = 20


@njit(cache=True, nogil=True)
def weight_of_each(weight, shared, valid, hidden):  # type: ignore[no-untyped-def]
    """A weight shared among so many points; 0: among those that are valid and not hidden."""
    count = shared
    if count == 0:
        for i in range(len(valid)):
            if valid[i] and not hidden[i]:
                count += 1
    return weight / max(count, FEWEST)


# Columns of a list of residuals: segment, point (3), derivative (3), pull, curvature.
RECORDED = 9


@njit(cache=True, nogil=True, inline='always')
def add_residual(wrenches, stiffnesses, s, p0, p1, p2, a0, a1, a2, pull, curvature):  # type: ignore[no-untyped-def]
    """Adds a residual at the point p with derivative a to segment s.

    Everything is a scalar: a small array a call would cost more than the arithmetic. Wrenches with
    the columns `RECORDED` are a list of residuals instead of sums: entry (0, 0) counts them.
    Wrenches of no segment: no derivatives are wanted.
    """
    if len(wrenches) == 0:
        return
    if wrenches.shape[1] == RECORDED:
        n = int(wrenches[0, 0]) + 1
        if n < len(wrenches):
            wrenches[0, 0] = n
            wrenches[n, 0] = s
            wrenches[n, 1], wrenches[n, 2], wrenches[n, 3] = p0, p1, p2
            wrenches[n, 4], wrenches[n, 5], wrenches[n, 6] = a0, a1, a2
            wrenches[n, 7], wrenches[n, 8] = pull, curvature
        return
    b = (a0, a1, a2, p1 * a2 - p2 * a1, p2 * a0 - p0 * a2, p0 * a1 - p1 * a0)
    for i in range(6):
        wrenches[s, i] += pull * b[i]
        c = curvature * b[i]
        for j in range(i, 6):
            stiffnesses[s, i, j] += c * b[j]


@njit(cache=True, nogil=True, inline='always')
def add_contour_residual(  # type: ignore[no-untyped-def]
    wrenches, stiffnesses, s, p, j, i, gu, gv, pull, curvature
):
    """Adds a residual of the pixel of contour point i to segment s.

    p and j are the points and projections of the contour, gu and gv the derivatives of the residual
    by column and row.
    """
    add_residual(
        wrenches,
        stiffnesses,
        s,
        p[i, 0],
        p[i, 1],
        p[i, 2],
        gu * j[i, 0, 0] + gv * j[i, 1, 0],
        gu * j[i, 0, 1] + gv * j[i, 1, 1],
        gu * j[i, 0, 2] + gv * j[i, 1, 2],
        pull,
        curvature,
    )


@njit(cache=True, nogil=True)
def assemble_pose(tree, axes, dof_origins, wrenches, stiffnesses, gradient, hessian):  # type: ignore[no-untyped-def]
    """Gradient (d,) and Hessian (d, d) of one pose; overwrites the sums of the segments.

    Args:
        tree: the skeleton.
        axes, dof_origins: (d, 3) of the degrees of freedom, camera frame.
        wrenches: (S, 6) sums of g b.
        stiffnesses: (S, 6, 6) sums of k b b^T, upper triangle.
        gradient, hessian: results, added to.
    """
    count = len(tree.parents)
    d = len(tree.dof_segments)
    for s in range(count - 1, 0, -1):
        parent = tree.parents[s]
        if parent >= 0:
            for i in range(6):
                wrenches[parent, i] += wrenches[s, i]
                for j in range(i, 6):
                    stiffnesses[parent, i, j] += stiffnesses[s, i, j]
    for s in range(count):
        for i in range(6):
            for j in range(i):
                stiffnesses[s, i, j] = stiffnesses[s, j, i]
    twists = np.zeros((d, 6))
    for j in range(d):
        if tree.dof_is_rotation[j]:
            o0, o1, o2 = dof_origins[j, 0], dof_origins[j, 1], dof_origins[j, 2]
            w0, w1, w2 = axes[j, 0], axes[j, 1], axes[j, 2]
            twists[j, 0] = o1 * w2 - o2 * w1
            twists[j, 1] = o2 * w0 - o0 * w2
            twists[j, 2] = o0 * w1 - o1 * w0
            twists[j, 3], twists[j, 4], twists[j, 5] = w0, w1, w2
        else:
            for i in range(3):
                twists[j, i] = axes[j, i]
    pushed = np.empty(6)
    for j in range(d):
        s = tree.dof_segments[j]
        for i in range(6):
            total = 0.0
            for k in range(6):
                total += stiffnesses[s, i, k] * twists[j, k]
            pushed[i] = total
            gradient[j] += wrenches[s, i] * twists[j, i]
        i = j
        while i >= 0:
            total = 0.0
            for k in range(6):
                total += twists[i, k] * pushed[k]
            hessian[i, j] += total
            if i != j:
                hessian[j, i] += total
            i = tree.dof_parents[i]
