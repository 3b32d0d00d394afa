"""Skeletons in BVH files: another reader finds the joints in the same places as the body."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_learning.motion.motion_file import read_motion
from hmt_ros.body import load_body
from hmt_ros.body.moving_skeleton import (
    CAMERA_TO_ROOM,
    MovingSkeleton,
    bvh_text,
)

BODY = load_body('human37').with_stature(1.8)
FRAMES, RATE = 12, 25.0
TIMES = np.arange(FRAMES) / RATE
# A tenth of a millimetre.
CLOSE = 1e-4


def some_poses(frames=FRAMES, seed=0):
    """Poses (T, d) anywhere within the limits."""
    rng = np.random.default_rng(seed)
    lower, upper = (np.clip(x, -3.0, 3.0) for x in (BODY.lower, BODY.upper))
    poses = rng.uniform(lower, upper, (frames, BODY.dimension))
    poses[:, 2] = rng.uniform(2.0, 5.0, frames)
    return poses


def joints_of(poses):
    """Joints (T, J, 3) of poses in axes with y up, m."""
    return BODY.joint_positions(poses) @ CAMERA_TO_ROOM.T


def test_a_bvh_has_the_joints_where_they_are(tmp_path):
    poses = some_poses()
    path = tmp_path / 'some.bvh'
    path.write_text(bvh_text(MovingSkeleton.of_body(BODY, poses, TIMES), RATE))
    motion = read_motion(path, unit_to_m=1.0, up_axis='y')
    assert motion.fps == pytest.approx(RATE)
    wanted = joints_of(poses)
    # The world of read_motion has z up.
    wanted = np.stack([wanted[..., 0], -wanted[..., 2], wanted[..., 1]], axis=-1)
    assert np.abs(motion.joint_positions(BODY.joint_names) - wanted).max() < CLOSE


def test_the_pose_of_zeros_stands_upright_and_unturned():
    moving = MovingSkeleton.of_body(BODY, np.zeros((1, BODY.dimension)), np.zeros(1))
    unturned = np.tile(np.eye(3), (len(moving.names), 1, 1))
    np.testing.assert_allclose(moving.rotations[0], unturned, atol=1e-12)
    at = dict(zip(moving.names, moving.offsets, strict=True))
    assert at['left_knee'][1] < -0.3
    assert at['head'][1] > 0.1
    assert at['left_hip'][0] > 0 > at['right_hip'][0]
    assert at['left_toe'][2] > 0.05


def root_angles(name, low, high, count=60):
    """Angles (T, 3) of the root in a BVH while one of its degrees of freedom moves evenly."""
    poses = np.zeros((count, BODY.dimension))
    poses[:, 2] = 4.0
    poses[:, BODY.dof_names.index(name)] = np.linspace(low, high, count)
    moving = MovingSkeleton.of_body(BODY, poses, np.arange(count) / 30.0)
    rows = bvh_text(moving, 30.0).partition('Frame Time:')[2].splitlines()[1:]
    return np.array([row.split() for row in rows], dtype=float)[:, 3:6]


@pytest.mark.parametrize(
    ('name', 'low', 'high'), [('root_z', 0.0, 6.0 * np.pi), ('root_x', -2.9, 2.9)]
)
def test_angles_go_on_where_a_person_turns(name, low, high):
    """No angle jumps by a half or whole turn, because programs interpolate angle by angle."""
    angles = root_angles(name, low, high)
    steps = np.abs(np.diff(angles, axis=0))
    assert steps.max() < 1.01 * np.degrees((high - low) / 59)
    assert np.ptp(angles, axis=0).max() == pytest.approx(np.degrees(high - low), abs=0.01)


def test_gaps_and_other_rates_are_interpolated():
    poses = np.zeros((4, BODY.dimension))
    poses[:, 2] = 4.0
    elbow = BODY.dof_names.index('left_elbow')
    poses[:, elbow] = [0.0, 0.2, 1.0, 1.1]
    poses[:, 0] = [0.0, 0.1, 0.5, 0.55]
    moving = MovingSkeleton.of_body(BODY, poses, np.array([0.0, 0.1, 0.5, 0.55]))
    even = moving.at_rate(20.0)
    np.testing.assert_allclose(even.times, np.arange(12) / 20.0)
    np.testing.assert_allclose(even.places[:, 0], np.arange(12) / 20.0, atol=1e-12)
    turns = Rotation.from_matrix(even.rotations[:, even.names.index('left_elbow')]).magnitude()
    np.testing.assert_allclose(turns, 2.0 * np.arange(12) / 20.0, atol=1e-9)
    alone = MovingSkeleton.of_body(BODY, poses[:1], np.zeros(1)).at_rate(30.0)
    assert len(alone.times) == 1
    with pytest.raises(ValueError, match='wanted 1000000 at most: a lower --fps'):
        MovingSkeleton.of_body(BODY, poses[:2], np.array([0.0, 1e6])).at_rate(30.0)


def test_bodies_whose_segments_move_along_axes_are_refused(tmp_path):
    path = tmp_path / 'long_neck.yaml'
    path.write_text(
        'name: long_neck\nlengths: {trunk: [0.5, 0.1]}\nstature: [trunk]\nstature_extra: 0.1\n'
        'stature_spread: 0.1\nsegments:\n'
        '  - {name: pelvis, diffusion: [0.2, 1.0], dofs: [[root_tz, tz, 0.3, 50]]}\n'
        '  - {name: head, parent: pelvis, length: trunk, diffusion: [0.2, 1.0],\n'
        '     dofs: [[neck_tx, tx, -1, 1]]}\n'
        'joints: {pelvis: [pelvis, start], head: [head, end]}\n'
    )
    body = load_body(path)
    with pytest.raises(ValueError, match='long_neck: wanted one root, which alone moves'):
        MovingSkeleton.of_body(body, np.zeros((1, 2)), np.zeros(1))


def test_the_same_motion_gives_the_same_bytes():
    moving = MovingSkeleton.of_body(BODY, some_poses(), TIMES)
    again = MovingSkeleton.of_body(BODY, some_poses(), TIMES)
    assert bvh_text(moving, RATE) == bvh_text(again, RATE)
