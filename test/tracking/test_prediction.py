"""The prediction against closed forms and simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.prediction import predict, updated_velocities

K = 3


@pytest.fixture
def modes(human32) -> Modes:
    rng = np.random.default_rng(0)
    d = human32.dimension
    root = 0.1 * rng.normal(size=(K, d, d))
    poses = human32.prior_mean + 0.01 * rng.normal(size=(K, d))
    poses[:, 2] += 3.0
    return Modes(
        poses=poses,
        log_weights=np.log([0.5, 0.3, 0.2]),
        ancestors=np.zeros(K, dtype=np.intp),
        expected=poses,
        jumped=np.ones((K, d), dtype=np.bool_),
        textures=None,
        texture_rows=np.arange(K)[::-1],
        velocities=0.1 * rng.normal(size=(K, d)),
        covariances=np.tile(np.eye(d), (K, 1, 1)),
        filtered=root @ root.transpose(0, 2, 1),
        log_likelihoods=np.zeros(K),
        energies=np.zeros(K),
    )


@pytest.mark.parametrize('kept', [0.0, 0.7, 1.0])
def test_modes_move_by_the_share_of_their_velocity_that_lasts(human32, modes, kept):
    predicted, covariances = predict(modes, human32, 0.04, kept)
    wanted = modes.poses + kept * 0.04 * modes.velocities
    np.testing.assert_allclose(
        predicted.poses, np.clip(wanted, human32.lower, human32.upper), atol=1e-15
    )
    np.testing.assert_allclose(
        covariances - modes.filtered, np.tile(0.04 * np.diag(human32.rates), (K, 1, 1)), atol=1e-13
    )


def test_a_prediction_is_its_own_ancestor_and_has_not_jumped(human32, modes):
    predicted, _ = predict(modes, human32, 0.1, 0.5)
    assert predicted.ancestors.tolist() == [0, 1, 2]
    assert not predicted.jumped.any()
    assert predicted.expected is predicted.poses
    assert predicted.texture_rows.tolist() == [2, 1, 0]
    assert predicted.log_weights is modes.log_weights


def test_covariances_of_two_predictions_are_those_of_one_over_the_sum_of_times(human32, modes):
    still = replace(modes, velocities=np.zeros_like(modes.poses))
    _, halfway = predict(still, human32, 0.1, 1.0)
    _, twice = predict(replace(still, filtered=halfway), human32, 0.3, 1.0)
    _, once = predict(still, human32, 0.4, 1.0)
    np.testing.assert_allclose(twice, once, atol=1e-13)


def test_predictions_stay_within_the_limits(human32, modes):
    fast = replace(modes, velocities=np.full_like(modes.poses, 1e6))
    predicted, _ = predict(fast, human32, 1.0, 1.0)
    assert np.array_equal(predicted.poses, np.tile(human32.upper, (K, 1)))


@pytest.mark.parametrize('gain', [0.25, 0.5, 1.0])
def test_velocity_follows_a_uniform_motion_geometrically(gain):
    """From rest, after n images a share 1 - (1 - gain)^n of the velocity is known."""
    truth, dt = np.array([[0.3, -2.0]]), 0.05
    velocity = np.zeros((1, 2))
    for n in range(1, 9):
        before = (n - 1) * dt * truth
        velocity = updated_velocities(velocity, before, before + dt * truth, dt, gain)
        assert np.allclose(velocity, (1 - (1 - gain) ** n) * truth, atol=1e-12)


def test_velocity_of_a_mode_that_rests_decays():
    place, velocity = np.array([[1.0, 2.0]]), np.array([[1.0, -3.0]])
    for _ in range(3):
        velocity = updated_velocities(velocity, place, place, 0.1, 0.4)
    assert np.allclose(velocity, 0.6**3 * np.array([[1.0, -3.0]]), atol=1e-14)
