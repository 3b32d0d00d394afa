"""Capsules that larger ones hold, against depths of their points."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hmt_ros.body.keep_out import Capsules
from hmt_ros.core import find_not_held
from test.core.arguments import assert_arguments_are_checked


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40))
def test_those_with_points_outside_are_kept(seed, count):
    rng = np.random.default_rng(seed)
    starts, ends = rng.normal(size=(2, count, 3))
    radii = rng.uniform(0.3, 2.0, count)
    # A ball around each capsule holds its points.
    size = 0.5 * np.linalg.norm(ends - starts, axis=1) + radii
    spread = rng.uniform(-1, 1, size=(count, 5, 3)) / np.sqrt(3)
    points = 0.5 * (starts + ends)[:, None] + size[:, None, None] * spread
    kept = np.empty(count, dtype=np.bool_)
    find_not_held(starts, ends, radii, points, kept)
    wanted = np.zeros(count, dtype=np.bool_)
    for i in range(count):
        before = Capsules(starts[:i], ends[:i], radii[:i])[wanted[:i]]
        wanted[i] = not before.contain(points[i]).all()
    np.testing.assert_array_equal(kept, wanted)


def test_capsules_need_arguments_that_fit():
    capsules = {
        'starts': np.zeros((4, 3)),
        'ends': np.ones((4, 3)),
        'radii': np.ones(4),
        'points': np.zeros((4, 2, 3)),
        'kept': np.empty(4, dtype=np.bool_),
    }
    assert_arguments_are_checked(find_not_held, capsules, 'kept')
