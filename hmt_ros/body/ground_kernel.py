"""The compiled energy of `ground_terms`, one pose at a time.

Every residual r with the derivative J over the pose adds `g J` to the gradient and `k J J^T` to the
Hessian, g the derivative and k the curvature of its robust cost as in iteratively reweighted least
squares; only the degrees of freedom that move its points have a part in J.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array


class Constants(NamedTuple):
    """Inputs that do not depend on the pose.

    Attributes:
        dof_is_rotation: (d,).
        moves: (S, d) whether a degree of freedom moves a segment.
        weights: (2,) of the terms: upright, floor; 0: off.
        up: (3,) against gravity.
        height: of the camera over the floor, m.
        upright: (U,) segments that are upright.
        axes: (U, 3, 3) their axes: to the side, ahead, up.
        lean: (U, 3) deviations of gravity along these, rad.
        soles: (P,) segments of the points of the soles.
        local: (P, 3) their places there, m.
        per_floor: 1 / deviation of the height of the floor, 1/m.
        lean_tails, floor_tails: degrees of freedom of the robust costs.
    """

    dof_is_rotation: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    weights: Array
    up: Array
    height: float
    upright: NDArray[np.int64]
    axes: Array
    lean: Array
    soles: NDArray[np.int64]
    local: Array
    per_floor: float
    lean_tails: float
    floor_tails: float


@njit(cache=True, nogil=True)
def add_ground_energies(  # type: ignore[no-untyped-def]
    c,
    columns,
    origins,
    axes,
    dof_origins,
    terms,
    gradient,
    hessian,
):
    """Adds the terms of N poses.

    Args:
        c: the constants.
        columns, origins: (N, S, 3, 3), (N, S, 3) frames of the segments.
        axes, dof_origins: (N, d, 3) of the degrees of freedom.
        terms: (N, 2) is added to.
        gradient, hessian: (N, d), (N, d, d) are added to; of no length: not wanted.
    """
    count, d, points = len(columns), axes.shape[1], len(c.soles)
    wanted = len(gradient) > 0
    place = np.zeros((points, 3))
    moved = np.zeros((points, 3, d))
    row = np.zeros(d)
    for n in range(count):
        if c.weights[0] > 0:
            terms[n, 0] += _upright(c, columns[n], axes[n], row, n, wanted, gradient, hessian)
        if c.weights[1] == 0:
            continue
        for p in range(points):
            s = c.soles[p]
            for k in range(3):
                place[p, k] = origins[n, s, k]
                for i in range(3):
                    place[p, k] += c.local[p, i] * columns[n, s, i, k]
            if wanted:
                _move(c.moves[s], c.dof_is_rotation, axes[n], dof_origins[n], place[p], moved[p])
        terms[n, 1] += _floor(c, place, moved, row, n, wanted, gradient, hessian)


@njit(cache=True, nogil=True)
def _move(moves, is_rotation, axes, origins, point, result):  # type: ignore[no-untyped-def]
    """Derivative (3, d) of a point by the degrees of freedom that move it."""
    for j in range(len(moves)):
        if not moves[j]:
            for k in range(3):
                result[k, j] = 0.0
        elif is_rotation[j]:
            x, y, z = point[0] - origins[j, 0], point[1] - origins[j, 1], point[2] - origins[j, 2]
            result[0, j] = axes[j, 1] * z - axes[j, 2] * y
            result[1, j] = axes[j, 2] * x - axes[j, 0] * z
            result[2, j] = axes[j, 0] * y - axes[j, 1] * x
        else:
            for k in range(3):
                result[k, j] = axes[j, k]


@njit(cache=True, nogil=True)
def _add(row, pull, curvature, gradient, hessian):  # type: ignore[no-untyped-def]
    """Adds g J and k J J^T for the derivative J (d,) of a residual."""
    d = len(row)
    for i in range(d):
        if row[i] != 0.0:
            gradient[i] += pull * row[i]
            scaled = curvature * row[i]
            for j in range(d):
                hessian[i, j] += scaled * row[j]


@njit(cache=True, nogil=True, inline='always')
def _student(square, tails, dimension):  # type: ignore[no-untyped-def]
    """Value at r^2, and the factor s so that s r is the derivative and s the curvature."""
    value = 0.5 * (tails + dimension) * np.log1p(square / tails)
    return value, (tails + dimension) / (tails + square)


@njit(cache=True, nogil=True)
def _upright(c, columns, axes, row, n, wanted, gradient, hessian):  # type: ignore[no-untyped-def]
    total = 0.0
    axis, residual = np.empty((3, 3)), np.empty(3)
    for u in range(len(c.upright)):
        s, square = c.upright[u], 0.0
        for i in range(3):
            along = 0.0
            for k in range(3):
                axis[i, k] = 0.0
                for m in range(3):
                    axis[i, k] += c.axes[u, i, m] * columns[s, m, k]
                along += axis[i, k] * c.up[k]
            residual[i] = (along - (1.0 if i == 2 else 0.0)) / c.lean[u, i]
            square += residual[i] * residual[i]
        value, factor = _student(square, c.lean_tails, 2.0)
        total += c.weights[0] * value
        if not wanted:
            continue
        for i in range(3):
            # An axis e that turns by w moves e . up by w . (e x up).
            x = axis[i, 1] * c.up[2] - axis[i, 2] * c.up[1]
            y = axis[i, 2] * c.up[0] - axis[i, 0] * c.up[2]
            z = axis[i, 0] * c.up[1] - axis[i, 1] * c.up[0]
            for j in range(len(row)):
                row[j] = 0.0
                if c.moves[s, j] and c.dof_is_rotation[j]:
                    row[j] = (axes[j, 0] * x + axes[j, 1] * y + axes[j, 2] * z) / c.lean[u, i]
            k = c.weights[0] * factor
            _add(row, k * residual[i], k, gradient[n], hessian[n])
    return total


@njit(cache=True, nogil=True, inline='always')
def _height(up, height, point):  # type: ignore[no-untyped-def]
    return up[0] * point[0] + up[1] * point[1] + up[2] * point[2] + height


@njit(cache=True, nogil=True, inline='always')
def _project(direction, moved, factor, row):  # type: ignore[no-untyped-def]
    """Derivative of a point along a direction, times a factor."""
    for j in range(len(row)):
        row[j] = factor * (
            direction[0] * moved[0, j] + direction[1] * moved[1, j] + direction[2] * moved[2, j]
        )


@njit(cache=True, nogil=True)
def _floor(c, place, moved, row, n, wanted, gradient, hessian):  # type: ignore[no-untyped-def]
    total = 0.0
    for p in range(len(place)):
        r = _height(c.up, c.height, place[p]) * c.per_floor
        if r >= 0.0:
            continue
        value, factor = _student(r * r, c.floor_tails, 1.0)
        total += c.weights[1] * value
        if wanted:
            _project(c.up, moved[p], c.per_floor, row)
            k = c.weights[1] * factor
            _add(row, k * r, k, gradient[n], hessian[n])
    return total
