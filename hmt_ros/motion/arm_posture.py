"""Postures of the arms: joint angles for where elbows and wrists are to be, and random reaching.

Directions and places are those of a person at rest: x to the person's right, y ahead, z up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.inverse_kinematics import solve_joint_positions
from hmt_ros.body.kinematics import forward
from hmt_ros.body.self_intersection import self_intersection_energy
from hmt_ros.motion.smooth_curves import minimum_jerk

Array = NDArray[np.float64]
Posture = dict[str, float]  # degree of freedom -> rad

SIDES = ('left', 'right')
SIGNS = np.array([-1.0, 1.0])  # of x, outwards
ARM_DOFS = ('shoulder_x', 'shoulder_y', 'shoulder_z', 'elbow')
REACHED = 0.012  # m, within which elbows and wrists must come to where they are to be
STRETCH = (
    0.45,
    0.97,
)  # least and greatest distance of a wrist from the shoulder, in lengths of an arm
CANDIDATES, TRIES = 24, 20


def arm_posture(body: Body, upper: Sequence[ArrayLike], fore: Sequence[ArrayLike]) -> Posture:
    """Angles of both arms whose parts point in given directions.

    Args:
        body: with the arms of human32.
        upper, fore: unit vectors of the left and of the right arm.

    Raises:
        ValueError: the limits of the joints do not allow it.
    """
    angles, error = _solve(body, np.array(upper)[None], np.array(fore)[None])
    if error[0] > REACHED:
        raise ValueError(f'the arms of body {body.name} miss a posture by {error[0]:.3f} m')
    return {name: float(values[0]) for name, values in angles.items()}


def reaching_posture(
    body: Body,
    before: Posture | None,
    bend: Posture,
    bounds: ArrayLike,
    rng: np.random.Generator,
) -> Posture:
    """Random posture with the wrists inside bounds, to which no part runs through another.

    Args:
        body: that reaches.
        before: the posture that it comes from, by minimum jerk in all angles; None: none.
        bend: angles of other parts of the body in the posture.
        bounds: (2, 3) lowest and highest place of the wrists from the shoulders, in lengths of an
            arm; x outwards.
        rng: random numbers.

    Raises:
        ValueError: none was found.
    """
    lengths = body.segment_lengths
    upper, fore = lengths['upper_arm'], lengths['forearm']
    low, high = np.asarray(bounds, dtype=np.float64)
    for _ in range(TRIES):
        wrist = low + rng.random((CANDIDATES, 2, 3)) * (high - low)
        far = np.linalg.norm(wrist, axis=2, keepdims=True)
        line, far = wrist / far, np.clip(far, *STRETCH) * (upper + fore)
        # Elbows hang outwards and down.
        pole = np.array([0.8, -0.35, -0.75]) + rng.normal(0, 0.25, wrist.shape)
        pole -= line * (pole * line).sum(2, keepdims=True)
        pole /= np.linalg.norm(pole, axis=2, keepdims=True)
        along = (far**2 + upper**2 - fore**2) / (2 * far)
        elbow = along * line + np.sqrt(np.maximum(upper**2 - along**2, 0.0)) * pole
        wrist = far * line
        for place in (elbow, wrist):
            place[..., 0] *= SIGNS
        angles, error = _solve(body, elbow / upper, (wrist - elbow) / fore)
        for i in np.flatnonzero(error < REACHED):
            posture = {name: float(values[i]) for name, values in angles.items()} | bend
            if not _intersects(body, posture if before is None else before, posture):
                return posture
    raise ValueError(f'no posture of the arms of body {body.name} found within its joint limits')


def _solve(body: Body, upper: Array, fore: Array) -> tuple[dict[str, Array], Array]:
    """Angles (N,) of both arms, by name, for directions (N, 2, 3), and what they miss (N,), m."""
    skeleton = body.skeleton
    rest = body.joint_positions(np.zeros((1, body.dimension)))
    shoulders = rest[0, skeleton.joint_index([f'{side}_shoulder' for side in SIDES])]
    to_camera = skeleton.mounts[0].T
    elbows = shoulders + body.segment_lengths['upper_arm'] * upper @ to_camera
    wrists = elbows + body.segment_lengths['forearm'] * fore @ to_camera
    goals = np.concatenate([elbows, wrists], axis=1)
    joints = tuple(f'{side}_{joint}' for joint in ('elbow', 'wrist') for side in SIDES)
    free = tuple(f'{side}_{dof}' for side in SIDES for dof in ARM_DOFS)
    columns = skeleton.dof_index(free)
    start = np.zeros((len(goals), body.dimension))
    start[:, skeleton.dof_index(['left_elbow', 'right_elbow'])] = 0.7
    found = solve_joint_positions(body, start, goals, joints, free_dofs=free, prior_weight=1e-4).x
    error = body.joint_positions(found)[:, skeleton.joint_index(joints)] - goals
    angles = {name: found[:, column] for name, column in zip(free, columns)}
    return angles, np.linalg.norm(error, axis=2).max(1)


def _intersects(body: Body, before: Mapping[str, float], after: Mapping[str, float]) -> bool:
    """Whether parts of the body run through each other on the way between postures."""
    share = minimum_jerk(np.linspace(0.0, 1.0, 9))
    poses = np.zeros((len(share), body.dimension))
    for name in after:
        if name in body.dof_names:
            start = before.get(name, 0.0)
            poses[:, body.dof_names.index(name)] = start + share * (after[name] - start)
    energy, _, _ = self_intersection_energy(body, forward(body.skeleton, poses))
    return bool(energy.max() > 0.0)
