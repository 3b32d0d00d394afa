"""Classes of large ambiguities, and the slots that they keep."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.mirror import left_directions, reverse_depth
from hmt_ros.tracking.ambiguities import ambiguity_classes
from hmt_ros.tracking.proposals.headings import turned
from hmt_ros.tracking.selection import choose_hypotheses, heads_of_classes


@pytest.fixture
def walking(human32):
    """A pose from the side: the ankles are apart in the image, the trunk leans to the camera."""
    pose = human32.prior_mean.copy()
    pose[:3] = (0.0, 0.0, 4.0)
    names = human32.dof_names
    pose[names.index('root_z')] += 1.2
    pose[names.index('left_hip_x')] = -0.5
    pose[names.index('right_hip_x')] = 0.4
    return np.clip(pose, human32.lower, human32.upper)


def test_a_reversal_faces_the_other_way(human32, walking):
    front = turned(human32, walking, 8)[2]
    poses = np.concatenate([front[None], reverse_depth(human32, front[None])])
    classes = ambiguity_classes(human32, poses, front)
    assert classes[0] == 0
    assert classes[1] & 1


def test_exchanged_legs_are_another_class(human32, walking):
    exchanged = walking.copy()
    for left in [name for name in human32.dof_names if name.startswith('left_hip_x')]:
        a, b = (human32.dof_names.index(x) for x in (left, left.replace('left', 'right')))
        exchanged[a], exchanged[b] = walking[b], walking[a]
    assert list(ambiguity_classes(human32, np.stack([walking, exchanged]), walking) & 4) == [0, 4]


def test_each_class_within_reach_keeps_a_hypothesis():
    classes = np.array([0, 0, 1, 1, 4, 2])
    log_weights = np.array([0.0, -1.0, -7.0, -6.0, -2.0, -30.0])
    first = heads_of_classes(classes, log_weights, 10.0, 4)
    assert first == [4, 3]
    assert heads_of_classes(classes, log_weights, 10.0, 1) == [4]
    joints = 0.3 * np.random.default_rng(0).normal(size=(6, 4, 3))
    kept = choose_hypotheses(joints, log_weights, 3, first=first)
    assert list(kept.chosen) == [0, 4, 3]


def test_a_pose_turned_about_its_spine(human32, walking):
    poses = turned(human32, walking, 8)
    joints = human32.joint_positions(poses)
    neck = human32.skeleton.joint_index(['neck'])[0]
    assert poses[0] == pytest.approx(walking, abs=1e-9)
    assert np.abs(joints[:, neck] - joints[0, neck]).max() < 1e-9
    left = left_directions(human32, poses)
    assert left[4] @ left[0] < -0.8
    turn = [float(left[i] @ left[i + 1]) for i in range(7)]
    assert np.ptp(turn) < 0.2
