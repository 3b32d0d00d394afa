"""Elementary functions: accurate to the last place, otherwise like numpy's."""

import warnings

import mpmath
import numpy as np
import pytest

from hmt_ros.core import elementary

RNG = np.random.default_rng(0)
COUNT = 800
LARGEST = np.finfo(np.float64).max


def magnitudes(low, high):
    """Numbers of both signs with magnitudes from 2^low to 2^high."""
    return RNG.choice([-1.0, 1.0], COUNT) * 2.0 ** RNG.uniform(low, high, COUNT)


def between(low, high):
    return RNG.uniform(low, high, COUNT)


def worst(function, reference, *arguments):
    """Maximum error in units in the last place of the reference."""
    with np.errstate(over='ignore'):
        found, result = 0.0, getattr(elementary, function)(*arguments)
    with mpmath.workprec(2300):  # for the reduction of the largest numbers by multiples of pi
        for saw, *given in zip(result, *arguments):
            exact = reference(*(mpmath.mpf(float(x)) for x in given))
            if abs(exact) > LARGEST:
                assert saw == (np.inf if exact > 0 else -np.inf)
                continue
            unit = float(np.spacing(abs(float(exact))))
            # The last place of the binade that contains it, not of the one that it rounds to.
            if abs(exact) < abs(float(exact)) and np.frexp(float(exact))[0] in (0.5, -0.5):
                unit = max(unit / 2, 5e-324)
            found = max(found, float(abs(mpmath.mpf(float(saw)) - exact) / unit))
    return found


# Maximum error on three million numbers of each range, in units in the last place: 0.79.
@pytest.mark.parametrize('name', ['sin', 'cos'])
@pytest.mark.parametrize(
    'x',
    [
        between(-4.0, 4.0),
        between(-1e6, 1e6),
        np.pi / 2 * np.round(between(-6e5, 6e5)),
        magnitudes(-1074, 0),
        magnitudes(20, 1024),
        np.array([6381956970095103.0 * 2.0**797]),  # the double nearest to a multiple of pi / 2
    ],
)
def test_sine_and_cosine_are_right_to_the_last_place(name, x):
    assert worst(name, getattr(mpmath, name), x) < 0.8


@pytest.mark.parametrize(
    ('name', 'x', 'limit'),
    [
        ('exp', between(-1.0, 1.0), 0.65),
        ('exp', between(-745.2, 709.8), 0.8),
        ('exp', magnitudes(-1074, 10), 0.8),
        ('expm1', between(-2.0, 2.0), 0.95),
        ('expm1', between(-50.0, 710.0), 0.95),
        ('expm1', magnitudes(-1074, 9), 0.95),
        ('tanh', between(-2.0, 2.0), 0.8),
        ('tanh', magnitudes(-1074, 10), 0.8),
        ('log', between(0.5, 2.0), 0.85),
        ('log', np.abs(magnitudes(-1074, 1024)), 0.75),
        ('log', 1.0 + magnitudes(-52, -1), 0.85),
        ('log1p', between(-0.99, 3.0), 0.85),
        ('log1p', np.abs(magnitudes(-1074, 1024)), 0.85),
        ('log1p', -np.abs(magnitudes(-1074, 0)), 0.85),
        ('arctan', between(-3.0, 3.0), 0.7),
        ('arctan', magnitudes(-1074, 1024), 0.7),
        ('arcsin', between(-1.0, 1.0), 0.7),
        ('arcsin', magnitudes(-1074, 0), 0.7),
        ('arccos', between(-1.0, 1.0), 0.7),
        ('arccos', 1.0 - np.abs(magnitudes(-53, 0)), 0.7),
    ],
)
def test_a_function_is_right_to_the_last_place(name, x, limit):
    reference = {'arctan': 'atan', 'arcsin': 'asin', 'arccos': 'acos'}.get(name, name)
    assert worst(name, getattr(mpmath, reference), x) < limit


@pytest.mark.parametrize(
    ('name', 'x', 'y', 'limit'),
    [
        ('arctan2', between(-1.0, 1.0), between(-1.0, 1.0), 0.7),
        ('arctan2', magnitudes(-1074, 1024), magnitudes(-1074, 1024), 1.0),
        ('hypot', between(-1.0, 1.0), between(-1.0, 1.0), 0.55),
        ('hypot', magnitudes(-1074, 1023), magnitudes(-1074, 1023), 0.8),
        ('power', between(0.0, 1.0), between(-10.0, 10.0), 0.7),
        ('power', np.abs(magnitudes(-30, 30)), between(-25.0, 25.0), 0.7),
        ('power', np.exp(between(-0.35, 0.35)), between(-2000.0, 2000.0), 0.97),
        ('power', np.abs(magnitudes(-1074, 1024)), between(-1.0, 1.0), 0.8),
    ],
)
def test_a_function_of_two_numbers_is_right_to_the_last_place(name, x, y, limit):
    reference = {'arctan2': 'atan2', 'power': 'power'}.get(name, name)
    assert worst(name, getattr(mpmath, reference), x, y) < limit


SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -2.0, 3.0, 5e-324, -5e-324, 1e308, -1e308, np.inf, -np.inf, np.nan]
)


def signs(x):
    return np.where(np.isnan(x), False, np.signbit(x))


def reporting(function, arguments):
    """The result, and the first words of warnings."""
    with warnings.catch_warnings(record=True) as caught, np.errstate(all='warn', under='ignore'):
        warnings.simplefilter('always')
        result = function(*arguments)
    return result, [str(each.message).split(' ')[0] for each in caught]


@pytest.mark.parametrize('name', [each for each in dir(elementary) if each[0] != '_'])
def test_special_values_and_warnings_are_those_of_numpy(name):
    function, reference = getattr(elementary, name), getattr(np, name)
    given = [x.ravel() for x in np.meshgrid(*[SPECIAL] * function.nin)]
    if name == 'power':  # of positive numbers
        given = [x[~np.signbit(given[0])] for x in given]
    for arguments in zip(*given):
        result, reported = reporting(function, arguments)
        wanted, usual = reporting(reference, arguments)
        assert result == pytest.approx(wanted, rel=1e-14, abs=0.0, nan_ok=True), arguments
        assert signs(result) == signs(wanted), arguments
        if np.isfinite(arguments).all():  # numpy's power warns of powers of infinity
            assert reported == usual, arguments


@pytest.mark.parametrize('name', ['sin', 'exp', 'log1p', 'arctan2', 'power'])
def test_every_layout_and_length_gives_the_same_bytes(name):
    function = getattr(elementary, name)
    given = [RNG.uniform(0.1, 9.0, (30, 41)) for _ in range(function.nin)]
    whole = function(*given)
    each = [function(*x) for x in zip(*(x.ravel() for x in given))]
    np.testing.assert_array_equal(whole.ravel(), each)
    np.testing.assert_array_equal(function(*(x.T for x in given)), whole.T)
    np.testing.assert_array_equal(function(*(x[::2, ::-3] for x in given)), whole[::2, ::-3])
    np.testing.assert_array_equal(function(*(x[:, :1].copy() for x in given)), whole[:, :1])
    out = given[0].copy()
    function(out, *given[1:], out=out)
    np.testing.assert_array_equal(out, whole)


def test_types_are_those_of_numpy():
    assert isinstance(elementary.exp(1), np.float64)
    assert elementary.exp(np.ones(3, np.float32)).dtype == np.float32
    assert elementary.exp(np.arange(3)).dtype == np.float64
    assert elementary.exp([]).shape == (0,)
    assert elementary.hypot(np.ones((3, 1)), np.ones(4)).shape == (3, 4)
    with pytest.raises(TypeError, match='exp'):
        elementary.exp('text')
    with pytest.raises(TypeError, match='exp'):
        elementary.exp(1j)
    with pytest.raises(ValueError, match='broadcast'):
        elementary.hypot(np.ones(3), np.ones(4))
