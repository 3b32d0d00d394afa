"""Motion models against closed forms and simulation."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.tracking.dynamics import DynamicsSettings, predict, update_velocities

K, D = 3, 5


@pytest.fixture
def modes():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(K, D, D))
    return rng.normal(size=(K, D)), root @ root.transpose(0, 2, 1), rng.normal(size=(K, D))


RATES = np.array([0.1, 0.2, 0.4, 0.8, 1.6])


def test_a_random_walk_stays_and_spreads(modes):
    means, covariances, velocities = modes
    settings = DynamicsSettings(model='random_walk')
    moved, spread = predict(settings, RATES, means, covariances, velocities, 0.25)
    assert np.array_equal(moved, means)
    for k in range(K):
        assert np.allclose(spread[k] - covariances[k], 0.25 * np.diag(RATES), atol=1e-14)


def test_prediction_is_the_distribution_of_small_random_steps(modes):
    """A random walk in many steps, simulated: the same covariance as in one."""
    means, covariances, velocities = modes
    settings = DynamicsSettings(model='random_walk')
    rng = np.random.default_rng(1)
    n, steps, dt = 40_000, 10, 0.5
    x = means[0] + rng.normal(size=(n, D)) @ np.linalg.cholesky(covariances[0]).T
    for _ in range(steps):
        x = x + np.sqrt(RATES * dt / steps) * rng.normal(size=(n, D))
    moved, spread = predict(settings, RATES, means[:1], covariances[:1], velocities[:1], dt)
    scale = np.sqrt(np.outer(np.diag(spread[0]), np.diag(spread[0])))
    assert np.abs((np.cov(x.T) - spread[0]) / scale).max() < 5 * np.sqrt(2 / n)
    assert np.abs((x.mean(0) - moved[0]) / np.sqrt(np.diag(spread[0]))).max() < 5 / np.sqrt(n)


@pytest.mark.parametrize('kept', [0.0, 0.7, 1.0])
def test_constant_velocity(modes, kept):
    means, covariances, velocities = modes
    settings = DynamicsSettings(velocity_kept=kept)
    moved, spread = predict(settings, RATES, means, covariances, velocities, 0.04)
    assert np.allclose(moved, means + kept * 0.04 * velocities, atol=1e-15)
    assert np.allclose(spread - covariances, 0.04 * np.diag(RATES), atol=1e-14)


def test_two_predictions_are_one_over_the_sum_of_times(modes):
    means, covariances, velocities = modes
    settings = DynamicsSettings(velocity_kept=1.0)
    halfway = predict(settings, RATES, means, covariances, velocities, 0.1)
    twice = predict(settings, RATES, *halfway, velocities, 0.3)
    once = predict(settings, RATES, means, covariances, velocities, 0.4)
    assert np.allclose(twice[0], once[0], atol=1e-14)
    assert np.allclose(twice[1], once[1], atol=1e-14)


def test_inputs_are_not_changed(modes):
    copies = [x.copy() for x in modes]
    predict(DynamicsSettings(), RATES, *modes, 0.1)
    update_velocities(DynamicsSettings(), modes[2], modes[0], modes[0] + 1, 0.1)
    assert all(np.array_equal(a, b) for a, b in zip(modes, copies))


@pytest.mark.parametrize('gain', [0.25, 0.5, 1.0])
def test_velocity_follows_a_uniform_motion_geometrically(gain):
    """From rest, after n images a share 1 - (1 - gain)^n of the velocity is known."""
    settings = DynamicsSettings(velocity_gain=gain)
    truth, dt = np.array([[0.3, -2.0]]), 0.05
    velocity = np.zeros((1, 2))
    for n in range(1, 9):
        before = (n - 1) * dt * truth
        velocity = update_velocities(settings, velocity, before, before + dt * truth, dt)
        assert np.allclose(velocity, (1 - (1 - gain) ** n) * truth, atol=1e-12)


def test_velocity_of_a_mode_that_rests_decays():
    settings = DynamicsSettings(velocity_gain=0.4)
    place = np.array([[1.0, 2.0]])
    velocity = np.array([[1.0, -3.0]])
    for _ in range(3):
        velocity = update_velocities(settings, velocity, place, place, 0.1)
    assert np.allclose(velocity, 0.6**3 * np.array([[1.0, -3.0]]), atol=1e-14)


@pytest.mark.parametrize('name', ['human37', 'human34', 'human32'])
def test_rates_are_squares_of_the_deviations_by_part(name):
    skeleton = load_body(name).skeleton
    values = {
        'translation': 0.11, 'root': 0.13, 'trunk': 0.17, 'hip': 0.19, 'knee': 0.23,
        'shoulder': 0.29, 'elbow': 0.31, 'neck': 0.37, 'extremity': 0.41,
    }  # fmt: skip
    rates = dict(zip(skeleton.dof_names, DynamicsSettings(**values).rates(skeleton)))
    parts = {
        'root_tx': 'translation', 'root_tz': 'translation', 'root_z': 'root', 'neck_x': 'neck',
        'left_hip_z': 'hip', 'right_knee': 'knee', 'left_shoulder_y': 'shoulder',
        'right_elbow': 'elbow', 'left_ankle_x': 'extremity', 'right_wrist_y': 'extremity',
        'trunk_x': 'trunk',
    }  # fmt: skip
    for dof, part in parts.items():
        if dof in rates:
            assert rates[dof] == pytest.approx(values[part] ** 2, rel=1e-12)
    if name == 'human37':
        assert rates['left_clavicle_y'] == pytest.approx((0.25 * values['trunk']) ** 2, rel=1e-12)
    # Left and right are alike, and so are the angles of one joint.
    for dof, rate in rates.items():
        other = dof.replace('left_', 'right_')
        assert rate == rates[other] > 0


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'model': 'constant_acceleration'}, "one of .*saw 'constant_acceleration'"),
        ({'velocity_kept': 1.2}, r'velocity_kept must lie in \[0, 1\], saw 1.2'),
        ({'velocity_gain': -0.1}, r'velocity_gain must lie in \[0, 1\], saw -0.1'),
        ({'velocity_gain': float('nan')}, r'velocity_gain must lie in \[0, 1\], saw nan'),
    ],
)
def test_settings_that_are_refused(values, said):
    with pytest.raises(ValueError, match=said):
        DynamicsSettings(**values)
