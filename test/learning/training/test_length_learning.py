"""The spread of lengths over people, learned from people drawn from a known one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hmt_learning.training.length_learning import (
    LengthSpread,
    held_out,
    learned_spread,
    log_likelihoods,
    own_skeletons,
    relative_lengths,
    usual_spread,
)
from hmt_ros.body import load_body


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


def drawn(spread: LengthSpread, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.multivariate_normal(np.zeros(len(spread.proportions)), spread.covariance, count)


def test_many_people_tell_their_spread(body):
    true = LengthSpread(0.04, np.linspace(0.03, 0.15, 12))
    found = learned_spread(drawn(true, 4000), usual_spread(body), 0.1)
    assert found.stature == pytest.approx(true.stature, rel=0.05)
    assert np.allclose(found.proportions, true.proportions, rtol=0.06)


def test_the_spread_is_the_most_probable_one(body):
    """No spread near the result has a larger posterior density."""
    usual, people, weight = usual_spread(body), drawn(usual_spread(body), 6, 3), 4.0
    found = learned_spread(people, usual, weight)
    x = people - people.mean(0)
    scatter = x.T @ x

    def density(spread: LengthSpread) -> float:
        covariance = spread.covariance
        value = -0.5 * (len(x) - 1) * np.linalg.slogdet(covariance)[1]
        value -= 0.5 * np.trace(np.linalg.solve(covariance, scatter))
        for s, s0 in [(spread.stature, usual.stature), *zip(spread.proportions, usual.proportions)]:
            value -= 0.5 * weight * (np.log(s**2) + s0**2 / s**2)
        return float(value)

    best = density(found)
    for factor in (0.98, 1.02):
        assert density(LengthSpread(factor * found.stature, found.proportions)) < best
        for i in range(12):
            other = found.proportions.copy()
            other[i] *= factor
            assert density(LengthSpread(found.stature, other)) < best


def test_densities_are_those_of_scipy(body):
    spread, people = usual_spread(body), drawn(usual_spread(body), 5)
    wanted = multivariate_normal(np.full(12, 0.01), spread.covariance).logpdf(people)
    assert np.allclose(log_likelihoods(people, np.full(12, 0.01), spread.covariance), wanted)


def test_a_skeleton_that_people_share_is_of_none(body):
    """People who have another skeleton, too, count by that; repeated recordings count once."""
    shared = body.skeleton.lengths
    own, other = shared * 1.1, shared * np.linspace(0.9, 1.1, 12)
    people = ['a', 'b', 'b', 'b', 'c', 'c']
    lengths = np.array([shared, shared, own, own * 1.002, other, other])
    names, relative = own_skeletons(body, people, lengths)
    assert names == ('b', 'c')
    wanted = relative_lengths(body, np.array([own, other]))
    assert np.allclose(relative, wanted, atol=0.003)


def test_what_is_no_person_is_refused(body):
    lengths = body.skeleton.lengths.copy()
    lengths[list(body.segment_lengths).index('shoulder_rise')] = -0.03
    assert np.isfinite(relative_lengths(body, lengths[None])).all()
    lengths[list(body.segment_lengths).index('hip_drop')] = -0.02
    with pytest.raises(ValueError, match=r'hip_drop must be positive, saw -0\.020 m'):
        relative_lengths(body, lengths[None])
    usual = usual_spread(body)
    with pytest.raises(ValueError, match='1 people have a skeleton of their own, wanted at least'):
        learned_spread(drawn(usual, 1), usual)
    with pytest.raises(ValueError, match='2 people, wanted at least 3'):
        held_out(drawn(usual, 2), usual)
