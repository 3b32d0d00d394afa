"""Weights against their equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hmt_ros.tracking.weighting import at_least, cost_of_room, log_shares, normalised, weigh


def test_weights_are_prior_times_tempered_posterior():
    priors, energies = np.array([0.7, 0.3]), np.array([10.0, 8.0])
    weights = np.exp(normalised(weigh(np.log(priors), energies, 0.3)))
    wanted = priors * np.exp(-0.3 * energies)
    assert weights == pytest.approx(wanted / wanted.sum(), rel=1e-14)


def test_without_temperature_only_the_prior_counts():
    priors = np.log([0.7, 0.2, 0.1])
    assert np.array_equal(weigh(priors, np.array([1e9, 0.0, -1e9]), 0.0), priors)


def test_no_mode_falls_below_the_least_weight():
    raised = at_least(normalised(np.array([0.0, -5.0, -1000.0])), -10.0)
    assert np.exp(raised).sum() == pytest.approx(1.0, abs=1e-15)
    assert raised[2] == pytest.approx(-10.0, abs=1e-3)
    assert raised[0] - raised[1] == pytest.approx(5.0, abs=1e-12)


def test_shares_are_probabilities():
    assert np.exp(log_shares([-3.0, -3.0])) == pytest.approx([0.5, 0.5])
    assert log_shares([-1000.0, -1010.0]) == pytest.approx([0.0, -10.0], abs=1e-4)


def precisions_of(seed, count, d=5):
    root = np.random.default_rng(seed).normal(size=(count, d, d))
    return root @ root.transpose(0, 2, 1) + 0.1 * np.eye(d)


def test_room_costs_what_the_evidence_loses():
    """Of a measurement y at its mean: log N(y; m, S_usual + R) - log N(y; m, S_own + R)."""
    measured, usual = precisions_of(0, 4), precisions_of(1, 4)
    own = usual.copy()
    own[:, :2] *= 0.01
    own[:, :, :2] *= 0.01
    found = cost_of_room(measured + own, own, usual, np.ones((4, 5), dtype=bool))
    for cost, r, a, b in zip(found, measured, own, usual):
        logs = [
            multivariate_normal.logpdf(np.zeros(5), cov=np.linalg.inv(p) + np.linalg.inv(r))
            for p in (a, b)
        ]
        assert cost == pytest.approx(logs[1] - logs[0])
    assert found.min() > 1.0


def test_room_that_is_not_used_costs_nothing():
    usual = precisions_of(2, 3)
    own = 0.01 * usual
    jumped = np.zeros((3, 5), dtype=bool)
    jumped[1, 2] = True
    blind = cost_of_room(own, own, usual, jumped)
    assert blind == pytest.approx(0.0, abs=1e-9)
    seen = cost_of_room(own + 5.0 * usual, own, usual, jumped)
    assert (seen[[0, 2]] == 0).all()
    assert seen[1] > 1.0
