"""The trust in images against its equations."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.tracking.trust import USUAL_CHANGE, Trust


def test_energies_that_hardly_change_are_trusted_more_than_those_that_jump():
    calm, wild = Trust(0.7, 0.8), Trust(0.7, 0.8)
    for i in range(200):
        calm.update(20.0 + 0.1 * (i % 2))
        wild.update(20.0 + 30.0 * (i % 2))
    assert calm.inverse_temperature == pytest.approx(0.7, rel=1e-2)
    wanted = 0.7 * USUAL_CHANGE / np.hypot(USUAL_CHANGE, 30.0)
    assert wild.inverse_temperature == pytest.approx(wanted, rel=1e-3)


def test_information_is_the_share_of_independent_images():
    # The variance of the mean of n errors of an AR(1) process, over that of independent ones.
    rho, n = 0.8, 4000
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    share = n / (rho**lag).sum() * 1.0
    trust = Trust(0.7, rho)
    assert trust.information / trust.inverse_temperature == pytest.approx(share, rel=1e-2)


def test_one_jump_does_not_end_all_trust():
    trust = Trust(0.7, 0.8)
    for _ in range(50):
        trust.update(20.0)
    before = trust.inverse_temperature
    trust.update(1e6)
    assert before > trust.inverse_temperature > 0.5 * before
