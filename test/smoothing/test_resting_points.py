"""Resting points: a chain of two states, compared with enumeration, and its prior terms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hmt_ros.body import load_body, resting_points
from hmt_ros.body.ground_terms import sole_jacobians, sole_points
from hmt_ros.body.resting_points import (
    SLIP_VARIANCE,
    RestingPoints,
    _smoothed_chain,
    rest_probabilities,
)
from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, MotionSmoother

DT = 1 / 30


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def line(poses):
    """Poses (N, 2) of a point on a line, (N, 1, 3): the sum of both variables."""
    return np.pad(poses.sum(1)[:, None, None], ((0, 0), (0, 0), (0, 2)))


def of_line(poses):
    result = np.zeros((len(poses), 1, 3, 2))
    result[:, 0, 0] = 1.0
    return result


POINT = RestingPoints(line, of_line)


def test_the_chain_agrees_with_enumeration(rng):
    likelihoods = rng.uniform(0.01, 1.0, size=(2, 5, 3))
    changes = np.array([0.1, 0.3, 0.05, 0.2, 0.4])
    wanted = np.zeros_like(likelihoods)
    for states in itertools.product((0, 1), repeat=5):
        for p in range(3):
            mass = 1.0
            for t, state in enumerate(states):
                mass *= likelihoods[state, t, p]
                if t > 0:
                    mass *= changes[t] if state != states[t - 1] else 1.0 - changes[t]
            for t, state in enumerate(states):
                wanted[state, t, p] += mass
    wanted /= wanted.sum(0)
    np.testing.assert_allclose(_smoothed_chain(likelihoods, changes), wanted, atol=1e-12)


def probabilities(which, poses, covariances, intervals):
    return rest_probabilities(which.points(poses), which.jacobians(poses), covariances, intervals)


def test_what_stands_rests_and_what_steps_does_not():
    """A foot stands for a second, moves 0.7 m in 0.4 s, and stands again."""
    way = np.concatenate([np.zeros(30), np.linspace(0.0, 0.7, 12), np.full(30, 0.7)])
    poses = np.stack([way + 0.002 * (-1.0) ** np.arange(72), np.zeros(72)], axis=1)
    covariances = np.tile(np.eye(2), (72, 1, 1))
    rests = probabilities(POINT, poses, covariances, np.full(71, DT))[:, 0]
    assert rests.shape == (71,)
    assert rests[:28].min() > 0.9
    assert rests[32:40].max() < 0.1
    assert rests[44:].min() > 0.9


def test_a_direction_that_is_known_badly_may_seem_to_move_more():
    poses = np.cumsum(np.full((31, 2), 0.1 * DT), axis=0)
    known = probabilities(POINT, poses, np.tile(np.eye(2), (31, 1, 1)), np.full(30, DT))

    def across(poses):
        return line(poses)[..., [1, 0, 2]]

    def of_across(poses):
        # The first coordinate of the point is uncertain and constant.
        result = of_line(poses)[:, :, [1, 0, 2]]
        result[:, 0, 0, 0] = 100.0
        return result

    other = RestingPoints(across, of_across)
    least = probabilities(other, poses, np.tile(np.eye(2), (31, 1, 1)), np.full(30, DT))
    assert least[15, 0] < known[15, 0]


def test_the_prior_costs_what_resting_points_slip(rng):
    dynamics = LinearGaussianDynamics.constant_velocity([0.4, 0.7], 0.9)
    intervals = np.full(4, DT)
    prior = dynamics.prior(intervals)
    along = 1e-3 * rng.normal(size=(5, 2))
    covariances = np.tile(np.eye(2), (5, 1, 1))
    held = POINT.constrained_prior(prior, along, covariances, intervals)
    rests = probabilities(POINT, along, covariances, intervals)
    states = rng.normal(size=(3, 5, 4))
    slips = np.diff(line(states[:, :, :2].reshape(-1, 2)).reshape(3, 5, 3), axis=1)
    wanted = (rests[:, 0] * np.square(slips).sum(2) / (2.0 * SLIP_VARIANCE * intervals)).sum(1)
    more = held.energy(states)[0] - prior.energy(states)[0]
    # Up to the normalisation constant of a Gaussian.
    np.testing.assert_allclose(more - more[0], wanted - wanted[0], rtol=1e-9)


def test_the_soles_have_these_derivatives(rng):
    body = load_body('human37')
    pose = 0.3 * rng.normal(size=body.dimension)
    found = sole_jacobians(body, pose[None])[0]
    for k in range(body.dimension):
        step = 1e-6 * (np.arange(body.dimension) == k)
        ends = sole_points(body, np.stack([pose + step, pose - step]))
        np.testing.assert_allclose(found[:, :, k], (ends[0] - ends[1]) / 2e-6, atol=1e-7)
    assert RestingPoints.of_soles(body) is not None


def test_a_body_without_feet_has_nothing_that_rests(monkeypatch):
    monkeypatch.setattr(resting_points, 'soles', lambda body: ())
    assert RestingPoints.of_soles(load_body('human37')) is None


@pytest.mark.parametrize('speed', [0.0, 1.0])
def test_a_smoother_holds_what_rests(rng, chained, speed):
    """Jittering points are held at rest; moving ones keep their motion."""
    dynamics = LinearGaussianDynamics.random_walk([0.5, 0.5])
    stamps = [round(t * DT * 1e9) for t in range(40)]
    way = speed * DT * np.arange(40)
    noise = 0.01 * rng.normal(size=(40, 2))
    mixtures = [
        GaussianMixture([1.0], [[way[t], 0.0] + noise[t]], [1e-3 * np.eye(2)]) for t in range(40)
    ]
    images = chained(mixtures, stamps)
    free = MotionSmoother(dynamics, points=line).smooth(images)
    held = MotionSmoother(dynamics, points=line, resting=POINT).smooth(images)

    def slides(found):
        return np.abs(np.diff(found.means[0].sum(1)) - speed * DT).mean()

    if speed == 0.0:
        assert slides(held) < 0.3 * slides(free)
    else:
        np.testing.assert_allclose(held.means, free.means, atol=6e-3)
    assert np.isfinite(held.marginal(3).log_density(held.means[:1, 3])).all()


def test_one_pose_alone_has_nothing_to_rest_against(chained):
    dynamics = LinearGaussianDynamics.random_walk([0.5, 0.5])
    one = GaussianMixture([1.0], [[0.0, 0.0]], [np.eye(2)])
    assert MotionSmoother(dynamics, resting=POINT).smooth(chained([one])).times == 1
