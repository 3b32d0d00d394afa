"""Iterative inverse kinematics, compared with known poses, differences and dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.inverse_kinematics import solve_joint_positions
from hmt_ros.body import Body, load_body

SIGMA = 0.01


@pytest.fixture(scope='module', params=['human37', 'human34', 'human32'])
def body(request) -> Body:
    return load_body(request.param)


@pytest.fixture(scope='module')
def small() -> Body:
    return load_body('human32')


def near(body, poses, spread, seed):
    noise = np.random.default_rng(seed).normal(0, spread, poses.shape)
    return np.clip(poses + noise, body.lower, body.upper)


def inner_poses(body, count, seed):
    """Poses well inside the limits, with bent elbows and knees, so joints determine all angles."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(body.lower, -1.0), np.minimum(body.upper, 1.0)
    poses = 0.5 * (low + high) + 0.25 * (high - low) * rng.uniform(-1, 1, (count, body.dimension))
    poses[:, :3] = [0.0, 0.0, 3.0] + 0.3 * rng.normal(size=(count, 3))
    return poses


def plain_energy(body, pose, target, weights, prior_weight):
    """1/2 sum w |joint - target|^2 + the prior, one pose, term by term."""
    joints = body.joint_positions(pose[None])[0]
    value = 0.0
    for joint, goal, weight in zip(joints, target, weights):
        if np.isfinite(goal).all():
            value += 0.5 * weight * ((joint - goal) ** 2).sum()
    for x, mean, sigma in zip(pose, body.prior_mean, body.prior_sigma):
        value += 0.5 * prior_weight * ((x - mean) / sigma) ** 2
    return value


def test_recovers_poses_from_joints(body):
    truth = inner_poses(body, 12, 0)
    joints = body.joint_positions(truth)
    found = solve_joint_positions(body, near(body, truth, 0.15, 1), joints, prior_weight=1e-9)
    assert np.abs(body.joint_positions(found.x) - joints).max() < 1e-5
    assert found.value.max() < 1e-4
    # Head and hands do not twist, so the joints determine all angles.
    assert np.abs(found.x - truth).max() < 1e-3


def test_derivatives_at_the_start_are_those_of_the_energy(body):
    """Without steps the result is the start, with its value, gradient and Hessian."""
    poses = inner_poses(body, 3, 2)
    rng = np.random.default_rng(3)
    targets = body.joint_positions(poses) + 0.05 * rng.normal(size=(3, len(body.joint_names), 3))
    targets[0, 4], targets[2, :3] = np.nan, np.nan
    sigma = rng.uniform(0.01, 0.03, targets.shape[:2])
    prior_weight = 0.7
    found = solve_joint_positions(
        body, poses, targets, sigma=sigma, prior_weight=prior_weight, max_iterations=0
    )
    assert np.array_equal(found.x, poses)
    jacobians = body.joint_jacobians(poses)
    for n, pose in enumerate(poses):

        def energy(x, n=n):
            return plain_energy(body, x, targets[n], sigma[n] ** -2.0, prior_weight)

        assert found.value[n] == pytest.approx(energy(pose), rel=1e-12)
        slopes = [
            (energy(pose + step) - energy(pose - step)) / 2e-6
            for step in 1e-6 * np.eye(body.dimension)
        ]
        assert np.allclose(found.gradient[n], slopes, rtol=1e-5, atol=1e-4)
        seen = np.isfinite(targets[n]).all(1)
        j = (jacobians[n] / sigma[n][:, None, None])[seen].reshape(-1, body.dimension)
        wanted = j.T @ j + prior_weight * np.diag(body.prior_sigma**-2.0)
        assert np.allclose(found.hessian[n], wanted, rtol=1e-9, atol=1e-7 * np.abs(wanted).max())


def test_the_minimum_is_one(small):
    """No small change within the limits has less energy."""
    truth = inner_poses(small, 4, 4)
    rng = np.random.default_rng(5)
    targets = small.joint_positions(truth) + 0.03 * rng.normal(size=(4, 19, 3))
    found = solve_joint_positions(
        small, truth, targets, sigma=SIGMA, prior_weight=0.1, max_iterations=200
    )
    weights = np.full(19, SIGMA**-2.0)
    for n in range(4):
        here = plain_energy(small, found.x[n], targets[n], weights, 0.1)
        assert here == pytest.approx(found.value[n], rel=1e-9)
        for _ in range(30):
            other = np.clip(
                found.x[n] + 1e-2 * rng.normal(size=small.dimension), small.lower, small.upper
            )
            assert plain_energy(small, other, targets[n], weights, 0.1) > here


def test_joints_that_do_not_matter(small):
    """NaN has the same effect as omitting a joint."""
    truth = inner_poses(small, 3, 6)
    start = near(small, truth, 0.1, 7)
    joints = small.joint_positions(truth)
    names = [x for x in small.joint_names if 'wrist' not in x]
    blanked = joints.copy()
    blanked[:, small.skeleton.joint_index(['left_wrist', 'right_wrist'])] = np.nan
    left_out = solve_joint_positions(
        small, start, joints[:, small.skeleton.joint_index(names)], names
    )
    nan = solve_joint_positions(small, start, blanked)
    assert np.allclose(nan.x, left_out.x, atol=1e-8)
    kept = small.joint_positions(nan.x)[:, small.skeleton.joint_index(names)]
    assert np.abs(kept - joints[:, small.skeleton.joint_index(names)]).max() < 5e-3


def test_limits_hold(small):
    """A forearm with a target behind its limit stays straight."""
    pose = np.zeros((1, small.dimension))
    pose[0, 2] = 3.0
    elbow = small.dof_names.index('left_elbow')
    pose[0, elbow] = 0.5
    beyond = pose.copy()
    beyond[0, elbow] = -0.6
    wanted = small.joint_positions(beyond)
    found = solve_joint_positions(small, pose, wanted, free_dofs=('left_elbow',), prior_weight=0.0)
    assert found.x[0, elbow] == small.lower[elbow] == 0.0
    assert not found.free[0, elbow]
    whole = solve_joint_positions(small, pose, wanted)
    assert (whole.x >= small.lower).all()
    assert (whole.x <= small.upper).all()


def test_what_does_not_fit_is_refused(small):
    pose = inner_poses(small, 1, 12)
    joints = small.joint_positions(pose)
    with pytest.raises(ValueError, match=r'targets have shape .* wanted \(1, 19, 3\)'):
        solve_joint_positions(small, pose, joints[:, :-1])
    with pytest.raises(KeyError, match='no joint'):
        solve_joint_positions(small, pose, joints[:, :1], ['tail'])
    with pytest.raises(KeyError, match='no degree of freedom'):
        solve_joint_positions(small, pose, joints, free_dofs=['tail'])


def test_targets_along_rays_leave_the_distance_free():
    """The joints move onto the rays, at any distance."""
    body = load_body('human34')
    start = np.tile(body.prior_mean, (4, 1))
    start[:, :3] = [0.0, 0.1, 3.0]
    rng = np.random.default_rng(0)
    goal = np.clip(start + 0.1 * rng.normal(size=start.shape), body.lower, body.upper)
    names = ('left_knee', 'left_ankle', 'right_wrist', 'head')
    which = body.skeleton.joint_index(names)
    seen = body.joint_positions(goal)[:, which]
    nearer = seen * rng.uniform(0.5, 2.0, (4, 4, 1))
    found, same = (
        solve_joint_positions(body, start, x, names, along_rays=True, prior_weight=1e-6).x
        for x in (seen, nearer)
    )
    joints = body.joint_positions(found)[:, which]
    rays = seen / np.linalg.norm(seen, axis=2, keepdims=True)
    assert np.linalg.norm(np.cross(joints, rays), axis=2).max() < 1e-4
    assert np.abs(same - found).max() < 1e-6
