"""Gravity and floor: invalid arguments are refused; the tests of `body` check values."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import load_body
from hmt_ros.body.ground_terms import FloorPlane, GroundSettings, GroundTerm
from hmt_ros.body.kinematics import forward
from hmt_ros.core import add_ground_energy
from test.core.arguments import assert_arguments_are_checked


def test_the_ground_needs_arguments_that_fit():
    body = load_body('human32')
    d = body.dimension
    # The camera is low, so the feet are below the floor.
    plane = FloorPlane(np.array([0.0, -1.0, 0.0]), 0.01, 0.1, 0.02)
    frames = forward(body.skeleton, np.full((1, d), 0.1))
    (columns,), (origins,) = frames.by_pose()
    (axes,), (dof_origins,) = frames.dofs_by_pose()
    arguments = {
        'ground': GroundTerm(body, GroundSettings(), plane).compiled,
        'columns': columns,
        'origins': origins,
        'axes': axes,
        'dof_origins': dof_origins,
        'wanted': True,
        'gradient': np.zeros(d),
        'hessian': np.zeros((d, d)),
    }
    assert add_ground_energy(*arguments.values()) > 0.0
    assert_arguments_are_checked(add_ground_energy, arguments, 'gradient hessian')
