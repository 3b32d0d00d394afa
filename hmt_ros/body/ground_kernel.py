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
def add_ground_energy(c, columns, origins, axes, dof_origins, wanted, gradient, hessian):  # type: ignore[no-untyped-def]
    """The terms of one pose; adds their derivatives.

    Args:
        c: the constants.
        columns, origins: (S, 3, 3), (S, 3) frames of the segments.
        axes, dof_origins: (d, 3) of the degrees of freedom.
        wanted: whether derivatives are wanted.
        gradient, hessian: (d,), (d, d) are added to.
    """
    row = np.zeros(len(axes))
    total = 0.0
    if c.weights[0] > 0:
        total += _upright(c, columns, axes, row, wanted, gradient, hessian)
    if c.weights[1] > 0:
        total += _floor(c, columns, origins, axes, dof_origins, row, wanted, gradient, hessian)
    return total


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
def _upright(c, columns, axes, row, wanted, gradient, hessian):  # type: ignore[no-untyped-def]
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
            _add(row, k * residual[i], k, gradient, hessian)
    return total


@njit(cache=True, nogil=True)
def _floor(c, columns, origins, axes, dof_origins, row, wanted, gradient, hessian):  # type: ignore[no-untyped-def]
    total = 0.0
    up, place = c.up, np.empty(3)
    for p in range(len(c.soles)):
        s = c.soles[p]
        for k in range(3):
            place[k] = origins[s, k]
            for i in range(3):
                place[k] += c.local[p, i] * columns[s, i, k]
        r = (up[0] * place[0] + up[1] * place[1] + up[2] * place[2] + c.height) * c.per_floor
        if r >= 0.0:
            continue
        value, factor = _student(r * r, c.floor_tails, 1.0)
        total += c.weights[1] * value
        if wanted:
            for j in range(len(row)):
                x, y, z = axes[j, 0], axes[j, 1], axes[j, 2]
                if c.dof_is_rotation[j]:
                    r0, r1 = place[0] - dof_origins[j, 0], place[1] - dof_origins[j, 1]
                    r2 = place[2] - dof_origins[j, 2]
                    x, y, z = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
                along = up[0] * x + up[1] * y + up[2] * z
                row[j] = c.per_floor * along if c.moves[s, j] else 0.0
            k = c.weights[1] * factor
            _add(row, k * r, k, gradient, hessian)
    return total
