"""Weights against their equations."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.tracking.weighting import at_least, log_shares, normalised, weigh


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
