"""Distinct poses against all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.flips.interpretation_tree import distinct_poses


@pytest.fixture(scope='module')
def body():
    return load_body('human34')


def other_angles(body, pose, dofs):
    """The same rotation under its other triple Rx(a + pi) Ry(pi - b) Rz(c + pi)."""
    i, j, k = body.skeleton.dof_index(dofs)
    other = pose.copy()
    other[[i, j, k]] = pose[i] + np.pi, np.pi - pose[j], pose[k] + np.pi
    return other


def test_a_pose_under_other_angles_counts_once(body, random_poses):
    (pose,) = random_poses(body, 1, 0)
    same = [pose]
    for limb in ('left_shoulder', 'right_shoulder', 'left_hip', 'right_hip'):
        same += [other_angles(body, p, [f'{limb}_{x}' for x in 'xyz']) for p in list(same)]
    same.append(pose + 2 * np.pi * body.skeleton.dof_is_rotation)
    same = np.array(same)
    assert len(same) == 17
    assert np.abs(same[1:] - pose).max(1).min() > 1.0
    assert distinct_poses(body.joint_positions(same), 1e-6).kept.tolist() == [0]


def test_the_twist_of_a_straight_limb_makes_no_other_pose(body):
    poses = np.tile(body.prior_mean, (2, 1))
    poses[:, 2] = 3.0
    poses[:, body.skeleton.dof_index(['left_elbow', 'left_wrist_x', 'left_wrist_y'])] = 0.0
    poses[1, body.dof_names.index('left_shoulder_z')] += 0.8
    assert len(distinct_poses(body.joint_positions(poses), 1e-6).kept) == 1
    poses[:, body.dof_names.index('left_elbow')] = 0.5
    assert len(distinct_poses(body.joint_positions(poses), 1e-2).kept) == 2


@pytest.mark.parametrize('most', [None, 5])
def test_it_is_what_all_pairs_say(most):
    rng = np.random.default_rng(1)
    joints = rng.uniform(-1, 1, (12, 1, 4, 3)) + rng.uniform(-0.2, 0.2, (12, 20, 4, 3))
    joints = rng.permutation(joints.reshape(-1, 4, 3))
    kept, owner = [], []
    for i in range(len(joints)):
        gaps = np.linalg.norm(joints[kept] - joints[i], axis=2).max(1) if kept else np.array([9.0])
        if gaps.min() < 0.3:
            owner.append(int(gaps.argmin()))
        elif most is None or len(kept) < most:
            owner.append(len(kept))
            kept.append(i)
        else:
            owner.append(-1)
    found = distinct_poses(joints, 0.3, most)
    assert found.kept.tolist() == kept
    assert found.owner.tolist() == owner
    assert len(kept) > 4


def test_no_poses_and_wrong_shapes():
    kept, owner = distinct_poses(np.empty((0, 5, 3)), 0.1)
    assert (len(kept), len(owner)) == (0, 0)
    with pytest.raises(ValueError, match=r'shape \(N, J, 3\), saw \(4, 3\)'):
        distinct_poses(np.zeros((4, 3)), 0.1)
