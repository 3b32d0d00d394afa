from pathlib import Path

import numpy as np
import pytest

from hmt_ros.core import add_band_product

ROOT = Path(__file__).resolve().parents[2]


def in_order(x, y):
    """The sum of products in the order that the header defines."""
    whole = len(x) - len(x) % 8
    s = [0.0] * 8
    for i in range(whole):
        s[i % 8] += x[i] * y[i]
    total = ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]))
    for i in range(whole, len(x)):
        total += x[i] * y[i]
    return total


@pytest.mark.parametrize('count', [1, 7, 8, 9, 16, 31, 40])
def test_sums_have_the_bits_of_their_order(count):
    rng = np.random.default_rng(count)
    for start in range(4):
        columns, x = np.zeros((start + count, count)), rng.standard_normal((1, start + count))
        columns[start] = rng.standard_normal(count)
        result = np.zeros_like(x)
        add_band_product(columns, x, result)
        assert result[0, start] == in_order(columns[start], x[0, start:])


def test_nothing_is_compiled_with_leave_to_reorder():
    """Otherwise the last bits would depend on the compiler and the processor."""
    files = [ROOT / 'setup.py', *(ROOT / 'hmt_ros').rglob('*.h'), *(ROOT / 'hmt_ros').rglob('*.py')]
    assert len(files) > 100
    words = ('fast' + 'math', 'fast-' + 'math', 'associative-' + 'math', 'unsafe-math')
    assert [f.name for f in files if any(word in f.read_text('utf-8') for word in words)] == []
    assert '-ffp-contract=off' in files[0].read_text('utf-8')
