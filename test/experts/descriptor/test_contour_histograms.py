from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.training.descriptor_learning import learned_codebook
from hmt_ros.experts.descriptor.contour import sample_contour
from hmt_ros.experts.descriptor.silhouette_descriptor import (
    ANGULAR_BINS,
    PAIR_ANGLES,
    PAIR_BINS,
    PAIR_DISTANCES,
    RADIAL_BINS,
    RADII,
    ShapeContextCodebook,
    edge_pairs,
    shape_contexts,
)


def cloud(seed: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 2)) * [20, 50]


def test_contexts_count_points_by_distance_and_direction() -> None:
    points = cloud(0)
    found = shape_contexts(points)
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    mean = gaps.sum() / (60 * 59)
    edges = mean * RADII[0] * (RADII[1] / RADII[0]) ** (np.arange(RADIAL_BINS + 1) / RADIAL_BINS)
    for i in (0, 17, 59):
        wanted = np.zeros((RADIAL_BINS, ANGULAR_BINS))
        for j in range(60):
            d = points[j] - points[i]
            ring = np.searchsorted(edges, np.linalg.norm(d), side='right') - 1
            if j != i and 0 <= ring < RADIAL_BINS:
                turn = np.arctan2(d[1], d[0]) % (2 * np.pi)
                wanted[ring, int(turn / (2 * np.pi) * ANGULAR_BINS)] += 1 / 59
        np.testing.assert_allclose(found[i], wanted.ravel(), atol=1e-12)


def test_contexts_change_with_rotation_alone() -> None:
    points = cloud(1)
    np.testing.assert_allclose(shape_contexts(3.0 * points + [100, -7]), shape_contexts(points))
    assert np.abs(shape_contexts(points[:, ::-1]) - shape_contexts(points)).max() > 0.05


def test_histogram_is_by_inverse_distance_and_sums_to_one() -> None:
    contexts = shape_contexts(cloud(2))
    codebook = learned_codebook(contexts, 12)
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
    first, second = (learned_codebook(contexts, 10, seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.centres, second.centres)


@pytest.mark.parametrize('bad', ['few', 'nan'])
def test_contexts_that_give_no_codebook(bad: str) -> None:
    contexts = shape_contexts(cloud(6))
    if bad == 'few':
        with pytest.raises(ValueError, match='60 shape contexts for 61 centres'):
            learned_codebook(contexts, 61)
    else:
        contexts[3, 3] = np.nan
        with pytest.raises(ValueError, match='finite'):
            learned_codebook(contexts, 5)


def test_centres_of_another_shape() -> None:
    with pytest.raises(ValueError, match='60'):
        ShapeContextCodebook(np.zeros((5, 7)))


def described(mask: np.ndarray) -> np.ndarray:
    points, directions = sample_contour(mask, 100)
    return edge_pairs(points, directions, mask)


def rectangle(height: int, width: int) -> np.ndarray:
    mask = np.zeros((220, 220), np.uint8)
    mask[10 : 10 + height, 10 : 10 + width] = 1
    return mask


def test_edge_pairs_are_a_histogram() -> None:
    found = described(rectangle(150, 40))
    assert found.shape == (PAIR_BINS,)
    np.testing.assert_allclose(found.sum(), 1.0)
    assert found.min() >= 0


def test_both_sides_of_a_limb_run_against_each_other() -> None:
    table = described(rectangle(200, 30)).reshape(PAIR_DISTANCES, PAIR_ANGLES)
    # Edges of one side are parallel, those of opposite sides antiparallel; except at the ends there
    # are no other angles.
    assert table[:, -1].sum() > 0.35
    assert table[:, 0].sum() > 0.35
    assert table[:, [0, -1]].sum() > 0.75


def test_rotation_place_and_size_hardly_change_edge_pairs() -> None:
    tall = rectangle(160, 50)
    wide = np.ascontiguousarray(tall.T)
    large = np.ascontiguousarray(np.kron(tall, np.ones((2, 2), np.uint8)))
    moved = np.roll(tall, (30, 40), axis=(0, 1))
    for other in (wide, large, moved):
        assert np.abs(described(other) - described(tall)).sum() < 0.12


def test_pairs_across_a_gap_do_not_count() -> None:
    # Two bars side by side: connections between them leave the silhouette.
    two = np.zeros((200, 120), np.uint8)
    two[10:190, 10:40] = 1
    two[10:190, 80:110] = 1
    points, directions = sample_contour(two, 100)
    counted = edge_pairs(points, directions, two).reshape(PAIR_DISTANCES, PAIR_ANGLES)
    every = edge_pairs(points, directions, np.ones_like(two)).reshape(PAIR_DISTANCES, PAIR_ANGLES)
    first, second = np.triu_indices(100, 1)
    left = points[:, 0] < 60
    off = points[second] - points[first]
    distance = np.linalg.norm(off, axis=1)
    same = left[first] == left[second]
    near = distance[same] / distance.mean()
    wanted = np.clip(np.log(8 * near) * PAIR_DISTANCES / np.log(24), 0, PAIR_DISTANCES - 1).astype(
        int
    )
    np.testing.assert_allclose(
        counted.sum(1), np.bincount(wanted, minlength=PAIR_DISTANCES) / len(wanted), atol=0.02
    )
    assert np.abs(every - counted).sum() > 0.3
