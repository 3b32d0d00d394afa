"""States of modes, compared with a Kalman filter and a brute-force joint Gaussian."""

from __future__ import annotations

import numpy as np

from hmt_ros.inference.damped_velocity import DampedVelocity
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.motion_states import PredictedStates, fused

D = 3
DYNAMICS = DampedVelocity.of(
    [1.0, 4.0, 9.0], [[2.0, 0.8, 0.3], [0.8, 3.0, -1.0], [0.3, -1.0, 5.0]], [1e-4, 1e-3, 1e-2]
)
STILL = np.zeros((1, D), dtype=np.bool_)
FIRST = np.zeros(1, dtype=np.intp)


def predicted(seed: int = 0, count: int = 1) -> PredictedStates:
    rng = np.random.default_rng(seed)
    root = 0.3 * rng.normal(size=(count, 2 * D, 2 * D))
    return PredictedStates(
        DYNAMICS,
        rng.normal(size=(count, 2 * D)),
        root @ root.swapaxes(1, 2) + 1e-3 * np.eye(2 * D),
        np.array([0.1, 0.2, 0.4]),
    )


def test_over_a_sequence_it_is_the_kalman_filter():
    """Energies of images are parabolas; intervals are uneven."""
    rng = np.random.default_rng(3)
    noise = np.diag([0.02, 0.05, 0.01])
    x, known = rng.normal(size=(1, 2 * D)), DYNAMICS.states(np.eye(D)[None])
    mean, covariance = x[0].copy(), known[0].copy()
    see = np.eye(D, 2 * D)
    for interval in rng.uniform(0.01, 0.3, 12):
        seen = rng.normal(size=D)
        # The filter: an optimum, its inverse Hessian, and the velocity from both.
        states = PredictedStates(DYNAMICS, *DYNAMICS.predict(x, known, interval), np.zeros(D))
        prior, image = np.linalg.inv(states.pose_covariances[0]), np.linalg.inv(noise)
        found = np.linalg.inv(prior + image)
        pose = found @ (prior @ states.poses[0] + image @ seen)
        velocities, known = states.given(FIRST, STILL, pose[None], found[None])
        x = np.concatenate([pose[None], velocities], axis=1)
        # The Kalman filter of the states.
        a, q = DYNAMICS.transition(interval)
        mean, covariance = a @ mean, a @ covariance @ a.T + q
        gain = covariance @ see.T @ np.linalg.inv(see @ covariance @ see.T + noise)
        mean = mean + gain @ (seen - see @ mean)
        covariance = covariance - gain @ see @ covariance
        np.testing.assert_allclose(x[0], mean, atol=1e-9)
        np.testing.assert_allclose(known[0], covariance, atol=1e-9)


def test_limbs_that_jumped_tell_nothing_and_have_a_velocity_of_which_nothing_is_known():
    """Other limbs are conditioned on the joint Gaussian without the jumped ones."""
    states = predicted()
    jumped = np.array([[False, True, False]])
    pose = states.poses + np.array([[0.1, 2.0, -0.2]])
    found = np.diag([0.01, 0.5, 0.02])
    velocities, covariances = states.given(FIRST, jumped, pose, found[None])
    assert velocities[0, 1] == 0.0
    stationary = DYNAMICS.unknown_velocity
    assert covariances[0, 4, 4] == stationary[1, 1]
    assert not covariances[0, 4, [0, 1, 2, 3, 5]].any()
    others, own = np.array([0, 2]), np.array([3, 5])
    p = states.covariances[0]
    gain = p[np.ix_(own, others)] @ np.linalg.inv(p[np.ix_(others, others)])
    wanted = states.means[0, own] + gain @ np.array([0.1, -0.2])
    np.testing.assert_allclose(velocities[0, [0, 2]], wanted, atol=1e-5)
    np.testing.assert_allclose(
        covariances[0][np.ix_(own, others)], gain @ found[np.ix_(others, others)], atol=1e-5
    )


def test_covariances_stay_positive_definite_when_poses_are_hardly_known_or_exactly():
    states = predicted(5, 4)
    rng = np.random.default_rng(0)
    ancestors = np.array([2, 0, 1, 3, 3])
    for scale in (1e-8, 1.0, 1e3):
        root = rng.normal(size=(5, D, D))
        found = scale * (root @ root.swapaxes(1, 2) + 0.1 * np.eye(D))
        jumped = rng.random((5, D)) < 0.4
        _, covariances = states.given(ancestors, jumped, states.poses[ancestors], found)
        np.testing.assert_array_equal(covariances, covariances.swapaxes(1, 2))
        assert np.linalg.eigvalsh(covariances).min() > -1e-12 * scale
        np.testing.assert_array_equal(covariances[:, :D, :D], found)


def test_a_random_walk_has_no_velocities():
    walk = LinearGaussianDynamics.random_walk(np.ones(D))
    states = PredictedStates(walk, np.zeros((1, D)), np.eye(D)[None], np.zeros(D))
    velocities, covariances = states.given(FIRST, STILL, np.ones((1, D)), 2.0 * np.eye(D)[None])
    assert not velocities.any()
    np.testing.assert_array_equal(covariances[0], 2.0 * np.eye(D))


def test_limbs_that_jumped_may_miss_by_what_the_body_wanders():
    states = predicted(1, 3)
    ancestors = np.array([2, 0])
    jumped = np.array([[False, False, False], [True, False, True]])
    own = states.covariances_of(ancestors, jumped)
    np.testing.assert_array_equal(own[0], states.pose_covariances[2])
    np.testing.assert_allclose(own[1] - states.pose_covariances[0], np.diag([0.1, 0.0, 0.4]))
    precisions = states.precisions_of(ancestors, jumped, np.linalg.inv(states.pose_covariances))
    np.testing.assert_allclose(precisions @ own, np.tile(np.eye(D), (2, 1, 1)), atol=1e-9)
    searched = states.searched - states.pose_covariances
    np.testing.assert_allclose(searched, np.tile(np.diag([0.1, 0.2, 0.4]), (3, 1, 1)))


def test_fused_covariances_are_those_of_products():
    a, b = predicted(1, 3).pose_covariances, predicted(2, 3).pose_covariances
    wanted = np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b))
    np.testing.assert_allclose(fused(a, b), wanted, atol=1e-12)
