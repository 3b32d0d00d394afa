"""Placing of skeletons: what does not fit is refused; values are those of the tests of the body."""

from __future__ import annotations

import numpy as np

from hmt_ros import core
from hmt_ros.body import load_body
from hmt_ros.body.kinematics import placing_of
from test.core.arguments import assert_arguments_are_checked

SKELETON = load_body('human32').skeleton
S, D, J = len(SKELETON.parents), SKELETON.dimension, len(SKELETON.joint_segments)


def test_poses_are_placed_with_arguments_that_fit():
    tree, poses = placing_of(SKELETON), np.zeros((2, D))
    frames = {
        'columns': np.zeros((2, S, 3, 3)),
        'origins': np.zeros((2, S, 3)),
        'axes': np.zeros((2, D, 3)),
        'dof_origins': np.zeros((2, D, 3)),
    }
    assert_arguments_are_checked(
        core.place_poses, {'tree': tree, 'poses': poses, **frames}, ' '.join(frames)
    )
    joints = {
        'joint_segments': SKELETON.joint_segments,
        'joint_offsets': SKELETON.joint_offsets,
        'joints': np.zeros((2, J, 3)),
    }
    assert_arguments_are_checked(
        core.place_joints, {'tree': tree, 'poses': poses, **joints}, 'joints'
    )


def test_derivatives_need_arguments_that_fit():
    points = {
        'moves': SKELETON.moves,
        'is_rotation': SKELETON.dof_is_rotation,
        'axes': np.ones((D, 3)),
        'dof_origins': np.ones((D, 3)),
        'segments': np.array([0, S - 1]),
        'points': np.ones((2, 3)),
        'directions': np.ones((2, 3)),
        'result': np.zeros((2, D)),
    }
    assert_arguments_are_checked(core.derive_along, points, 'result', free='moves')
    lengths = SKELETON.offset_basis.shape[2]
    lifts = {
        'parents': np.array(SKELETON.parents),
        'basis': SKELETON.offset_basis,
        'columns': np.ones((S, 3, 3, 2)),
        'result': np.zeros((S, 3, lengths, 2)),
    }
    assert_arguments_are_checked(core.lift_origins, lifts, 'result')
