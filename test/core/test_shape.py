"""Sums over residuals by the shape: invalid arguments are refused."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.kinematics import placing_of
from hmt_ros.body.shape import ShapeSpace
from hmt_ros.core import sum_shape_residuals
from test.core.arguments import assert_arguments_are_checked

SPACE = ShapeSpace(load_body('human32'))
SKELETON = SPACE.body.skeleton
S, D, J = len(SKELETON.parents), SKELETON.dimension, len(SKELETON.joint_segments)
P, N = SPACE.size, 2
LIST = np.full((N, 3, 9), 0.5)
LIST[:, 0, 0] = 2
ARGUMENTS = {
    'table': SPACE._table,
    'lifts': np.ones((N, S, 3, SPACE.lengths)),
    'parents': placing_of(SKELETON).parents,
    'dof_segments': SKELETON.dof_segments,
    'is_rotation': SKELETON.dof_is_rotation,
    'joint_segments': SKELETON.joint_segments,
    'columns': np.ones((N, S, 3, 3)),
    'origins': np.ones((N, S, 3)),
    'axes': np.ones((N, D, 3)),
    'dof_origins': np.ones((N, D, 3)),
    'of_flesh': LIST,
    'of_joints': LIST,
    'gradient': np.zeros((N, P)),
    'curvature': np.zeros((N, P, P)),
    'mixed': np.zeros((N, P, D)),
}
OUTPUTS = 'gradient curvature mixed'


def test_sums_need_arguments_that_fit():
    assert_arguments_are_checked(sum_shape_residuals, ARGUMENTS, OUTPUTS)


@pytest.mark.parametrize('name', ['of_flesh', 'of_joints'])
@pytest.mark.parametrize(('row', 'number'), [(0, 3), (0, -1), (0, np.nan), (1, 1000), (2, -1)])
def test_lists_count_their_rows_and_name_what_is_there(name, row, number):
    spoilt = LIST.copy()
    spoilt[1, row, 0] = number
    with pytest.raises(ValueError, match=name):
        sum_shape_residuals(*{**ARGUMENTS, name: spoilt}.values())
