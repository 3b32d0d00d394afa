"""The point estimate: expected, steady, and never between two ways to face."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.mirror import left_directions, reverse_depth, root_rotations
from hmt_ros.tracking.point_estimate import SWITCH, PointEstimate

DT = 1.0 / 30.0


@pytest.fixture
def pose(human32):
    result = human32.prior_mean.copy()
    result[:3] = (0.1, 0.0, 4.0)
    return result


def near(pose, spread, count, seed=0):
    noise = np.random.default_rng(seed).normal(0.0, spread, (count, len(pose)))
    return pose + noise


def test_the_first_estimate_is_the_expected_pose(human32, pose):
    poses = np.clip(near(pose, 0.02, 3), human32.lower, human32.upper)
    weights = np.array([0.5, 0.3, 0.2])
    found = PointEstimate().update(human32, poses, weights, 0.0)
    root = slice(3, 6)
    other = np.r_[0:3, 6 : len(pose)]
    assert found[other] == pytest.approx((weights @ poses)[other])
    turned = root_rotations(human32, found[None])[0] @ root_rotations(human32, pose[None])[0].T
    assert np.trace(turned) == pytest.approx(3.0, abs=1e-2)
    assert found[root] == pytest.approx((weights @ poses)[root], abs=1e-3)


def test_it_trembles_less_than_the_modes_and_follows_them(human32, pose):
    estimate, shown, given = PointEstimate(), [], []
    knee = human32.dof_names.index('left_knee')
    for t in range(60):
        moved = near(pose, 0.03, 1, seed=t)[0]
        moved[knee] = -0.3 - 0.02 * t + 0.03 * (-1) ** t
        moved = np.clip(moved, human32.lower, human32.upper)
        given.append(moved[knee])
        shown.append(estimate.update(human32, moved[None], np.ones(1), DT)[knee])
    tremble = [np.abs(np.diff(x[10:], n=2)).mean() for x in (shown, given)]
    assert tremble[0] < 0.4 * tremble[1]
    late = -0.3 - 0.02 * np.arange(60) - shown
    assert np.abs(late[20:]).max() < 0.06


def test_it_keeps_its_way_until_the_other_has_the_weight(human32, pose):
    estimate = PointEstimate()
    both = np.concatenate([pose[None], reverse_depth(human32, pose[None])])
    way = left_directions(human32, both)
    estimate.update(human32, both[:1], np.ones(1), 0.0)
    kept = estimate.update(human32, both, np.array([1.0 - SWITCH + 0.01, SWITCH - 0.01]), DT)
    assert left_directions(human32, kept[None])[0] @ way[0] > 0.99
    taken = estimate.update(human32, both, np.array([0.3, 0.7]), DT)
    assert left_directions(human32, taken[None])[0] @ way[1] > 0.99
    assert taken == pytest.approx(both[1], abs=1e-6)


def test_a_turn_over_half_a_circle_is_the_short_way(human32, pose):
    estimate = PointEstimate()
    root_z = human32.dof_names.index('root_z')
    first, second = pose.copy(), pose.copy()
    first[root_z], second[root_z] = np.pi - 0.02, -np.pi + 0.02
    estimate.update(human32, first[None], np.ones(1), 0.0)
    found = estimate.update(human32, second[None], np.ones(1), DT)
    ways = left_directions(human32, np.stack([first, found, second]))
    assert ways[1] @ ways[0] > ways[2] @ ways[0] - 1e-6
