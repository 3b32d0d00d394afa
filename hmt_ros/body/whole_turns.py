"""Angles without limits, which are the same after a whole turn.

A person who turns about passes the angle at which it is cut, and of two estimates of one heading
one may be a turn ahead. Whoever compares poses by their variables has to take turns out first.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.inference.arrays import Array, Mask

TURN = 2.0 * np.pi


def endless(body: Body) -> Mask:
    """The variables (d,) that are angles and go round: their limits are a turn apart, or more."""
    return np.asarray(body.skeleton.dof_is_rotation & (body.upper - body.lower >= TURN))


def free_limits(body: Body) -> tuple[Array, Array]:
    """Limits (d,) of poses in any frame: the place and the turns of the root have none."""
    free = endless(body)
    free[:3] = True
    return np.where(free, -np.inf, body.lower), np.where(free, np.inf, body.upper)


def without_turns(body: Body, poses: Array, before: Array) -> Array:
    """Poses (K, d) whose angles are within half a turn of the nearest pose before (L, d).

    The nearest one is that whose joints, relative to the first, are nearest in the mean: joints do
    not change with whole turns.
    """
    joints, known = (body.relative_joints(x) for x in (poses, before))
    nearest = np.linalg.norm(joints[:, None] - known, axis=3).mean(2).argmin(1)
    turns = np.round((before[nearest] - poses) / TURN)
    return np.asarray(poses + TURN * np.where(endless(body), turns, 0.0))
