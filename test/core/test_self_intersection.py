"""Overlaps of parts: invalid arguments are refused; the tests of `body` check values."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.self_intersection import overlaps_of
from hmt_ros.core import add_overlaps, overlap_depths
from test.core.arguments import assert_arguments_are_checked

BODY = load_body('human32')
# A pose with arms through the trunk, so that overlaps are evaluated.
FRAMES = forward(BODY.skeleton, np.random.default_rng(7).normal(size=(1, BODY.dimension)))
(COLUMNS,), (ORIGINS,) = FRAMES.by_pose()
(AXES,), (DOF_ORIGINS,) = FRAMES.dofs_by_pose()


def test_overlaps_need_arguments_that_fit():
    d = BODY.dimension
    arguments = {
        'overlaps': overlaps_of(BODY, 0.03),
        'columns': COLUMNS,
        'origins': ORIGINS,
        'axes': AXES,
        'dof_origins': DOF_ORIGINS,
        'wanted': True,
        'value': np.zeros(1),
        'gradient': np.zeros(d),
        'hessian': np.zeros((d, d)),
    }
    add_overlaps(*arguments.values())
    assert arguments['value'][0] > 0.0
    assert_arguments_are_checked(add_overlaps, arguments, 'value gradient hessian')


def test_depths_need_arguments_that_fit():
    parts, first, second, *_ = overlaps_of(BODY, 0.03)
    arguments = {
        'parts': parts,
        'first': first,
        'second': second,
        'columns': COLUMNS,
        'origins': ORIGINS,
        'depths': np.empty(len(first)),
    }
    assert_arguments_are_checked(overlap_depths, arguments, 'depths')
