import numpy as np
import pytest
from scipy.optimize import lsq_linear

from hmt_ros.core import box_steps


def problems(count, d, seed):
    """Quadratics with a box that cuts through most of them, in the order of the arguments."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(count, d + 2, d))
    x = rng.uniform(-0.1, 0.1, (count, d))
    return {
        'x': x,
        'gradient': rng.normal(size=(count, d)),
        'hessian': factors.swapaxes(1, 2) @ factors,
        'lower': np.full((count, d), -0.12),
        'upper': np.full((count, d), 0.15),
        'lam': rng.uniform(0.1, 2.0, count),
        'metric': rng.uniform(0.5, 2.0, d),
        'rows': np.arange(0, count, 2),
        'step': np.full((len(range(0, count, 2)), d), np.nan),
        'predicted': np.full(len(range(0, count, 2)), np.nan),
    }


def taken(given):
    box_steps(*given.values())
    return given['step'], given['predicted']


@pytest.mark.parametrize('d', [1, 2, 7, 37, 200])
def test_a_step_minimises_the_damped_model_in_the_box(d):
    given = problems(5, d, d)
    steps, predicted = taken(given)
    for n, step, gain in zip(given['rows'], steps, predicted):
        hessian, gradient = given['hessian'][n], given['gradient'][n]
        root = np.linalg.cholesky(hessian + given['lam'][n] * np.diag(given['metric'])).T
        box = given['lower'][n] - given['x'][n], given['upper'][n] - given['x'][n]
        wanted = lsq_linear(root, -np.linalg.solve(root.T, gradient), box, 'bvls', tol=1e-13)
        np.testing.assert_allclose(step, wanted.x, atol=1e-9)
        assert gain == pytest.approx(-gradient @ step - 0.5 * step @ hessian @ step, rel=1e-9)


def test_an_indefinite_model_still_descends_within_the_box():
    given = problems(9, 6, 0)
    given['hessian'] -= 9.0 * np.eye(6)
    steps, predicted = taken(given)
    assert (predicted > 0.0).all()
    rows = given['rows']
    assert (steps >= (given['lower'] - given['x'])[rows]).all()
    assert (steps <= (given['upper'] - given['x'])[rows]).all()


@pytest.mark.parametrize('name', list(problems(1, 1, 0))[:7])
@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0, -1.0])
def test_any_numbers_end(name, value):
    given = problems(3, 4, 1)
    none = {k: np.zeros_like(v) if k != 'rows' else v for k, v in given.items()}
    for numbers in (given, none):
        numbers[name][...] = value
        for result in ('step', 'predicted'):
            numbers[result][...] = -77.0
        # Every problem has a result, whatever the input was.
        assert not any((result == -77.0).any() for result in taken(numbers))


@pytest.mark.parametrize('name', problems(1, 1, 0))
def test_arguments_that_do_not_fit_are_named(name):
    given = problems(4, 3, 2)
    taken({k: v.copy() for k, v in given.items()})
    array = given[name]
    wrong = [array[:-1].copy(), array.astype(np.float32), np.repeat(array, 2, -1)[..., ::2]]
    for bad in wrong[1:] if name in ('rows', 'x') else wrong:
        with pytest.raises((ValueError, TypeError), match=f'^{name}: wanted'):
            taken({**given, name: bad})


@pytest.mark.parametrize('row', [-1, 4])
def test_rows_are_problems(row):
    given = problems(4, 3, 3)
    given['rows'][0] = row
    with pytest.raises(ValueError, match='rows: wanted numbers from 0 up to 3'):
        taken(given)


def test_no_problems_and_no_variables():
    taken(problems(0, 3, 4))
    _, predicted = taken(problems(3, 0, 4))
    np.testing.assert_array_equal(predicted, 0.0)
