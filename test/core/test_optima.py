"""Gaussians around optima against numpy; invalid arguments."""

import numpy as np
import pytest

from hmt_ros.core import (
    determined,
    free_covariances,
    shift_modes,
)
from test.core.arguments import assert_arguments_are_checked

RESTING, LEAST = 400.0, 0.25


def optima(count, d, seed):
    """Sums of Hessians and the free variables, in the order of the arguments."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(count, 3, d, 2 * d)) * np.geomspace(1.0, 1e3, d)[:, None]
    return {
        'hessians': factors @ factors.swapaxes(2, 3),
        'shares': np.array([0.2, 0.5, 1.0]),
        'free': rng.random((count, d)) < 0.7,
        'resting': RESTING,
        'least': LEAST,
        'covariances': np.full((count, d, d), np.nan),
        'log_determinants': np.full(count, np.nan),
    }


def shifted(count, d, seed):
    rng = np.random.default_rng(seed)
    given = optima(count, d, seed)
    free_covariances(*given.values())
    return {
        'poses': rng.uniform(-1.0, 1.0, (count, d)),
        'gradient': rng.normal(size=(count, d)) * 1e2,
        'free': given['free'],
        'covariances': given['covariances'],
        'spreads': 0.1 * given['covariances'],
        'most': 0.5,
        'limits': np.stack([np.full(d, -1.0), np.full(d, 1.0)]),
        'means': np.full((count, d), np.nan),
    }


@pytest.mark.parametrize('d', [1, 7, 8, 37, 100])
def test_covariances_are_inverses_on_the_free_variables(d):
    given = optima(5, d, d)
    free_covariances(*given.values())
    total = np.einsum('c,kcij->kij', given['shares'], given['hessians'])
    for k, free in enumerate(given['free']):
        wanted = np.diag(np.full(d, 1.0 / (RESTING + LEAST)))
        both = np.ix_(free, free)
        wanted[both] = np.linalg.inv(total[k][both] + LEAST * np.eye(free.sum()))
        found = given['covariances'][k]
        scale = np.sqrt(np.diagonal(wanted))
        assert np.allclose(found / scale / scale[:, None], wanted / scale / scale[:, None])
        assert (found == found.T).all()
        assert given['log_determinants'][k] == pytest.approx(np.linalg.slogdet(wanted)[1])


def test_a_sum_that_is_not_positive_definite_has_no_covariances():
    given = optima(3, 6, 0)
    given['hessians'][1] *= -1.0
    given['free'][...] = True
    free_covariances(*given.values())
    assert np.isnan(given['covariances']).all((1, 2)).tolist() == [False, True, False]
    assert np.isnan(given['log_determinants']).tolist() == [False, True, False]


def test_modes_move_to_the_minima_of_parabolas_within_bounds():
    given = shifted(6, 9, 1)
    shift_modes(*given.values())
    pull = np.where(given['free'], given['gradient'], 0.0)
    step = -np.einsum('kij,kj->ki', given['covariances'], pull)
    most = given['most'] * np.sqrt(np.einsum('kii->ki', given['spreads']))
    wanted = np.clip(given['poses'] + np.clip(step, -most, most), *given['limits'])
    np.testing.assert_allclose(given['means'], wanted, rtol=1e-12)
    assert (np.abs(step) > most).any()
    assert (np.abs(step) < most).any()


def test_cues_determine_together_all_variables():
    given = optima(4, 9, 2)
    given['free'][...], given['shares'][...] = True, 1.0
    given['resting'] = given['least'] = 0.0
    free_covariances(*given.values())
    weights, amounts = np.array([0.1, 0.2, 0.3, 0.4]), np.empty(3)
    determined(weights, given['covariances'], given['hessians'], amounts)
    wanted = np.einsum('k,kij,kcji->c', weights, given['covariances'], given['hessians'])
    np.testing.assert_allclose(amounts, wanted, rtol=1e-9)
    assert amounts.sum() == pytest.approx(9.0)


def test_arguments_are_checked():
    given = optima(3, 4, 3)
    assert_arguments_are_checked(free_covariances, given, 'covariances log_determinants')
    assert_arguments_are_checked(shift_modes, shifted(3, 4, 4), 'means')
    free_covariances(*given.values())
    of_cues = {
        'weights': np.ones(3),
        'covariances': given['covariances'],
        'hessians': given['hessians'],
        'amounts': np.empty(3),
    }
    assert_arguments_are_checked(determined, of_cues, 'amounts')
