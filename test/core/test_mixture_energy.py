import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.special import logsumexp

from hmt_ros.core import add_mixture_energy

D = 5


def sequence(seed=0, **other):
    """Poses between the modes of three mixtures, one of which has one mode."""
    rng = np.random.default_rng(seed)
    whiteners = np.tril(0.3 * rng.normal(size=(7, D, D))) + np.eye(D)
    times = np.array([2, 0, 1, 0])
    # In the order of the arguments.
    given = {
        'poses': 0.5 * rng.normal(size=(4, D)),
        'times': times,
        'first': np.array([0, 3, 4, 7]),
        'log_scales': rng.normal(size=7),
        'means': 0.5 * rng.normal(size=(7, D)),
        'whiteners': whiteners,
        'precisions': whiteners.swapaxes(1, 2) @ whiteners,
        'second': True,
        'exact': True,
        'value': np.full(4, np.nan),
        'gradient': np.full((4, D), np.nan),
        'hessian': np.full((4, D, D), np.nan),
    }
    return {**given, **other}


def evaluate(given):
    add_mixture_energy(*given.values())
    return given


def energy(x, given, time):
    modes = slice(given['first'][time], given['first'][time + 1])
    white = (given['whiteners'][modes] @ (x - given['means'][modes])[:, :, None])[:, :, 0]
    return -logsumexp(given['log_scales'][modes] - 0.5 * (white**2).sum(1))


def test_value_gradient_and_hessian():
    found = evaluate(sequence())
    positive = evaluate(sequence(exact=False))
    for i, (x, time) in enumerate(zip(found['poses'], found['times'])):
        assert found['value'][i] == pytest.approx(energy(x, found, time), abs=1e-12)
        slope = approx_fprime(x, energy, 1e-7, found, time)
        np.testing.assert_allclose(found['gradient'][i], slope, atol=1e-5)
        for a in range(D):
            step = 1e-5 * np.eye(D)[a]
            ends = [
                evaluate(sequence(poses=found['poses'] + way * step))['gradient'][i]
                for way in (1.0, -1.0)
            ]
            np.testing.assert_allclose(
                (ends[0] - ends[1]) / 2e-5, found['hessian'][i, a], atol=1e-7
            )
        assert np.linalg.eigvalsh(positive['hessian'][i] - found['hessian'][i]).min() > -1e-12


def test_modes_far_away_do_not_count():
    given = sequence()
    given['means'][[0, 2, 4, 6]] += 1e3
    found = evaluate(given)
    near = {0: 1, 1: 3, 2: 5}
    for i, time in enumerate(given['times']):
        pull = given['precisions'][near[time]]
        np.testing.assert_array_equal(found['hessian'][i], pull)
        offset = given['poses'][i] - given['means'][near[time]]
        np.testing.assert_allclose(found['gradient'][i], pull @ offset, atol=1e-12)


def test_a_hessian_that_is_not_wanted_may_be_missing():
    found = evaluate(sequence(second=False, exact=False, hessian=np.empty((0, D, D))))
    np.testing.assert_array_equal(found['gradient'], evaluate(sequence())['gradient'])


@pytest.mark.parametrize('name', [n for n in sequence() if n not in ('second', 'exact')])
def test_arguments_that_do_not_fit_are_named(name):
    array = sequence()[name]
    wrong = [array.astype(np.float32), np.repeat(array, 2, -1)[..., ::2], array[:-1].copy()]
    for bad in wrong[:2] if name in ('poses', 'means', 'first') else wrong:
        with pytest.raises((ValueError, TypeError), match=f'^{name}: wanted'):
            evaluate(sequence(**{name: bad}))


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('times', [0, 0, 0, 3]),
        ('times', [0, -1, 0, 0]),
        ('first', [0, 3, 2, 7]),
        ('first', [0, 3, 4, 8]),
        ('first', [-1, 3, 4, 7]),
    ],
)
def test_numbers_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f'^{name}: wanted'):
        evaluate(sequence(**{name: np.array(value)}))


def test_no_numbers_and_no_poses_are_survived():
    for name in ('poses', 'log_scales', 'means', 'whiteners', 'precisions'):
        found = evaluate(sequence(**{name: np.full_like(sequence()[name], np.nan)}))
        parts = [found[x] for x in ('value', 'gradient', 'hessian')]
        assert not all(np.isfinite(part).all() for part in parts)
    none = {name: sequence()[name][:0] for name in ('poses', 'times', 'value', 'gradient')}
    assert len(evaluate(sequence(**none, hessian=np.empty((0, D, D))))['value']) == 0
