"""Lines compared with frames of directions, against numpy."""

from __future__ import annotations

import numpy as np

from hmt_ros.core import rate_frames, rate_lines
from test.core.arguments import assert_arguments_are_checked


def unit(rng, count):
    found = rng.normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def lines(rng, directions=40, count=13):
    return {
        'directions': unit(rng, directions),
        'normals': unit(rng, count),
        'middles': unit(rng, count),
        'deviations': rng.uniform(0.02, 0.15, count),
        'result': np.empty((directions, count)),
    }


def test_densities_are_those_of_the_angles_in_the_image():
    given = lines(np.random.default_rng(1))
    # One direction runs along the ray to a line.
    given['directions'][0] = given['middles'][0]
    rate_lines(*given.values())
    across = np.sqrt(np.maximum(1.0 - (given['directions'] @ given['middles'].T) ** 2, 1e-4))
    sine = np.minimum(np.abs(given['directions'] @ given['normals'].T) / across, 1.0)
    off = np.arcsin(sine) / given['deviations']
    wanted = np.sqrt(np.pi / 2.0) / given['deviations'] * np.exp(-0.5 * off**2)
    assert (wanted > 1.0).any()
    np.testing.assert_allclose(given['result'], wanted, rtol=1e-12, atol=1e-16)


def frames(rng, count=150):
    """Arguments with more lines than one product has factors."""
    return {
        'densities': rng.exponential(5.0, (20, count)),
        'vertical': rng.integers(0, 20, 6),
        'first': rng.integers(0, 20, (6, 3)),
        'second': rng.integers(0, 20, (6, 3)),
        'share': 0.4,
        'result': np.empty((6, 3)),
    }


def test_frames_are_rated_by_all_lines():
    given = frames(np.random.default_rng(2))
    rate_frames(*given.values())
    densities = given['densities']
    each = densities[given['vertical']][:, None] + densities[given['first']]
    wanted = np.log(0.6 + 0.4 / 3.0 * (each + densities[given['second']])).sum(2)
    np.testing.assert_allclose(given['result'], wanted, rtol=1e-12)


def test_no_line_is_no_evidence():
    given = frames(np.random.default_rng(3), 0)
    rate_frames(*given.values())
    assert (given['result'] == 0.0).all()


def test_arguments_are_checked():
    rng = np.random.default_rng(4)
    assert_arguments_are_checked(rate_lines, lines(rng), 'result', 'directions')
    assert_arguments_are_checked(rate_frames, frames(rng), 'result', 'densities')
