"""Symmetries of a body: chains of two states, and the table of a model file."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import expit, logit

from hmt_ros.body import load_body
from hmt_ros.body.body import MAPS, Symmetry, symmetries_of

FACING = Symmetry(0.02)


@pytest.mark.parametrize('log_odds', [-10.0, -1.0, 0.0, 4.0])
@pytest.mark.parametrize('dt', [0.03, 1.0, 40.0])
def test_odds_follow_a_chain_of_two_states(log_odds, dt):
    rates = FACING.rate * np.array([[-1.0, 1.0], [1.0, -1.0]])
    p = expit(log_odds)
    moved = np.array([1.0 - p, p]) @ expm(rates * dt)
    assert FACING.after(log_odds, dt) == pytest.approx(logit(moved[1]), abs=1e-9)


@pytest.mark.parametrize('log_odds', [-10.0, -3.0, 0.0, 7.0])
def test_odds_of_two_gaps_are_those_of_one(log_odds):
    for a, b in ((0.0, 0.1), (0.03, 0.3), (2.0, 50.0)):
        assert FACING.after(FACING.after(log_odds, a), b) == pytest.approx(
            FACING.after(log_odds, a + b), abs=1e-9
        )


@pytest.mark.parametrize('dt', [1e-3, 0.03, 0.3, 30.0])
def test_the_price_is_that_of_the_chain(dt):
    flip = Symmetry(2.0)
    moved = expm(flip.rate * dt * np.array([[-1.0, 1.0], [1.0, -1.0]]))
    assert flip.price(dt) == pytest.approx(-np.log(moved[0, 1]), rel=1e-9)
    assert flip.price(dt) > np.log(2.0) - 1e-12


@pytest.mark.parametrize('name', ['human32', 'human34', 'human37'])
def test_every_body_has_the_table(name):
    assert list(load_body(name).symmetries) == list(MAPS)


@pytest.mark.parametrize(
    ('entries', 'says'),
    [
        ({'reversal': 1.0}, 'wanted rates of'),
        ({**dict.fromkeys(MAPS, 1.0), 'turn': 1.0}, 'turn'),
        (dict.fromkeys(MAPS, 0.0), 'must be positive'),
        (dict.fromkeys(MAPS, float('nan')), 'must be positive'),
    ],
)
def test_a_wrong_table_is_refused(entries, says):
    with pytest.raises(ValueError, match=says):
        symmetries_of(entries)
