"""A recorded motion as poses of another body, in the frame of a camera.

Every motion file has its own skeleton. The lengths are measured on the recorded joints; initial
angles follow in closed form along the limbs (the descending solution of KJS 3); then all frames
are fitted to the joint positions within the joint limits. Joint positions leave the twist of a
straight limb open; sweeps that pull every frame towards its neighbours determine it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from hmt_learning.motion.motion_file import Motion
from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward, point_energy
from hmt_ros.body.limb_angles import HIPS, SIDES, limb_angles, trunk_start
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference import minimise
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import EnergyFunction

# Function of poses (n, d) and their frames (n,) that returns value, gradient and Hessian.
Misfit = Callable[[Array, Index], tuple[Array, Array, Array]]

# Joints of a motion that are used, and their standard deviations, m.
SIGMA = {
    'pelvis': 0.010,
    'neck': 0.005,
    'head': 0.015,
    'hip': 0.005,
    'knee': 0.005,
    'ankle': 0.005,
    'toe': 0.010,
    'shoulder': 0.005,
    'elbow': 0.005,
    'wrist': 0.005,
    'hand': 0.010,
}
OPTIONAL = {'toe': 'ankle', 'hand': 'wrist'}  # may be missing; the joint before each
MIN_TIP_LENGTH = 0.02  # minimum length of a foot or hand for a usable direction, m
FRONT = 0.1  # distance of the point in front of the pelvis that carries its rotation, m
FRONT_SIGMA = 0.015
BELIEF = 4.0  # factor on the standard deviations of the body's soft prior
NEIGHBOURS = np.radians(4.0)  # standard deviation of an angle from the mean of the adjacent frames
BRANCH = np.radians(120.0)  # maximum difference of an angle to an adjacent frame that pulls
APART = np.radians(750.0)  # rad/s; after faster changes a frame is solved again from its neighbour
SWEEPS = 6  # number of passes that pull every frame towards its neighbours
SAME = 2.0  # accepted increase of the misfit for a continuous motion


def body_from_motion(motion: Motion, body: Body) -> Body:
    """The body with its lengths measured on the joints of a motion: medians over all frames.

    Left and right are averaged. A foot or a hand that the file lacks keeps its proportion to the
    shin or the forearm.

    Raises:
        ValueError: the motion has no standard joint names, or the body lacks some of the lengths.
    """
    place = _recorded(motion)

    def span(a: str, b: str) -> float:
        pairs = [(place[f'{s}_{a}'], place[f'{s}_{b}']) for s in SIDES if f'{s}_{b}' in place]
        norms = [np.median(np.linalg.norm(q - p, axis=1)) for p, q in pairs]
        return float(np.mean(norms)) if norms else 0.0

    hips, shoulders = (
        (place[f'left_{joint}'], place[f'right_{joint}']) for joint in ('hip', 'shoulder')
    )
    trunk = place['neck'] - trunk_start(body.skeleton, place)
    drop = place['pelvis'] - 0.5 * (hips[0] + hips[1])
    rise = 0.5 * (shoulders[0] + shoulders[1]) - place['neck']
    up = trunk / np.linalg.norm(trunk, axis=1, keepdims=True)
    lengths = {
        'thigh': span('hip', 'knee'),
        'shin': span('knee', 'ankle'),
        'foot': span('ankle', 'toe'),
        'upper_arm': span('shoulder', 'elbow'),
        'forearm': span('elbow', 'wrist'),
        'hand': span('wrist', 'hand'),
        'hip_width': _median_norm(hips[0] - hips[1]),
        # Some skeletons have their hips above the pelvis joint.
        'hip_drop': hip_drop_share(body)
        * _median_norm(drop)
        * float(np.sign(np.median((drop * up).sum(1)))),
        'shoulder_width': _median_norm(shoulders[0] - shoulders[1]),
        'shoulder_rise': float(np.median((rise * up).sum(1))),
        'trunk': _median_norm(trunk),
        'neck_to_head': _median_norm(place['head'] - place['neck']),
    }
    missing = sorted(set(lengths) - set(body.segment_lengths))
    if missing:
        raise ValueError(f'{body.name} has no lengths {missing}: wanted a body like human37')
    for end, carrier in (('foot', 'shin'), ('hand', 'forearm')):
        if lengths[end] == 0:
            own = body.segment_lengths
            lengths[end] = own[end] / own[carrier] * lengths[carrier]
    return body.with_segment_lengths(lengths)


def hip_drop_share(body: Body) -> float:
    """Ratio of the length `hip_drop` to the distance from the pelvis to the middle of the hips."""
    if not set(HIPS) <= set(body.joint_names):
        return 1.0  # callers report missing joints themselves
    rest = body.joint_positions(np.zeros((1, body.dimension)))[0]
    pelvis, left, right = rest[body.skeleton.joint_index(HIPS)]
    distance = float(np.linalg.norm(0.5 * (left + right) - pelvis))
    return abs(body.segment_lengths.get('hip_drop', 0.0)) / max(distance, 1e-9)


def retarget(
    motion: Motion,
    body: Body,
    camera_from_world: tuple[ArrayLike, ArrayLike],
) -> Array:
    """Poses of a body that follow a motion, (T, d) in the camera optical frame.

    Args:
        body: body with the limbs of KJS fig. 3, such as the bundled ones, and the lengths of the
            person (see `body_from_motion`).
        camera_from_world: rotation (3, 3) and translation (3,) m that map a point of the motion's
            world (z up) to the camera optical frame (x right, y down, z forward).

    Returns:
        Poses within the limits of the body, continuous in time if the limits allow it.

    Raises:
        ValueError: the motion has no standard names, the body has other limbs, the rotation is
            invalid, or the person is nearer to the camera than the limits of the body allow.
    """
    rotation, translation = (np.asarray(x, dtype=np.float64) for x in camera_from_world)
    _check_camera(rotation, translation)
    skeleton = body.skeleton
    place = {name: points @ rotation.T + translation for name, points in _recorded(motion).items()}
    nearest = skeleton.lower[skeleton.dof_index(('root_tz',))[0]]
    depth = place['pelvis'][:, 2]
    if depth.min() <= nearest:
        frame = int(depth.argmin())
        raise ValueError(
            f'{motion.name}: the pelvis is at depth {depth[frame]:.2f} m in frame {frame}, wanted '
            f'more than {nearest:.2f} m: move the camera back'
        )
    start = limb_angles(skeleton, place, motion.fps)
    front = place['pelvis'] + FRONT * _recorded_front(motion, rotation, skeleton, start)
    # The joints, and the point in front of the pelvis.
    joints = skeleton.joint_index(tuple(place))
    sigma = [SIGMA[n.removeprefix('left_').removeprefix('right_')] for n in place]
    segments = np.append(skeleton.joint_segments[joints], 0)
    local = np.append(skeleton.joint_offsets[joints], [[0.0, FRONT, 0.0]], axis=0)
    targets = np.stack([*place.values(), front], axis=1)
    across = np.eye(3) / np.append(sigma, FRONT_SIGMA)[:, None, None]

    def misfit(poses: Array, rows: Index) -> tuple[Array, Array, Array]:
        every = np.broadcast_to(across, (len(rows), *across.shape))
        return point_energy(forward(skeleton, poses), segments, local, targets[rows], every)

    return _refined(body, misfit, start, motion.fps)


def _check_camera(rotation: Array, translation: Array) -> None:
    shapes = rotation.shape, translation.shape
    if shapes != ((3, 3), (3,)):
        raise ValueError(f'camera_from_world has shapes {shapes}, wanted (3, 3) and (3,)')
    orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    if not orthogonal or np.linalg.det(rotation) < 0 or not np.isfinite(translation).all():
        seen = f'{rotation.tolist()}, {translation.tolist()}'
        raise ValueError(f'camera_from_world must be a rotation and a translation, saw {seen}')


def _recorded(motion: Motion) -> dict[str, Array]:
    """Positions (T, 3) of a motion's joints by name, world frame, without very short hands."""
    central = ['pelvis', 'neck', 'head']
    paired = [f'{s}_{joint}' for s in SIDES for joint in SIGMA if joint not in central]
    names = [n for n in central + paired if n in motion.body.joint_names]
    needed = [n for n in central + paired if n.partition('_')[2] not in OPTIONAL]
    missing = [n for n in needed if n not in names]
    if missing:
        raise ValueError(
            f'{motion.name} lacks joints {missing}: its skeleton is not one whose names are known'
        )
    place = dict(zip(names, np.moveaxis(motion.joint_positions(names), 1, 0), strict=True))
    for side in SIDES:
        for end, carrier in OPTIONAL.items():
            tip = place.get(f'{side}_{end}')
            if tip is not None and _median_norm(tip - place[f'{side}_{carrier}']) < MIN_TIP_LENGTH:
                del place[f'{side}_{end}']
    return place


def _median_norm(x: Array) -> float:
    return float(np.median(np.linalg.norm(x, axis=-1)))


def _recorded_front(motion: Motion, rotation: Array, skeleton: Skeleton, start: Array) -> Array:
    """Unit vectors (T, 3) to the front of the pelvis, from its recorded rotation.

    Positions of pelvis and hips do not determine the pelvis's tilt if a skeleton has them at one
    height. The recorded rotation does, up to a constant direction: the mean over the motion.
    """
    recorded = motion.body.skeleton
    carrier = recorded.joint_segments[recorded.joint_index(('pelvis',))]
    columns = forward(recorded, motion.poses).columns[carrier[0]]  # (3, 3, T): axis, coordinate
    axes = np.einsum('cw,iwt->tci', rotation @ motion.world_from_file, columns)
    front = forward(skeleton, start).columns[0, 1].T
    mean = np.einsum('tci,tc->i', axes, front)
    return np.asarray(axes @ (mean / max(float(np.linalg.norm(mean)), 1e-9)))


def _refined(body: Body, misfit: Misfit, start: Array, fps: float) -> Array:
    """Poses (T, d) of minimum misfit, from initial poses (T, d)."""
    skeleton = body.skeleton
    rotation = skeleton.dof_is_rotation
    step_scale = np.where(rotation, 0.3, 0.1)
    diagonal = np.arange(skeleton.dimension)

    def solve(
        rows: Index, poses: Array, mean: Array, precision: Array, iterations: int
    ) -> tuple[Array, Array]:
        """Poses (n, d) of some frames, pulled towards means (n, d), and their energies (n,)."""

        def objective(x: Array, part: Index) -> tuple[Array, Array, Array]:
            value, gradient, hessian = misfit(x, rows[part])
            off, pull = x - mean[part], precision[part]
            hessian[:, diagonal, diagonal] += pull
            return value + 0.5 * (pull * off * off).sum(1), gradient + pull * off, hessian

        best = minimise(
            EnergyFunction(objective),
            poses,
            skeleton.lower,
            skeleton.upper,
            step_scale=step_scale,
            max_iterations=iterations,
            tolerance=1e-4,
        )
        return best.x, best.value

    everyone = np.arange(len(start))
    believed = rotation & np.isfinite(body.prior_sigma)
    belief = np.where(believed, (BELIEF * body.prior_sigma) ** -2, np.where(rotation, 1e-3, 0.0))
    belief = np.broadcast_to(belief, start.shape)
    mean = np.broadcast_to(body.prior_mean, start.shape)
    poses, value = solve(everyone, start, mean, belief, 40)

    # A frame in another minimum than its neighbour moves to the neighbour's, if the fit allows it.
    for step in (1, -1, 1, -1):
        rows = everyone[1:] if step > 0 else everyone[:-1]
        apart = np.abs(poses[rows] - poses[rows - step])[:, rotation].max(1) > APART / fps
        rows = rows[apart]
        if len(rows) == 0:
            break
        trial, cost = solve(rows, poses[rows - step], mean[rows], belief[rows], 25)
        better = cost < value[rows] + SAME
        poses[rows[better]], value[rows[better]] = trial[better], cost[better]

    weight = (NEIGHBOURS * min(1.0, 30.0 / fps)) ** -2
    for _ in range(SWEEPS if len(poses) > 2 else 0):
        before, after = np.roll(poses, 1, axis=0), np.roll(poses, -1, axis=0)
        before[0], after[-1] = poses[0], poses[-1]
        near_before = np.abs(before - poses) < BRANCH
        near_after = np.abs(after - poses) < BRANCH
        count = near_before.astype(float) + near_after
        count[0] = count[-1] = 0.0
        pull = np.where(rotation, 0.5 * weight * count, 0.0)
        middle = poses + np.where(near_before, before - poses, 0.0) / np.maximum(count, 1.0)
        middle += np.where(near_after, after - poses, 0.0) / np.maximum(count, 1.0)
        total = belief + pull
        centre = (belief * mean + pull * middle) / np.maximum(total, 1e-12)
        poses, _ = solve(everyone, poses, centre, total, 5)
    return poses
