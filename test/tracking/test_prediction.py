"""The prediction against closed forms and simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.prediction import predict

K = 3


def modes_of(body: Body) -> Modes:
    """Modes whose filtered covariances are correlated, and velocities with them."""
    rng = np.random.default_rng(0)
    d = body.dimension
    n = motion_prior(body).state_dimension
    root = 0.1 * rng.normal(size=(K, n, n))
    states = root @ root.transpose(0, 2, 1)
    poses = body.prior_mean + 0.01 * rng.normal(size=(K, d))
    poses[:, 2] += 3.0
    return replace(
        Modes.blank(K, d),
        poses=poses,
        log_weights=np.log([0.5, 0.3, 0.2]),
        ancestors=np.zeros(K, dtype=np.intp),
        expected=poses,
        jumped=np.ones((K, d), dtype=np.bool_),
        velocities=0.1 * rng.normal(size=(K, d)),
        covariances=np.tile(np.eye(d), (K, 1, 1)),
        filtered=states[:, :d, :d],
        log_likelihoods=np.zeros(K),
        state_covariances=states,
    )


def test_modes_move_as_the_motion_prior_of_their_body_says(human37):
    modes = modes_of(human37)
    predicted, states = predict(modes, human37, motion_prior(human37), 0.04)
    dynamics = motion_prior(human37)
    a, q = dynamics.transition(0.04)
    d = human37.dimension
    known = np.concatenate([modes.poses, modes.velocities], axis=1)
    np.testing.assert_allclose(
        predicted.poses, np.clip((known @ a.T)[:, :d], human37.lower, human37.upper), atol=1e-12
    )
    wanted = a @ modes.state_covariances @ a.T + q
    np.testing.assert_allclose(states.covariances, wanted, atol=1e-12)
    np.testing.assert_array_equal(states.pose_covariances, states.covariances[:, :d, :d])


def test_a_body_of_which_nothing_was_learned_walks_randomly(human32):
    modes = modes_of(human32)
    predicted, states = predict(modes, human32, motion_prior(human32), 0.04)
    np.testing.assert_array_equal(predicted.poses, modes.poses)
    np.testing.assert_allclose(
        states.pose_covariances - modes.filtered,
        np.tile(0.04 * np.diag(human32.rates), (K, 1, 1)),
        atol=1e-13,
    )


def test_a_prediction_is_its_own_ancestor_and_has_not_jumped(human37):
    modes = modes_of(human37)
    predicted, _ = predict(modes, human37, motion_prior(human37), 0.1)
    assert predicted.ancestors.tolist() == [0, 1, 2]
    assert not predicted.jumped.any()
    assert predicted.expected is predicted.poses
    assert predicted.log_weights is modes.log_weights


def test_two_predictions_are_one_over_the_sum_of_times(human37):
    modes = modes_of(human37)
    _, halfway = predict(modes, human37, motion_prior(human37), 0.1)
    d = human37.dimension
    there = replace(
        modes,
        poses=halfway.poses,
        velocities=halfway.means[:, d:],
        state_covariances=halfway.covariances,
    )
    _, twice = predict(there, human37, motion_prior(human37), 0.3)
    _, once = predict(modes, human37, motion_prior(human37), 0.4)
    np.testing.assert_allclose(twice.means, once.means, atol=1e-11)
    np.testing.assert_allclose(twice.covariances, once.covariances, atol=1e-11)
