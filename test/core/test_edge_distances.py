"""Distances from edges: the shortest paths on the grid, for every orientation."""

from __future__ import annotations

import numpy as np

from hmt_ros.core import ORIENTATIONS, edge_distances
from test.core.arguments import assert_arguments_are_checked

# Lengths of straight and diagonal steps, px.
BESIDE, ACROSS = 0.955, 1.3693


def arguments(rng, share=0.02, shape=(23, 31)):
    return {
        'edges': np.where(rng.random(shape) < share, 255, 0).astype(np.uint8),
        'dx': rng.integers(-900, 900, shape).astype(np.int16),
        'dy': rng.integers(-900, 900, shape).astype(np.int16),
        'near': (rng.random(shape) < 0.8).astype(np.uint8),
        'others': (rng.random(shape) < 0.1).astype(np.uint8),
        'hidden': 2.0,
        'distances': np.empty((ORIENTATIONS, *shape), np.float32),
    }


def expected(edges, dx, dy, near, others, hidden, distances):
    rows, columns = np.nonzero(edges & near * (others == 0))
    angle = np.arctan2(dy[rows, columns].astype(float), dx[rows, columns])
    result = np.full_like(distances, 1000.0)
    grid = np.indices(edges.shape)
    width = np.pi / ORIENTATIONS
    for k in range(ORIENTATIONS):
        off = (angle - k * width + 0.5 * np.pi) % np.pi - 0.5 * np.pi
        for row, column in zip(rows, columns):
            away = np.sort(np.abs(grid - np.array([row, column])[:, None, None]), axis=0)
            way = ACROSS * away[0] + BESIDE * (away[1] - away[0])
            if np.abs(off[(rows == row) & (columns == column)]) <= 0.75 * width:
                np.minimum(result[k], way, out=result[k])
        result[k][others > 0] = hidden
    return result


def test_distances_are_those_of_the_shortest_ways():
    rng = np.random.default_rng(0)
    for share in (0.0, 0.003, 0.02, 0.3):
        given = arguments(rng, share)
        edge_distances(*given.values())
        np.testing.assert_allclose(given['distances'], expected(**given), rtol=1e-5, atol=1e-5)


def test_all_is_near_and_nobody_hides_without_masks():
    given = arguments(np.random.default_rng(1))
    nothing, found = np.zeros((0, 0), np.uint8), given['distances']
    edge_distances(*(given | {'near': nothing, 'others': nothing}).values())
    given |= {'near': np.ones_like(given['near']), 'others': np.zeros_like(given['others'])}
    np.testing.assert_allclose(found, expected(**given), rtol=1e-5, atol=1e-5)


def test_arguments_are_checked():
    given = arguments(np.random.default_rng(2))
    assert_arguments_are_checked(edge_distances, given, 'distances', free='near others')
    for shape in ((0, 5), (5, 0), (1, 1)):
        edge_distances(*arguments(np.random.default_rng(3), shape=shape).values())
