"""The prior of the lengths against sampling and sums of information."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.model_file import STATURE_SPREAD, conditioned_covariance, length_covariance

LENGTHS, PROPORTIONS = np.array([0.42, 0.41, 0.02]), np.array([0.04, 0.05, 0.8])


def test_lengths_share_a_stature():
    """Against samples of the log-normal model of stature and proportions."""
    rng = np.random.default_rng(0)
    stature, own = 0.05 * rng.normal(size=(400_000, 1)), rng.normal(size=(400_000, 3))
    people = LENGTHS[:2] * np.exp(stature + PROPORTIONS[:2] * own[:, :2])
    wanted = length_covariance(LENGTHS, PROPORTIONS, 0.05)
    assert np.allclose(np.cov(people.T), wanted[:2, :2], rtol=0.02)
    assert wanted[2, 2] == pytest.approx(0.02**2 * (0.8**2 + 0.05**2))


def test_what_is_measured_holds_lengths():
    """Against people drawn from the prior and weighted by the likelihood of a measurement."""
    covariance = length_covariance(LENGTHS, PROPORTIONS, 0.05)
    rows, sigma = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.02, 0.01])
    rng = np.random.default_rng(1)
    people = rng.multivariate_normal(np.zeros(3), covariance, 400_000)
    cost = 0.5 * (((people @ rows.T) / sigma) ** 2).sum(1)
    brute = np.cov(people.T, aweights=np.exp(-cost))
    found = conditioned_covariance(covariance, rows, sigma)
    assert np.allclose(found, brute, rtol=0.03, atol=2e-6)
    information = np.linalg.inv(covariance) + rows.T @ np.diag(sigma**-2.0) @ rows
    assert np.allclose(found, np.linalg.inv(information))
    assert np.array_equal(conditioned_covariance(covariance, np.zeros((0, 3)), []), covariance)


@pytest.mark.parametrize('name', ['human37', 'human34', 'human32'])
def test_lengths_of_the_models_covary(name):
    body = load_body(name)
    covariance, lengths = body.length_covariance, body.skeleton.lengths
    assert np.linalg.eigvalsh(covariance).min() > 0
    apart = covariance - np.diag(np.diagonal(covariance))
    ratio = apart / np.outer(lengths, lengths)
    common = ratio[0, 1]
    assert 0.03 < np.sqrt(common) < 0.07
    assert np.allclose(ratio, common * (1 - np.eye(len(lengths))))
    assert np.allclose(body.length_sigma**2, np.diagonal(covariance))


@pytest.mark.parametrize(
    ('proportions', 'stature', 'said'),
    [
        ([0.1, np.nan, 0.1], STATURE_SPREAD, 'spreads of lengths must be numbers of at least 0'),
        ([0.1, -0.1, 0.1], STATURE_SPREAD, 'spreads of lengths must be numbers of at least 0'),
        ([0.1, 0.1, 0.1], -0.05, 'stature_spread must be a number of at least 0, saw -0.05'),
    ],
)
def test_what_is_no_spread_is_refused(proportions, stature, said):
    with pytest.raises(ValueError, match=said):
        length_covariance(LENGTHS, proportions, stature)
