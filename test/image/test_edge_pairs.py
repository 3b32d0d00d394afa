from __future__ import annotations

import numpy as np

from hmt_ros.experts.descriptor.contour import sample_contour
from hmt_ros.experts.descriptor.edge_pairs import ANGLES, DISTANCES, SIZE, edge_pairs


def described(mask: np.ndarray) -> np.ndarray:
    points, directions = sample_contour(mask, 100)
    return edge_pairs(points, directions, mask)


def rectangle(height: int, width: int) -> np.ndarray:
    mask = np.zeros((220, 220), np.uint8)
    mask[10 : 10 + height, 10 : 10 + width] = 1
    return mask


def test_it_is_a_histogram() -> None:
    found = described(rectangle(150, 40))
    assert found.shape == (SIZE,)
    np.testing.assert_allclose(found.sum(), 1.0)
    assert found.min() >= 0


def test_both_sides_of_a_limb_run_against_each_other() -> None:
    table = described(rectangle(200, 30)).reshape(DISTANCES, ANGLES)
    # Two edges of one side run alike, of opposite sides against each other; but for the ends there
    # is no other angle.
    assert table[:, -1].sum() > 0.35
    assert table[:, 0].sum() > 0.35
    assert table[:, [0, -1]].sum() > 0.75


def test_rotation_place_and_size_hardly_count() -> None:
    tall = rectangle(160, 50)
    wide = np.ascontiguousarray(tall.T)
    large = np.ascontiguousarray(np.kron(tall, np.ones((2, 2), np.uint8)))
    moved = np.roll(tall, (30, 40), axis=(0, 1))
    for other in (wide, large, moved):
        assert np.abs(described(other) - described(tall)).sum() < 0.12


def test_pairs_across_a_gap_do_not_count() -> None:
    # Two bars beside each other: what connects one with the other leaves the silhouette.
    two = np.zeros((200, 120), np.uint8)
    two[10:190, 10:40] = 1
    two[10:190, 80:110] = 1
    points, directions = sample_contour(two, 100)
    counted = edge_pairs(points, directions, two).reshape(DISTANCES, ANGLES)
    every = edge_pairs(points, directions, np.ones_like(two)).reshape(DISTANCES, ANGLES)
    first, second = np.triu_indices(100, 1)
    left = points[:, 0] < 60
    off = points[second] - points[first]
    distance = np.linalg.norm(off, axis=1)
    same = left[first] == left[second]
    near = distance[same] / distance.mean()
    wanted = np.clip(np.log(8 * near) * DISTANCES / np.log(24), 0, DISTANCES - 1).astype(int)
    np.testing.assert_allclose(
        counted.sum(1), np.bincount(wanted, minlength=DISTANCES) / len(wanted), atol=0.02
    )
    assert np.abs(every - counted).sum() > 0.3
