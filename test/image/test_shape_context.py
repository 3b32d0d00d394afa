from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.experts.descriptor.shape_context import (
    ANGULAR,
    RADIAL,
    RADII,
    ShapeContextCodebook,
    cluster_centres,
    shape_contexts,
    squared_distances,
)


def cloud(seed: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 2)) * [20, 50]


def test_contexts_count_points_by_distance_and_direction() -> None:
    points = cloud(0)
    found = shape_contexts(points)
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    mean = gaps.sum() / (60 * 59)
    edges = mean * RADII[0] * (RADII[1] / RADII[0]) ** (np.arange(RADIAL + 1) / RADIAL)
    for i in (0, 17, 59):
        wanted = np.zeros((RADIAL, ANGULAR))
        for j in range(60):
            d = points[j] - points[i]
            ring = np.searchsorted(edges, np.linalg.norm(d), side='right') - 1
            if j != i and 0 <= ring < RADIAL:
                turn = np.arctan2(d[1], d[0]) % (2 * np.pi)
                wanted[ring, int(turn / (2 * np.pi) * ANGULAR)] += 1 / 59
        np.testing.assert_allclose(found[i], wanted.ravel(), atol=1e-12)


def test_place_and_size_do_not_count_but_rotation_does() -> None:
    points = cloud(1)
    np.testing.assert_allclose(shape_contexts(3.0 * points + [100, -7]), shape_contexts(points))
    assert np.abs(shape_contexts(points[:, ::-1]) - shape_contexts(points)).max() > 0.05


def test_histogram_is_by_inverse_distance_and_sums_to_one() -> None:
    contexts = shape_contexts(cloud(2))
    codebook = ShapeContextCodebook.of(contexts, 12)
    found = codebook.histogram(contexts)
    assert found.sum() == pytest.approx(1.0)
    wanted = np.zeros(12)
    for c in np.sqrt(contexts):
        distance = np.linalg.norm(c - codebook.centres, axis=1)
        near = np.argsort(distance)[:4]
        vote = 1 / np.maximum(distance[near], 1e-3)
        wanted[near] += vote / vote.sum() / len(contexts)
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_codebook_is_the_same_for_the_same_contexts() -> None:
    contexts = shape_contexts(cloud(3))
    first, second = (ShapeContextCodebook.of(contexts, 10, seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.centres, second.centres)


def test_clusters_of_separate_groups_are_found() -> None:
    rng = np.random.default_rng(5)
    middles = np.array([[0, 0], [10, 0], [0, 10.0]])
    points = (middles[:, None] + 0.1 * rng.normal(size=(3, 40, 2))).reshape(-1, 2)
    centres = cluster_centres(points, 3, seed=1)
    nearest = squared_distances(middles, centres).min(1)
    assert nearest.max() < 0.01


def test_more_clusters_than_different_points() -> None:
    centres = cluster_centres(np.repeat([[1.0, 2.0], [3.0, 4.0]], 5, axis=0), 4)
    assert np.isfinite(centres).all()


@pytest.mark.parametrize('bad', ['few', 'nan'])
def test_contexts_that_give_no_codebook(bad: str) -> None:
    contexts = shape_contexts(cloud(6))
    if bad == 'few':
        with pytest.raises(ValueError, match='60 shape contexts for 61 centres'):
            ShapeContextCodebook.of(contexts, 61)
    else:
        contexts[3, 3] = np.nan
        with pytest.raises(ValueError, match='finite'):
            ShapeContextCodebook.of(contexts, 5)


def test_centres_of_another_shape() -> None:
    with pytest.raises(ValueError, match='60'):
        ShapeContextCodebook(np.zeros((5, 7)))
