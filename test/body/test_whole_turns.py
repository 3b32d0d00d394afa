"""Angles that pass whole turns."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import load_body
from hmt_ros.body.mirror import TURN, endless, without_turns

BODY = load_body('human37')
YAW = BODY.dof_names.index('root_z')


def test_the_heading_alone_goes_round():
    assert [name for name, free in zip(BODY.dof_names, endless(BODY), strict=True) if free] == [
        'root_z'
    ]


def test_each_pose_goes_on_from_the_nearest():
    rng = np.random.default_rng(0)
    before = BODY.prior_mean + 0.05 * rng.normal(size=(3, BODY.dimension))
    before[:, YAW] = [0.1 + TURN, 0.1 + 0.5 * TURN, -2.0]
    poses = before[[2, 0, 1]] + 0.02 * rng.normal(size=(3, BODY.dimension))
    shifted = poses.copy()
    shifted[:, YAW] += TURN * np.array([3, -2, 0])
    np.testing.assert_allclose(without_turns(BODY, shifted, before), poses, atol=1e-12)
    # All else is unchanged.
    found = without_turns(BODY, shifted, before)
    others = np.delete(np.arange(BODY.dimension), YAW)
    np.testing.assert_array_equal(found[:, others], shifted[:, others])


def test_a_turn_that_a_person_makes_is_none_to_take_out():
    """From image to image, a heading continues over any number of turns."""
    pose, yaw = np.tile(BODY.prior_mean, (1, 1)), 0.0
    for step in range(1, 100):
        seen = pose.copy()
        seen[:, YAW] = (0.3 * step + np.pi) % TURN - np.pi
        pose = without_turns(BODY, seen, pose)
        yaw += 0.3
        assert np.isclose(pose[0, YAW], yaw)
