"""Colours of pixels, their histograms and the lengths of gradients, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.core import bin_colours, count_colours, gradient_lengths
from test.core.arguments import assert_arguments_are_checked

SHAPE, BINS = (13, 17), 8
RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (*SHAPE, 3)).astype(np.uint8)


def coloured():
    result = np.empty(SHAPE, np.uint16)
    bin_colours(IMAGE, BINS, result)
    return result


def test_bins_are_cubes_of_colours():
    parts = IMAGE.astype(int) // (256 // BINS)
    assert (coloured() == (parts @ [BINS**2, BINS, 1])).all()
    named = {'image': IMAGE, 'count': BINS, 'bins': coloured()}
    assert_arguments_are_checked(bin_colours, named, 'bins')
    with pytest.raises(ValueError, match='count: wanted'):
        bin_colours(IMAGE, 0, coloured())


def test_counts_are_those_of_regions():
    regions = RNG.integers(0, 3, SHAPE).astype(np.uint8)
    named = {'bins': coloured(), 'regions': regions, 'counts': np.empty((3, BINS**3), np.int64)}
    count_colours(*named.values())
    for region, found in enumerate(named['counts']):
        assert (found == np.bincount(coloured()[regions == region], minlength=BINS**3)).all()
    assert_arguments_are_checked(count_colours, named, 'counts', free='counts', unread='counts')
    with pytest.raises(ValueError, match='bins: wanted'):
        count_colours(coloured(), regions, np.empty((3, 5), np.int64))
    with pytest.raises(ValueError, match='regions: wanted'):
        count_colours(coloured(), regions, np.empty((1, BINS**3), np.int64))


def test_gradients_are_the_longest_of_a_channel():
    dx, dy = RNG.integers(-1020, 1021, (2, *SHAPE, 3)).astype(np.int16)
    named = {'dx': dx, 'dy': dy, 'longest': 900.0, 'lengths': np.empty(SHAPE, np.float32)}
    gradient_lengths(*named.values())
    wanted = np.minimum(np.hypot(dx.astype(float), dy).max(axis=2), 900.0)
    np.testing.assert_allclose(named['lengths'], wanted, rtol=1e-6)
    assert_arguments_are_checked(gradient_lengths, named, 'lengths')
