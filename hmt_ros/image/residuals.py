"""Image residuals at points of the body, and the robust kernel that they pass through.

Every likelihood term is a sum of k rho(r / sigma) over residuals r whose derivative with respect to a
3D point of the body is known; `Energy` carries these until they are assembled into a gradient and a
Gauss-Newton Hessian over the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.kinematics import Frames, assemble, segment_sums

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Energy:
    """One term of the negative log-likelihood for N poses, as residuals at points of the body.

    Attributes:
        value: (N,) the energy.
        segments: (M,) segment of each residual's point, or (M, N) where it differs from pose to pose.
        points: (M, 3, N) camera frame, m.
        directions: (M, 3, N) derivative of the residual with respect to its point.
        pull: (M, N) derivative of the energy with respect to the residual.
        curvature: (M, N) its second derivative, Gauss-Newton, not negative.
        each: (M', N) what every measurement costs, where the term knows.
    """

    value: Array
    segments: Index
    points: Array
    directions: Array
    pull: Array
    curvature: Array
    each: Array | None = None


def robust(
    residual: Array, scale: float, weight: Array | float = 1.0
) -> tuple[Array, Array, Array]:
    """Geman-McClure kernel: values, derivatives and Gauss-Newton curvatures.

        rho(r) = 1/2 r^2 / (1 + r^2 / c^2)

    Quadratic near zero, at most c^2 / 2. The curvature is the weight rho'(r) / r of iteratively
    reweighted least squares, which is positive everywhere.

    Args:
        residual: in standard deviations.
        scale: c, in standard deviations; inf: least squares.
        weight: factor on the energy.
    """
    square = residual * residual
    shrink = 1.0 / (1.0 + square / (scale * scale))
    curvature = weight * shrink * shrink
    return 0.5 * weight * square * shrink, curvature * residual, curvature


def assemble_energies(frames: Frames, energies: Sequence[Energy]) -> tuple[Array, Array, Array]:
    """Value (N,), gradient (N, d) and Hessian (N, d, d) of a sum of terms."""
    count = len(frames.skeleton.parents)
    value = np.zeros(frames.count)
    wrenches = np.zeros((count, 6, frames.count))
    stiffnesses = np.zeros((count, 6, 6, frames.count))
    for e in energies:
        value += e.value
        force, stiffness = segment_sums(
            e.segments, e.points, e.directions, e.pull, e.curvature, count
        )
        wrenches += force
        stiffnesses += stiffness
    return value, *assemble(frames, wrenches, stiffnesses)
