"""Synthetic motions (walk, reach, dance) for the body models of the package.

A motion is planned in the world frame of a `Viewpoint`: the steps of the feet, the path of the
pelvis above them, and angles of trunk, neck and arms that move smoothly between postures. Inverse
kinematics gives the legs, so that a foot on the floor stays where it is. All lengths scale with
the body.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from hmt_learning.motion.inverse_kinematics import solve_joint_positions
from hmt_learning.motion.limb_motions import (
    SIGNS,
    Posture,
    ahead,
    arm_posture,
    minimum_jerk,
    reaching_posture,
    sole,
    standing_foot,
    walking_foot,
)
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body.body import Body
from hmt_ros.body.limb_angles import SIDES
from hmt_ros.body.mirror import root_angles, root_rotations
from hmt_ros.inference.arrays import Array

PLANNING_RATE = 120.0  # minimum rate at which a motion is planned, Hz
MARGIN = 0.5  # planned before and after, so that smoothing has no boundary effects, s
REACHABLE = 0.992  # maximum distance from hip to ankle, as a share of the leg length
ROOM = 4.2  # maximum length of a straight walk, m
CIRCLE = 1.5  # radius of a longer walk, m
DEGREE = np.pi / 180
LEG_DOFS = ('hip_x', 'hip_y', 'hip_z', 'knee', 'ankle_x', 'ankle_y')

# Angles that bend the body in reaching. For each kind of reach: their bounds, deg, and bounds of
# the wrists relative to the shoulders (outwards, ahead, up), in arm lengths. The side is random.
BENDING = ('root_x', 'root_y', 'trunk_x', 'trunk_y', 'trunk_z', 'neck_x', 'neck_y')
SIDEWAYS = ('root_y', 'trunk_y', 'trunk_z', 'neck_y')
REACHES: dict[str, dict[str, Array]] = {
    'front': {
        'bend': np.array([[-14, 0, -16, 0, 0, -8, 0], [-4, 2, -4, 4, 14, 5, 4.0]]),
        'wrist': np.array([[-0.35, 0.60, -0.25], [0.30, 0.95, 0.35]]),
    },
    'above': {
        'bend': np.array([[-3, 0, 0, 0, 0, 0, 0], [3, 2, 8, 6, 8, 15, 6.0]]),
        'wrist': np.array([[-0.10, 0.10, 0.45], [0.55, 0.60, 0.95]]),
    },
    'aside': {
        'bend': np.array([[-6, 0, -6, 4, 5, -5, 3], [0, 3, 0, 14, 20, 5, 10.0]]),
        'wrist': np.array([[0.45, 0.10, -0.35], [0.90, 0.55, 0.35]]),
    },
    'low': {
        'bend': np.array([[-40, 0, -32, 0, 0, -5, 0], [-24, 2, -16, 5, 10, 10, 4.0]]),
        'wrist': np.array([[-0.25, 0.45, -0.75], [0.30, 0.75, -0.25]]),
    },
}
DANCING_WRISTS = np.array([[-0.45, 0.05, -0.85], [0.95, 0.90, 0.95]])
# Sideways direction of the body on each beat. The left foot lands on even beats; in this order the
# feet never cross.
SIDE_STEPS = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])


# A motion without leg angles at T times, in the world frame of a viewpoint, m and rad: desired
# pelvis positions (T, 3), lowered if a leg is too short; angles (T,) by degree of freedom, ignored
# if the body lacks it; positions (T, 3) of ankle and toe, of the left foot, then of the right.
Feet = list[tuple[Array, Array]]
Plan = tuple[Array, dict[str, Array], Feet]
Motion = Callable[[Body, Array, float, 'float | None', np.random.Generator], Plan]


def procedural_motion(
    name: str,
    body: Body,
    duration: float,
    fps: float,
    seed: int = 0,
    *,
    heading: float | None = None,
    viewpoint: Viewpoint | None = None,
) -> Array:
    """Poses (T, d) of a motion, T = duration * fps, in the camera optical frame of a viewpoint.

    Args:
        body: body with flesh and the degrees of freedom of human32; a spine moves, too.
        duration: duration, s.
        fps: poses per second. The motion as a function of time does not depend on it.
        heading: direction in which the person looks or walks at first, rad: 0 is towards the
            camera, positive to the person's left. None selects one that suits the motion.
        viewpoint: place of the camera; the person moves around the origin of its world.

    Raises:
        ValueError: the name is unknown, the duration is below one frame, or the body is unsuitable.
    """
    if name not in PROCEDURAL_MOTIONS:
        raise ValueError(f'no motion {name!r}: wanted one of {sorted(PROCEDURAL_MOTIONS)}')
    rng = np.random.default_rng([seed, sorted(PROCEDURAL_MOTIONS).index(name)])
    return poses_of(PROCEDURAL_MOTIONS[name], body, duration, fps, rng, heading, viewpoint)


def poses_of(
    motion: Motion,
    body: Body,
    duration: float,
    fps: float,
    rng: np.random.Generator,
    heading: float | None = None,
    viewpoint: Viewpoint | None = None,
) -> Array:
    """Poses (T, d) of any motion; arguments, result and errors are those of `procedural_motion`."""
    if not (np.isfinite(duration) and np.isfinite(fps) and fps > 0 and duration * fps >= 1):
        raise ValueError(f'a motion needs one frame at least, saw {duration} s at {fps} fps')
    missing = {'root_tx', 'root_z', 'left_shoulder_z', 'left_knee'} - set(body.dof_names)
    if missing or not body.shapes:
        what = f'no {sorted(missing)}' if missing else 'no flesh'
        raise ValueError(f'body {body.name} has {what}: wanted a body such as human32')
    viewpoint = viewpoint or Viewpoint()
    frames = int(np.floor(duration * fps + 1e-6))
    fine = int(np.ceil(PLANNING_RATE / fps))
    margin = int(np.ceil(MARGIN * fps))
    time = np.arange(-margin * fine, (frames + margin) * fine) / (fps * fine)
    plan = motion(body, time, duration, heading, rng)
    chosen = slice(margin * fine, (margin + frames) * fine, fine)
    return _poses(body, plan, fps * fine, chosen, viewpoint)


def walk(
    body: Body, time: Array, duration: float, heading: float | None, rng: np.random.Generator
) -> Plan:
    """Plan of a walk: straight ahead if no longer than ROOM, otherwise around a circle."""
    size = (body.segment_lengths['thigh'] + body.segment_lengths['shin']) / 0.825
    step = 0.60 * size * rng.uniform(0.93, 1.07)
    stride_time = 1.12 * np.sqrt(size) * rng.uniform(0.95, 1.05)
    way = 2 * step / stride_time * duration
    phase = time / stride_time + rng.random()  # the left heel strikes at integers
    swing = rng.uniform(17, 24) * DEGREE
    turn = rng.choice([-1.0, 1.0]) / CIRCLE if way > ROOM else 0.0
    start = 75 * DEGREE if heading is None else heading
    zero = phase[0] - time[0] / stride_time

    def path(at: Array) -> tuple[Array, Array]:
        gone = 2 * step * (at - zero)
        if turn == 0.0:
            return (gone - 0.5 * way)[..., None] * ahead(start), np.full(gone.shape, start)
        return ahead(start + turn * gone - np.pi / 2) / turn, start + turn * gone

    feet = [
        # The two feet are half a stride apart.
        walking_foot(
            body,
            phase + 0.5 * side,
            lambda at, late=0.5 * side: path(at - late),  # type: ignore[misc]
            SIGNS[side] * 0.065 * body.scale,
        )
        for side in range(2)
    ]
    place, direction = path(phase)
    wave = 2 * np.pi * phase
    sway = np.sin(wave - 0.4)  # positive towards the left foot, while that stands
    pelvis = np.full((len(time), 3), np.inf)  # as high as the legs allow
    pelvis[:, :2] = place - (0.018 * size * sway)[:, None] * ahead(direction - np.pi / 2)
    twist = 5 * DEGREE * np.cos(wave)
    angles = {
        'root_z': direction - twist,
        'root_y': 2.5 * DEGREE * sway,
        'root_x': np.full(len(time), -3 * DEGREE),
        'trunk_x': -(2 + np.cos(2 * wave)) * DEGREE,
        'trunk_y': -2.0 * DEGREE * sway,
        'trunk_z': -2.0 * twist,
    }
    return pelvis, angles | swinging_arms(body, swing, np.cos(wave)), feet


def reach(
    body: Body, time: Array, duration: float, heading: float | None, rng: np.random.Generator
) -> Plan:
    """Plan of a standing person who reaches with both arms in front, above, aside and low."""
    scale, facing = body.scale, 20 * DEGREE if heading is None else heading
    rest = arm_posture(
        body,
        [hanging(4 * DEGREE, 9 * DEGREE * sign) for sign in SIGNS],
        [hanging(24 * DEGREE, 4 * DEGREE * sign) for sign in SIGNS],
    )
    times, postures = [-10.0, 0.15], [rest | dict.fromkeys(BENDING, 0.0)] * 2
    kinds: list[str] = []
    while times[-1] < duration + MARGIN:
        kinds = kinds or [str(x) for x in rng.permutation(sorted(REACHES))]
        kind = REACHES[kinds.pop()]
        low, high = kind['bend']
        bend = dict(zip(BENDING, (rng.uniform(low, high) * DEGREE).tolist()))
        for name in SIDEWAYS:
            bend[name] *= float(rng.choice([-1.0, 1.0]))
        posture = reaching_posture(body, postures[-1], bend, kind['wrist'], rng)
        arrival = times[-1] + rng.uniform(1.0, 1.35)
        times += [arrival, arrival + rng.uniform(0.05, 0.25)]
        postures += [posture, posture]
    angles = between(time, times, postures)
    angles['root_z'] = np.full(len(time), facing)
    # The pelvis moves back as the head moves forwards.
    back = -0.22 * scale * np.sin(-angles['root_x'])
    sway = 0.02 * scale * np.sin(2 * np.pi * time / rng.uniform(2.5, 3.5) + rng.uniform(0, 6))
    pelvis = np.full((len(time), 3), np.inf)
    pelvis[:, :2] = back[:, None] * ahead(facing) + sway[:, None] * ahead(facing - np.pi / 2)
    feet = []
    for sign in SIGNS:
        place = scale * (0.13 * sign * ahead(facing - np.pi / 2) - 0.03 * ahead(facing))
        yaw = np.full(len(time), facing - sign * 8 * DEGREE)
        feet.append(standing_foot(body, np.tile(place, (len(time), 1)), 0.0, 0.0, yaw))
    return pelvis, angles, feet


def dance(
    body: Body, time: Array, duration: float, heading: float | None, rng: np.random.Generator
) -> Plan:
    """Plan of a dance: turns, side steps, knee bends and large arm movements."""
    scale, start = body.scale, 0.0 if heading is None else heading
    period = rng.uniform(0.50, 0.60)
    clock = time / period + 1.5  # in beats; all planned times are after beat 0
    bar = len(SIDE_STEPS)
    bars = int(np.ceil((duration + MARGIN) / period + 4)) // bar + 1
    count = bars * bar

    # Each beat has a place and a heading for the foot that lands on it.
    def by_bar(low: float, high: float) -> Array:
        return np.repeat(rng.uniform(low, high, bars), bar)

    turns = by_bar(8, 22) * np.repeat(rng.choice([-1, 1], bars), bar) * DEGREE
    stance = start + np.cumsum(turns) - turns[0]
    side, front = by_bar(0.06, 0.18) * np.tile(SIDE_STEPS, bars), by_bar(-0.12, 0.12)
    middle = side[:, None] * ahead(stance - np.pi / 2) + front[:, None] * ahead(start)
    lift = by_bar(0.05, 0.16) * scale

    feet, floor, yaws = [], np.empty((2, len(time), 2)), np.empty((2, len(time)))
    for k, sign in enumerate(SIGNS):
        beats = np.arange(k, count, 2)
        places = scale * (middle[beats] + 0.13 * sign * ahead(stance[beats] - np.pi / 2))
        # A foot leaves the floor a little after the other has landed.
        landings = beats.astype(np.float64)
        floor[k], yaws[k], up = steps(clock, landings, 0.85, places, stance[beats], lift[beats[1:]])
        pitch = -np.clip(up / (0.13 * scale), 0.0, 1.0) * 30 * DEGREE
        feet.append(standing_foot(body, floor[k], up, pitch, yaws[k] - sign * 10 * DEGREE))

    pelvis = np.empty((len(time), 3))
    lean = 0.13 * np.sin(np.pi * (clock - 0.85))  # towards the standing foot
    pelvis[:, :2] = floor.mean(0) + lean[:, None] * (floor[0] - floor[1])
    lengths = body.segment_lengths
    upright = lengths['hip_drop'] + lengths['thigh'] + lengths['shin'] + sole(body)
    deep = rests(clock, np.arange(0, count, 2), rng.uniform(0.02, 0.11, count // 2))
    pelvis[:, 2] = upright - scale * (0.01 + deep + 0.025 * np.sin(np.pi * clock) ** 2)

    def wave(low: float, high: float, beats: float) -> Array:
        phase = rng.uniform(0, 2 * np.pi)
        return rng.uniform(low, high) * DEGREE * np.sin(2 * np.pi * clock / beats + phase)

    angles = {
        'root_z': yaws.mean(0),
        'root_y': wave(2, 4, 2),
        'root_x': -6 * DEGREE + wave(1, 3, 4),
        'trunk_x': -4 * DEGREE + wave(2, 6, 4),
        'trunk_y': wave(5, 10, 4),
        'trunk_z': wave(8, 16, 4),
        'neck_x': wave(3, 8, 2),
        'neck_y': wave(3, 8, 4),
    }
    times = [float(x) for x in range(-2, count + 3, 2)]
    postures = [reaching_posture(body, None, {}, DANCING_WRISTS, rng)]
    for _ in times[1:]:
        postures.append(reaching_posture(body, postures[-1], {}, DANCING_WRISTS, rng))
    return pelvis, angles | between(clock, times, postures), feet


PROCEDURAL_MOTIONS: dict[str, Motion] = {'walk': walk, 'reach': reach, 'dance': dance}


def hanging(forwards: float, outwards: float) -> Array:
    """Direction (3,) of a hanging arm, swung forwards and to the right by angles in rad."""
    flat = np.cos(outwards)
    return np.array([np.sin(outwards), flat * np.sin(forwards), -flat * np.cos(forwards)])


def swinging_arms(body: Body, swing: float, lead: Array) -> dict[str, Array]:
    """Angles (T,) of swinging arms, each in phase with the opposite leg.

    Args:
        swing: amplitude of the upper arms, rad.
        lead: (T,) from -1 (right leg in front) to 1 (left leg in front).
    """
    forth, back = (
        arm_posture(
            body,
            [hanging(forwards, 9 * DEGREE * sign) for sign in SIGNS],
            [hanging(forwards + bend, 4 * DEGREE * sign) for sign in SIGNS],
        )
        for forwards, bend in ((swing, 30 * DEGREE), (-swing, 14 * DEGREE))
    )
    angles = {}
    for name in forth:
        share = 0.5 - 0.5 * lead * (1.0 if name.startswith('left') else -1.0)
        angles[name] = back[name] + share * (forth[name] - back[name])
    return angles


def steps(
    time: Array, landings: Array, air: float, places: Array, headings: Array, lift: Array
) -> tuple[Array, Array, Array]:
    """Place (T, 2) on the floor, heading (T,) and height (T,) of a foot that steps.

    Args:
        time: (T,).
        landings: (n,) increasing times; the first is of the place where the foot starts.
        air: time in the air before a landing.
        places, headings: (n, 2), (n,) at the landings.
        lift: (n - 1,) heights of the steps.
    """
    at = np.stack([landings - air, landings], axis=1).ravel()[1:]
    x, y, heading = (rests(time, at, np.repeat(v, 2)[:-1]) for v in (*places.T, headings))
    share = np.clip((time[:, None] - landings[1:] + air) / air, 0.0, 1.0)
    return np.stack([x, y], axis=1), heading, np.sin(np.pi * share) ** 2 @ lift


def between(time: Array, times: list[float], postures: list[Posture]) -> dict[str, Array]:
    """Angles (T,) that move from posture to posture and rest at each."""
    return {name: rests(time, times, [p[name] for p in postures]) for name in postures[0]}


def _poses(body: Body, plan: Plan, rate: float, chosen: slice, viewpoint: Viewpoint) -> Array:
    """Poses (T', d) at the chosen times of a plan that has `rate` times per second."""
    skeleton, (pelvis, angles, feet) = body.skeleton, plan
    ankles, toes = (np.stack(x) for x in zip(*feet))
    poses = np.zeros((len(pelvis), body.dimension))
    # Inverse kinematics starts from bent knees, so that they bend in the right direction.
    bent = {'hip_x': 20 * DEGREE, 'knee': -25 * DEGREE}
    for side in SIDES:
        for joint, angle in bent.items():
            poses[:, skeleton.dof_index((f'{side}_{joint}',))] = angle
    for name, values in angles.items():
        if name in body.dof_names:
            poses[:, body.dof_names.index(name)] = values
    where = skeleton.dof_index(('root_tx', 'root_ty', 'root_tz'))
    turn = skeleton.dof_index(('root_z', 'root_y', 'root_x'))
    pelvis = _supported(body, pelvis, poses, ankles, max(round(0.035 * rate), 1))
    poses = poses[chosen]
    # The camera may be tilted.
    tilt = viewpoint.rotation @ skeleton.mounts[0].T
    poses[:, turn] = np.unwrap(root_angles(body, tilt @ root_rotations(body, poses)), axis=0)
    poses[:, where] = viewpoint.to_camera(pelvis[chosen])
    joints = tuple(f'{side}_{joint}' for joint in ('ankle', 'toe') for side in SIDES)
    goals = np.concatenate([ankles, toes])[:, chosen].transpose(1, 0, 2)
    legs = tuple(f'{side}_{dof}' for side in SIDES for dof in LEG_DOFS)
    return solve_joint_positions(
        body, poses, viewpoint.to_camera(goals), joints, free_dofs=legs, prior_weight=1e-3
    ).x


def _supported(body: Body, pelvis: Array, poses: Array, ankles: Array, half_width: int) -> Array:
    """Pelvis positions (T, 3) from which both legs reach their ankles (2, T, 3)."""
    which = body.skeleton.joint_index(('pelvis', 'left_hip', 'right_hip'))
    joints = Viewpoint().to_world(body.joint_positions(poses)[:, which])
    offset = (joints[:, 1:] - joints[:, :1]).transpose(1, 0, 2)
    leg = REACHABLE * (body.segment_lengths['thigh'] + body.segment_lengths['shin'])
    away = pelvis[:, :2] + offset[..., :2] - ankles[..., :2]
    height = np.sqrt(np.maximum(leg**2 - (away**2).sum(2), (0.5 * leg) ** 2))
    highest = (ankles[..., 2] + height - offset[..., 2]).min(0)
    result = pelvis.copy()
    result[:, 2] = smooth_below(np.minimum(highest, pelvis[:, 2]), half_width)
    return result


def rests(time: Array, times: ArrayLike, values: ArrayLike) -> Array:
    """Values (T,) that move from one to the next with minimum jerk and rest at each.

    Args:
        time: (T,).
        times: (n,) increasing times of the rests; nothing moves before the first or after the last.
        values: (n,) at the rests.
    """
    at, value = np.asarray(times, dtype=np.float64), np.asarray(values, dtype=np.float64)
    after = np.clip(np.searchsorted(at, time, side='right'), 1, len(at) - 1)
    share = np.clip((time - at[after - 1]) / (at[after] - at[after - 1]), 0.0, 1.0)
    return value[after - 1] + minimum_jerk(share) * (value[after] - value[after - 1])


def smooth_below(limit: Array, half_width: int) -> Array:
    """A smooth curve (T,) that nowhere exceeds a limit (T,).

    Args:
        limit: (T,).
        half_width: half-width of each of the three moving averages, samples.
    """
    # The minimum extends three half-widths to each side, as do the three averages together.
    lowest = minimum_filter1d(limit, 6 * half_width + 1, mode='nearest')
    for _ in range(3):
        lowest = uniform_filter1d(lowest, 2 * half_width + 1, mode='nearest')
    return np.asarray(lowest, dtype=np.float64)
