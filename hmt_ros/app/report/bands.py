"""Heights of joints and angles over time, with the intervals that hold 90 % of a mixture."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import ndtr

from hmt_ros.body import Body
from hmt_ros.inference.arrays import Array
from msg_tools.messages.ground import GroundState
from msg_tools.messages.pose_mixtures import PoseMixture

# Ends and middle of an interval that holds 90 %.
PROBABILITIES = np.array([0.05, 0.5, 0.95])
# Above a camera that is level.
_LEVEL = np.array([0.0, -1.0, 0.0, 0.0])
_HALVINGS = 22


def angles_of(body: Body | None) -> tuple[str, ...]:
    """Names of the angles of a body; none of a body that is not known."""
    if body is None:
        return ()
    return tuple(body.dof_names[i] for i in np.flatnonzero(body.skeleton.dof_is_rotation))


def ground_at(grounds: Mapping[int, GroundState], stamp_ns: int) -> GroundState | None:
    """What is known of the floor at a time, or else at the first time of all; None: nothing."""
    return grounds.get(stamp_ns) or next(iter(grounds.values()), None)


def heights_of(joints: Array, ground: GroundState | None) -> Array:
    """Heights (...,) of positions (..., 3): above the floor, or above a level camera, m."""
    plane = None if ground is None else ground.plane
    plane = _LEVEL if plane is None else plane
    return np.asarray(joints @ plane[:3] + plane[3], dtype=np.float64)


def marginals_of(content: PoseMixture, body: Body | None, ground: GroundState | None) -> Array:
    """What each component says of heights of joints, m, and of angles, degrees.

    Returns:
        (2, K, J + A) means and standard deviations; (2, K, 0) where a covariance is not known.
    """
    covariances, spread = content.covariances, content.joint_covariances
    if covariances is None or spread is None:
        return np.empty((2, len(content.weights), 0))
    plane = None if ground is None else ground.plane
    up = (_LEVEL if plane is None else plane)[:3]
    sigmas = np.sqrt(np.einsum('i,kjil,l->kj', up, spread, up))
    result = [np.stack([heights_of(content.joint_positions, ground), sigmas])]
    if body is not None:
        turns = body.skeleton.dof_is_rotation
        angles = content.means[:, turns]
        near = angles[np.argmax(content.weights)]
        angles = angles - 2.0 * np.pi * np.round((angles - near) / (2.0 * np.pi))
        sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, turns])
        result.append(np.degrees(np.stack([angles, sigmas])))
    return np.concatenate(result, axis=-1)


def intervals(weights: Array, marginals: Array) -> Array:
    """Quantiles (V, 3) of mixtures of normal distributions at `PROBABILITIES`.

    Args:
        weights: (K,) sum to 1.
        marginals: (2, K, V) means and standard deviations, above 0.
    """
    means, sigmas = np.asarray(marginals, dtype=np.float64)[..., None]
    low = np.broadcast_to((means - 6.0 * sigmas).min(axis=0), (*means.shape[1:2], 3)).copy()
    high = np.broadcast_to((means + 6.0 * sigmas).max(axis=0), low.shape).copy()
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        below = np.einsum('k,kvp->vp', weights, ndtr((middle - means) / sigmas)) < PROBABILITIES
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high), dtype=np.float64)
