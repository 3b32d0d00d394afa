"""The share of measurements with lasting errors, against the variance of their mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import toeplitz

from hmt_ros.inference.error_model import share_of_time


@pytest.mark.parametrize('dt', [0.01, 0.1, 0.4, 2.0])
@pytest.mark.parametrize('tau', [0.05, 0.2, 1.0])
def test_it_is_the_information_of_an_autoregressive_error(dt, tau):
    """A long run of n measurements holds as much of a constant as a(dt) n independent ones."""
    n = 1200
    covariance = toeplitz(np.exp(-np.arange(n) * dt / tau))
    information = np.ones(n) @ np.linalg.solve(covariance, np.ones(n))
    rho = math.exp(-dt / tau)
    # The first and the last of the run have one neighbour: the exact sum over them.
    exact = (n - (n - 2) * rho) / (1 + rho)
    assert information == pytest.approx(exact, rel=1e-9)
    share = share_of_time(dt, tau)
    assert share == pytest.approx((1 - rho) / (1 + rho), rel=1e-12)
    assert share == pytest.approx(information / n, abs=2 / n)


def test_a_second_tells_as_much_at_every_high_rate():
    for rate in (100.0, 1000.0):
        assert rate * share_of_time(1 / rate, 0.2) == pytest.approx(2.5, rel=1e-3)


def test_limits():
    assert share_of_time(0.0, 0.2) == 0.0
    assert share_of_time(math.inf, 0.2) == 1.0
    assert share_of_time(0.1, 0.0) == 1.0
    assert np.all(np.diff([share_of_time(dt, 0.2) for dt in (0.0, 0.1, 0.2, 0.5, 1.0)]) > 0)
    for dt, tau in ((-0.1, 0.2), (0.1, -0.2), (math.nan, 0.2)):
        with pytest.raises(ValueError, match='not negative, saw'):
            share_of_time(dt, tau)
