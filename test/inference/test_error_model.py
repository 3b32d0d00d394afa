"""The share of measurements with correlated errors, compared with the variance of their mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from hmt_ros.inference import error_model
from hmt_ros.inference.error_model import ERRORS, CueErrors, errors_of_cues, share_of_time


@pytest.mark.parametrize('dt', [0.01, 0.1, 0.4, 2.0])
@pytest.mark.parametrize('tau', [0.05, 0.2, 1.0])
def test_it_is_the_information_of_an_autoregressive_error(dt, tau):
    """A long run of n measurements determines a constant like a(dt) n independent ones."""
    n = 1200
    covariance = toeplitz(np.exp(-np.arange(n) * dt / tau))
    information = np.ones(n) @ np.linalg.solve(covariance, np.ones(n))
    rho = math.exp(-dt / tau)
    # The exact sum; the first and the last measurement have only one neighbour.
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


@pytest.mark.parametrize('name', list(ERRORS))
def test_an_image_says_no_more_than_its_share_of_space(name):
    errors = ERRORS[name]
    assert 0.0 < errors.independent <= 1.0
    shares = [errors.share(dt) for dt in (0.0, 0.001, 1 / 30, 0.1, 1 / 3, 10.0)]
    assert shares[0] == 0.0
    assert (np.diff(shares) >= 0.0).all()
    assert max(shares) <= errors.independent
    assert errors.share(math.inf) == errors.independent


@pytest.mark.parametrize('name', list(ERRORS))
def test_a_second_of_more_images_says_no_less(name):
    found = [rate * ERRORS[name].share(1.0 / rate) for rate in (1.0, 3.0, 8.0, 30.0, 1000.0)]
    assert (np.diff(found) > 0.0).all()
    # The information is bounded for any number of measurements.
    assert found[-1] <= ERRORS[name].independent / (2.0 * ERRORS[name].time)


@pytest.mark.parametrize('time', [0.3, 1.0, 10.0])
def test_the_rate_hardly_matters_where_errors_last_longer_than_the_interval(time):
    errors = CueErrors(0.4, time)
    fast, slow = (rate * errors.share(1.0 / rate) for rate in (30.0, 8.0))
    assert fast == pytest.approx(0.4 / (2.0 * time), rel=0.02)
    assert slow == pytest.approx(fast, rel=0.02)


def test_one_pair_for_several_cues(monkeypatch):
    """It has the mean share of its cues, at low and at high image rates."""
    table = {'image': CueErrors(0.2, 0.5), 'keypoints': CueErrors(0.6, 0.05)}
    monkeypatch.setattr(error_model, 'ERRORS', table)
    amounts = {'image': 3.0, 'keypoints': 1.0}
    one = errors_of_cues(amounts)

    def mean(dt):
        return sum(amount * table[name].share(dt) for name, amount in amounts.items()) / 4.0

    assert one.share(math.inf) == pytest.approx(mean(math.inf), rel=1e-12)
    assert one.share(1e-5) == pytest.approx(mean(1e-5), rel=1e-6)
    for dt in (1 / 30, 0.1, 0.3):
        shares = sorted(errors.share(dt) for errors in table.values())
        assert shares[0] < one.share(dt) < shares[1]
    alone = errors_of_cues({'image': 2.0, 'keypoints': 0.0})
    assert (alone.independent, alone.time) == pytest.approx((0.2, 0.5))
    for wrong in ({'image': 0.0}, {'image': -1.0, 'keypoints': 2.0}, {'image': math.nan}):
        with pytest.raises(ValueError, match='not negative, and not all 0'):
            errors_of_cues(wrong)


def test_cues_with_one_pair_have_it_together(monkeypatch):
    monkeypatch.setattr(error_model, 'ERRORS', dict.fromkeys('ab', CueErrors(0.35, 0.053)))
    found = errors_of_cues({'a': 0.3, 'b': 2.0})
    assert (found.independent, found.time) == pytest.approx((0.35, 0.053))
    monkeypatch.setattr(error_model, 'ERRORS', {'a': CueErrors(1.0, 0.0), 'b': CueErrors(0.5, 1.0)})
    assert errors_of_cues({'a': 1.0, 'b': 1.0}) == CueErrors(0.75, 0.0)


@pytest.mark.parametrize('rho', [0.01, 0.3, 0.8])
def test_changes_of_what_lasts_are_told_by_what_is_new_of_it(rho):
    """Compared with a simulated autoregressive error."""
    tau, s = 0.1, 0.5
    dt = -tau * np.log(rho)
    errors = CueErrors(s, tau)
    rng = np.random.default_rng(0)
    new = np.sqrt((1.0 - rho**2) / s) * rng.normal(size=200_000)
    error = lfilter([1.0], [1.0, -rho], new)
    # The part of the next error that the previous ones do not determine.
    unknown = np.var(error[1:] - rho * error[:-1])
    assert unknown == pytest.approx(1.0 / errors.of_changes(dt), rel=0.02)
    # The variance of the mean of n errors, compared with n discounted images.
    means = error[: 200_000 // 500 * 500].reshape(-1, 500).mean(1)
    assert 500 * np.var(means) == pytest.approx(1.0 / errors.share(dt), rel=0.15)
    assert errors.persistence_ratio(dt) == pytest.approx(1.0 / (1.0 - rho) ** 2)


def test_what_does_not_last_is_told_once():
    for errors, dt in ((CueErrors(0.5, 0.0), 0.1), (CueErrors(0.5, 0.1), np.inf)):
        assert errors.of_changes(dt) == errors.share(dt) == 0.5
        assert errors.persistence_ratio(dt) == 1.0
