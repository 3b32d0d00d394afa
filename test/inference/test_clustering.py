from __future__ import annotations

import numpy as np

from hmt_ros.inference.clustering import (
    k_means,
    smallest_columns,
    spread_points,
    squared_distances,
)


def test_clusters_of_separate_groups_are_found() -> None:
    rng = np.random.default_rng(5)
    middles = np.array([[0, 0], [10, 0], [0, 10.0]])
    points = (middles[:, None] + 0.1 * rng.normal(size=(3, 40, 2))).reshape(-1, 2)
    centres, labels = k_means(points, 3, np.random.default_rng(1))
    assert squared_distances(middles, centres).min(1).max() < 0.01
    assert all(len(set(labels[i : i + 40])) == 1 for i in (0, 40, 80))
    for k, centre in enumerate(centres):
        np.testing.assert_allclose(centre, points[labels == k].mean(0), atol=1e-12)


def test_the_same_seed_gives_the_same_clusters() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    one, two = (k_means(points, 7, np.random.default_rng(4)) for _ in range(2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def test_labels_are_of_the_nearest_centre() -> None:
    points = np.random.default_rng(1).normal(size=(150, 4))
    centres, labels = k_means(points, 5, np.random.default_rng(0), iterations=200)
    np.testing.assert_array_equal(labels, squared_distances(points, centres).argmin(1))


def test_more_clusters_than_different_points() -> None:
    points = np.repeat([[1.0, 2.0], [3.0, 4.0]], 5, axis=0)
    centres, labels = k_means(points, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(centres[labels], points)
    assert len(centres) == 2


def test_spread_points_take_equal_points_once() -> None:
    rng = np.random.default_rng(0)
    points = np.repeat(rng.normal(size=(6, 2)), 10, axis=0)
    chosen = spread_points(points, 40, rng)
    assert len(chosen) == 6
    assert len(np.unique(points[chosen], axis=0)) == 6


def test_the_smallest_columns_are_the_first_of_equal_ones() -> None:
    values = np.random.default_rng(2).integers(0, 6, size=(50, 20)).astype(float)
    for count in (1, 7, 20):
        wanted = np.sort(np.argsort(values, axis=1, kind='stable')[:, :count], axis=1)
        np.testing.assert_array_equal(smallest_columns(values, count), wanted)
