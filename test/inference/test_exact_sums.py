import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from hmt_ros.inference.exact_sums import dot


@njit
def dotted(x, y, start, count):
    return dot(x, y, start, count)


def rounded_once(a, b, c):
    return float(Fraction(a) * Fraction(b) + Fraction(c))


def in_order(x, y):
    """The sum as the docstring has it, in rational numbers that are rounded where it rounds."""
    whole = len(x) - len(x) % 8
    s = [0.0] * 8
    for i in range(whole):
        s[i % 8] = rounded_once(x[i], y[i], s[i % 8])
    total = ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]))
    for i in range(whole, len(x)):
        total = rounded_once(x[i], y[i], total)
    return total


@pytest.mark.parametrize('count', [0, 1, 7, 8, 9, 16, 31, 40])
def test_sums_have_the_bits_of_their_order(count):
    rng = np.random.default_rng(count)
    x, y = rng.standard_normal(count), rng.standard_normal(count + 3)
    for start in range(4):
        assert dotted(x, y, start, count) == in_order(x, y[start : start + count])


def test_a_part_of_a_row():
    rng = np.random.default_rng(1)
    matrix, y = rng.standard_normal((5, 12)), rng.standard_normal(12)
    assert dotted(matrix[3], y, 2, 9) == in_order(matrix[3, :9], y[2:11])
    assert math.isnan(dotted(np.full(9, np.nan), y, 0, 9))


def test_vectors_with_steps_are_refused():
    with pytest.raises(TypingError, match='wanted contiguous vectors'):
        dotted(np.zeros(16)[::2], np.zeros(8), 0, 8)


def test_nothing_is_compiled_with_leave_to_reorder():
    """Its last bits would depend on what was compiled before it."""
    package = Path(__file__).resolve().parents[2] / 'hmt_ros'
    files = list(package.rglob('*.py'))
    assert len(files) > 100
    assert [file.name for file in files if 'fastmath' in file.read_text('utf-8')] == []
