"""Transitions, histories and facings against their equations in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.mirror import Trunk
from hmt_ros.core import face_back, point_left, rate_histories, rate_transitions
from hmt_ros.core import weigh_ways as weigh
from hmt_ros.inference.linear_algebra import log_sum_exp
from hmt_ros.tracking.classes import FacingInputs
from hmt_ros.tracking.weighting import Transition
from test.core.arguments import assert_arguments_are_checked

TRUNK = Trunk(np.array([1, 2]), np.array([3, 4]))
TRANSITION = Transition(0.02, 2.0)


def given(seed, modes=3, count=7, joints=6):
    """Arguments of `weigh_ways`, in their order."""
    rng = np.random.default_rng(seed)
    before, back, followed = (rng.random(n) < 0.5 for n in (modes, count, count))
    return {
        'trunk': TRUNK,
        'ways': FacingInputs(before, back, 0.3, rng.normal(), 4.0, 0.9, 10.0),
        'first': rng.normal(size=(modes, joints, 3)),
        'joints': rng.normal(size=(count, joints, 3)),
        'transitions': -rng.exponential(size=(modes, count)),
        'log_weights': rng.normal(size=count),
        'evidence': rng.normal(size=count),
        'followed': followed,
        'result': np.empty(count),
        'facing': np.empty(count),
        'turned': np.empty((modes, count)),
    }


def lefts(joints):
    across = joints[:, TRUNK.left].sum(1) - joints[:, TRUNK.right].sum(1)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


@pytest.mark.parametrize('seed', range(20))
def test_either_way_has_the_weight_of_its_history(seed):
    x = given(seed)
    weigh(*x.values())
    ways, back = x['ways'], x['ways'].back
    angles = np.arccos(np.clip(lefts(x['first']) @ lefts(x['joints']).T, -1.0, 1.0))
    turns = np.minimum(x['transitions'], -0.5 * angles**2 / ways.variance)
    across = turns[np.ix_(~ways.before, back)]
    log_odds = max(ways.log_odds, across.max(initial=-np.inf))
    on, off = (x['evidence'][x['followed'] & one] for one in (~back, back))
    if len(on) and len(off):
        d, v = on.min() - off.min(), ways.valid
        log_odds += np.log(v * np.exp(d) + 1 - v) - np.log(v + (1 - v) * np.exp(d))
    log_odds = abs(log_odds) if back.all() else log_odds
    np.testing.assert_allclose(x['facing'], np.where(back, log_odds, -log_odds), atol=1e-12)
    weights = np.exp(x['log_weights'])
    if back.any() and not back.all():
        for one, p in ((back, 1 / (1 + np.exp(-log_odds))), (~back, 1 / (1 + np.exp(log_odds)))):
            weights[one] *= p / weights[one].sum()
    np.testing.assert_allclose(np.exp(x['result']), weights, rtol=1e-12)
    other = np.logaddexp(turns, -ways.price) - x['transitions']
    wanted = np.where(ways.before[:, None] != back, other, 0.0)
    np.testing.assert_allclose(x['turned'], wanted, atol=1e-12)


def test_who_faces_back():
    x = given(0)
    joints, back = x['joints'], np.empty(7, dtype=np.bool_)
    face_back(TRUNK, joints, joints[2], 5, 0.1, back)
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (joints[:, 0], joints[:, 5])]
    left, up = lefts(joints), joints[:, 5] - joints[:, 0]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    away = np.linalg.det(np.stack([left, up, unit[0]], axis=1))
    apart = (away * away[2] < 0) & (np.abs(away - away[2]) > 0.2)
    np.testing.assert_array_equal(back, (left @ left[2] < 0) | apart)
    assert 0 < back.sum() < 7


def test_sums_of_exponentials():
    x = np.random.default_rng(0).normal(size=(5, 4, 3)) * 100.0
    for axis in range(3):
        found = log_sum_exp(x, axis=axis)
        np.testing.assert_allclose(found, np.logaddexp.reduce(x, axis=axis), rtol=1e-14)
    ends = [[-np.inf, -np.inf], [np.inf, 1.0], [-np.inf, 2.0], [np.nan, 2.0]]
    np.testing.assert_array_equal(log_sum_exp(ends), [-np.inf, np.inf, 2.0, np.nan])
    assert log_sum_exp(np.zeros(0)) == -np.inf


def test_arguments_that_do_not_fit():
    x = given(1)
    free = 'trunk.left trunk.right'
    assert_arguments_are_checked(weigh, x, 'result facing turned', free)
    joints = x['joints']
    named = {'trunk': TRUNK, 'joints': joints, 'result': np.empty((7, 3))}
    assert_arguments_are_checked(point_left, named, 'result', free)
    named = {'trunk': TRUNK, 'joints': joints, 'reference': joints[0], 'neck': 5, 'sideways': 0.1}
    named['result'] = np.empty(7, dtype=np.bool_)
    assert_arguments_are_checked(face_back, named, 'result', free)
    named = {'first': x['first'], 'joints': joints, 'transition': TRANSITION}
    named['result'] = np.empty((3, 7))
    assert_arguments_are_checked(rate_transitions, named, 'result')
    named = {'log_weights': np.zeros(3), 'transitions': x['transitions'], 'joints': joints}
    named |= {'transition': TRANSITION, 'end': 5.0, 'result': np.empty((3, 7))}
    assert_arguments_are_checked(rate_histories, named, 'result')
