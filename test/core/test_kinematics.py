"""Placing of skeletons: invalid arguments are refused; the tests of `body` check values."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros import core
from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward, joint_positions, placing_of
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
    points = {
        'segments': SKELETON.joint_segments,
        'local': SKELETON.joint_offsets,
        'relative': False,
        'points': np.zeros((2, J, 3)),
    }
    assert_arguments_are_checked(
        core.place_points, {'tree': tree, 'poses': poses, **points}, 'points'
    )


@pytest.mark.parametrize('count', [0, 1, 8, 19])
@pytest.mark.parametrize('turn', [1.0, 1e9])
def test_poses_side_by_side_are_placed_as_each_alone(count, turn):
    poses = np.random.default_rng(0).uniform(-3.0, 3.0, (count, D))
    poses[:, SKELETON.dof_is_rotation] *= turn
    alone = forward(SKELETON, poses).joints().transpose(2, 0, 1)
    assert np.array_equal(joint_positions(SKELETON, poses), alone)
    relative = joint_positions(SKELETON, poses, relative=True)
    assert np.array_equal(relative, alone - alone[:, :1])


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
    del points['directions']
    every = {
        **{name: np.ones((2, D, 3)) for name in ('axes', 'dof_origins')},
        'points': np.ones((2, 2, 3)),
        'result': np.zeros((2, 2, 3, D)),
    }
    assert_arguments_are_checked(core.derive_points, points | every, 'result', free='moves')
    lengths = SKELETON.offset_basis.shape[2]
    lifts = {
        'parents': np.array(SKELETON.parents),
        'basis': SKELETON.offset_basis,
        'columns': np.ones((2, S, 3, 3)),
        'result': np.zeros((2, S, 3, lengths)),
    }
    assert_arguments_are_checked(core.lift_origins, lifts, 'result')
