"""Capsules enclosed by larger ones, against depths of their points."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hmt_ros.body.keep_out import Capsules
from hmt_ros.core import find_not_held
from test.core.arguments import assert_arguments_are_checked

ANGLES = np.arange(8) * (np.pi / 4)
RING = np.stack([np.cos(ANGLES), np.sin(ANGLES)])


def surfaces(capsules):
    """Points (N, 26, 3) around three places of each axis, and beyond its ends."""
    axes = capsules.ends - capsules.starts
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    along = np.where(lengths > 1e-9, axes / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    ring = RING[0][:, None] * side[:, None] + RING[1][:, None] * other[:, None]
    ring *= capsules.radii[:, None, None]
    places = capsules.starts[:, None] + np.array([0.0, 0.5, 1.0])[:, None] * axes[:, None]
    around = (places[:, :, None] + ring[:, None]).reshape(len(axes), 24, 3)
    tips = capsules.radii[:, None] * along
    beyond = [(capsules.starts - tips)[:, None], (capsules.ends + tips)[:, None]]
    return np.concatenate([around, *beyond], axis=1)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40), short=st.booleans())
def test_those_with_points_outside_are_kept(seed, count, short):
    rng = np.random.default_rng(seed)
    starts, ends = rng.normal(size=(2, count, 3))
    if short:
        ends[::2] = starts[::2]
    radii = rng.uniform(0.3, 2.0, count)
    points = surfaces(Capsules(starts, ends, radii))
    kept = np.empty(count, dtype=np.bool_)
    find_not_held(starts, ends, radii, RING, kept)
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
        'ring': np.zeros((2, 8)),
        'kept': np.empty(4, dtype=np.bool_),
    }
    assert_arguments_are_checked(find_not_held, capsules, 'kept')
