"""Iterative inverse kinematics: poses that move joints to target positions (KJS 3.2).

Bounded damped Newton minimises the squared distances of the joints from their targets, with hard
limits and the soft prior. Procedural motions use it for arms and legs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward, point_energy
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.inference.energy import EnergyFunction, Quadratic, Sum


def solve_joint_positions(
    body: Body,
    poses: ArrayLike,
    targets: ArrayLike,
    joint_names: Sequence[str] | None = None,
    *,
    sigma: ArrayLike = 0.01,
    prior_weight: float = 1e-3,
    free_dofs: Sequence[str] | None = None,
    along_rays: bool = False,
    max_iterations: int = 60,
    tolerance: float = 1e-6,
) -> Minimum:
    """Poses nearest to given joint positions, for a batch of N problems.

    Minimises

        1/2 sum |joint - target|^2 / sigma^2 + prior_weight / 2 sum ((x - mean) / prior sigma)^2.

    Args:
        poses: (N, d) initial poses.
        targets: (N, J', 3) target positions, camera frame, m; NaN for a joint without a target.
        joint_names: (J',) names of the joints of the targets; None selects all joints.
        sigma: standard deviation of the targets, scalar, (J',) or (N, J'), m.
        free_dofs: names of the degrees of freedom that may change; None selects all.
        along_rays: whether to use only the distance of a joint from the ray through its target.
    """
    skeleton = body.skeleton
    names = skeleton.joint_names if joint_names is None else tuple(joint_names)
    which = skeleton.joint_index(names)
    start = np.array(poses, dtype=np.float64, ndmin=2)
    goal = np.asarray(targets, dtype=np.float64)
    if goal.shape != (len(start), len(names), 3):
        raise ValueError(f'targets have shape {goal.shape}, wanted {(len(start), len(names), 3)}')
    known = np.asarray(np.isfinite(goal).all(2), dtype=np.bool_)
    weight = np.where(known, 1.0 / np.broadcast_to(np.asarray(sigma), known.shape), 0.0)
    goal = np.where(known[..., None], goal, 0.0)
    precision = (
        prior_weight * np.where(np.isfinite(body.prior_sigma), body.prior_sigma, np.inf) ** -2
    )
    lower, upper = np.array(body.lower), np.array(body.upper)
    limits_low, limits_high = np.tile(lower, (len(start), 1)), np.tile(upper, (len(start), 1))
    if free_dofs is not None:
        frozen = np.setdiff1d(np.arange(body.dimension), skeleton.dof_index(tuple(free_dofs)))
        limits_low[:, frozen] = limits_high[:, frozen] = start[:, frozen]
    segments, offsets = skeleton.joint_segments[which], skeleton.joint_offsets[which]
    across = weight[..., None, None] * np.eye(3)
    if along_rays:
        rays = goal / np.maximum(np.linalg.norm(goal, axis=2, keepdims=True), 1e-12)
        across -= weight[..., None, None] * rays[..., :, None] * rays[..., None, :]

    def distances(x: Array, problem: Index) -> tuple[Array, Array, Array]:
        return point_energy(forward(skeleton, x), segments, offsets, goal[problem], across[problem])

    energy = Sum((EnergyFunction(distances), Quadratic(body.prior_mean, precision)))
    return minimise(
        energy,
        start,
        limits_low,
        limits_high,
        step_scale=np.where(skeleton.dof_is_rotation, 0.5, 0.3),
        damping=1.0,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )
