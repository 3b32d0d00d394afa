"""Arms and feet of synthetic motions: reaching postures, and standing or walking feet.

Directions and positions of arms are in the frame of the person: x to the right, y ahead, z up.
Feet are in the world frame of a `Viewpoint`: z up, floor at z = 0, m. A heading of 0 faces the
camera; positive headings turn to the person's left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from hmt_learning.motion.inverse_kinematics import solve_joint_positions
from hmt_learning.motion.self_intersection import self_intersection_energy
from hmt_ros.body.body import Body
from hmt_ros.body.limb_angles import SIDES
from hmt_ros.inference.arrays import Array

Posture = dict[str, float]  # degree of freedom -> rad

SIGNS = np.array([-1.0, 1.0])  # signs of x outwards, for the left and the right side
ARM_DOFS = ('shoulder_x', 'shoulder_y', 'shoulder_z', 'elbow')
REACHED = 0.012  # maximum distance of elbows and wrists from their targets, m
STRETCH = 0.45, 0.97  # bounds of the distance from wrist to shoulder, in arm lengths
CANDIDATES, TRIES = 24, 20
# Phases of a stride, as fractions of the time from one heel strike to the next.
BODY_ABOVE = 0.235  # the body passes over the foot
HEEL_OFF, TOE_OFF = 0.30, 0.62
STRIKE, PUSH = np.radians(16.0), np.radians(-56.0)  # pitch of the foot, positive with the toe up
CLEARANCE = 0.02  # added to the ankle's height in the air, for a body of the default size, m


def minimum_jerk(share: Array) -> Array:
    """Minimum-jerk step from 0 to 1, for a fraction of time from 0 to 1."""
    return share**3 * (10.0 + share * (6.0 * share - 15.0))


def arm_posture(body: Body, upper: Sequence[ArrayLike], fore: Sequence[ArrayLike]) -> Posture:
    """Angles of both arms for given directions of upper arms and forearms.

    Args:
        body: body with the arms of human32.
        upper, fore: unit vectors of the upper arms and forearms, left and right.

    Raises:
        ValueError: the joint limits do not allow the posture.
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
    """Random posture with the wrists inside bounds, reached without self-intersection.

    Args:
        before: previous posture, the start of a minimum-jerk motion of all angles; or None.
        bend: angles of other parts of the body in the posture.
        bounds: (2, 3) minimum and maximum of the wrist position relative to the shoulder, in arm
            lengths; x points outwards.

    Raises:
        ValueError: no such posture was found.
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
    """Angles (N,) of both arms, by name, for directions (N, 2, 3), and their errors (N,), m."""
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
    """Whether parts of the body intersect in the motion between two postures."""
    share = minimum_jerk(np.linspace(0.0, 1.0, 9))
    poses = np.zeros((len(share), body.dimension))
    for name in after:
        if name in body.dof_names:
            start = before.get(name, 0.0)
            poses[:, body.dof_names.index(name)] = start + share * (after[name] - start)
    energy = self_intersection_energy(body, poses)
    return bool(energy.max() > 0.0)


def ahead(heading: Array | float) -> Array:
    """Unit vectors (..., 2) on the floor of the directions in which persons of a heading look."""
    return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


def sole(body: Body) -> float:
    """Height of the ankle above the floor with a flat foot, m."""
    names = body.skeleton.segment_names
    return max(p.radii[1] - p.centre[1] for p in body.flesh.parts if 'foot' in names[p.segment])


def standing_foot(
    body: Body, place: Array, up: Array | float, pitch: Array | float, heading: Array
) -> tuple[Array, Array]:
    """Ankle and toe (T, 3) of a foot.

    Args:
        place: (T, 2) position of the ankle over the floor, m.
        up: height of the ankle above that with a flat foot, m.
        pitch: pitch of the foot, positive with the toe up, rad.
        heading: (T,) heading of the foot, rad.
    """
    ankle = np.empty((len(place), 3))
    ankle[:, :2] = place
    ankle[:, 2] = sole(body) + up
    flat = (np.cos(pitch) * ahead(heading).T).T
    up_toe = np.broadcast_to(np.sin(pitch), heading.shape)
    return ankle, ankle + body.segment_lengths['foot'] * np.column_stack([flat, up_toe])


def walking_foot(
    body: Body, phase: Array, path: Callable[[Array], tuple[Array, Array]], aside: float
) -> tuple[Array, Array]:
    """Ankle and toe (T, 3) of a foot whose heel strikes at integer phases.

    The foot stands still between heel strike and heel lift; then it turns about the toe until that
    leaves the floor.

    Args:
        phase: (T,) increasing phases of the stride.
        path: function from phases to the position (..., 2) and heading of the body.
        aside: distance of the foot to the right of the path, m.
    """
    foot = body.segment_lengths['foot']
    step = np.floor(phase)
    x = phase - step
    here, _ = path(step + BODY_ABOVE)
    there, _ = path(step + 1 + BODY_ABOVE)
    stride = np.linalg.norm(there - here, axis=1)

    rise = np.clip((x - HEEL_OFF) / (TOE_OFF - HEEL_OFF), 0.0, 1.0) ** 2
    pitch = np.where(x < HEEL_OFF, STRIKE * np.clip(1 - x / 0.08, 0, 1) ** 2, PUSH * rise)
    on_toe = x >= HEEL_OFF
    forth = np.where(on_toe, foot * (1 - np.cos(pitch)), 0.0)
    up = np.where(on_toe, -foot * np.sin(pitch), 0.0)

    # In the air the motion continues smoothly, with the same position and velocity.
    air = x >= TOE_OFF
    u = np.clip((x - TOE_OFF) / (1 - TOE_OFF), 0.0, 1.0)
    turning = PUSH * 2 / (TOE_OFF - HEEL_OFF) * (1 - TOE_OFF)
    pitch = np.where(air, cubic(u, PUSH, turning, STRIKE), pitch)
    start = foot * (1 - np.cos(PUSH)), foot * np.sin(PUSH) * turning
    forth = np.where(air, cubic(u, *start, stride), forth)
    start = -foot * np.sin(PUSH), -foot * np.cos(PUSH) * turning
    arc = cubic(u, *start, 0.0) + CLEARANCE * body.scale * np.sin(np.pi * u) ** 2
    up = np.where(air, arc, up)

    place, heading = path(step + BODY_ABOVE + forth / stride)
    # The heading of the foot is constant on the floor.
    heading = np.where(air, heading, path(step + BODY_ABOVE)[1])
    return standing_foot(body, place + aside * ahead(heading - np.pi / 2), up, pitch, heading)


def cubic(share: Array, start: float, slope: float, end: Array | float) -> Array:
    """Cubic polynomial with given value and slope at 0, and given value and zero slope at 1."""
    u, v = share, 1.0 - share
    return (1 + 2 * u) * v * v * start + u * v * v * slope + u * u * (3 - 2 * u) * end
