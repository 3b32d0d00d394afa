from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.experts.descriptor.internal_edges import ANGLES, CELLS, EDGES, SCALES, internal_edges

SIDE = 128
MASK = np.zeros((SIDE, SIDE), np.uint8)
MASK[4:124, 34:94] = 1
CENTRE, WIDTH = (63.5, 63.5), 160.0


def edges_of(grey: np.ndarray, mask: np.ndarray = MASK) -> np.ndarray:
    """Amounts (S, CELLS, CELLS, ANGLES)."""
    found = internal_edges(grey.astype(np.uint8), mask, CENTRE, WIDTH)
    assert found.shape == (EDGES,)
    return np.square(found).reshape(len(SCALES), CELLS, CELLS, ANGLES)


def test_a_person_of_one_colour_has_none() -> None:
    """This holds for any background."""
    for behind in (0, 255):
        grey = np.full(MASK.shape, behind)
        grey[MASK > 0] = 120
        assert edges_of(grey).sum() < 1e-2


def test_what_is_behind_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    inside = rng.integers(0, 255, MASK.shape)
    one, other = (np.where(MASK > 0, inside, x) for x in (0, rng.integers(0, 255, MASK.shape)))
    np.testing.assert_array_equal(edges_of(one), edges_of(other))


@pytest.mark.parametrize('along', [0, 1])
def test_an_edge_is_where_it_is_and_has_its_angle(along: int) -> None:
    """A step from left to right has a horizontal gradient, angle 0; one down has a right angle."""
    at = np.indices(MASK.shape)[1 - along]
    found = edges_of(np.where(at < 64, 60, 180)).sum(0)
    by_angle = found.sum((0, 1))
    assert by_angle.argmax() == (0 if along == 0 else ANGLES // 2)
    assert by_angle.max() > 0.95 * by_angle.sum()
    by_line = found.sum((along, 2))
    assert by_line[3:5].sum() > 0.95 * by_line.sum()


def test_contrast_and_brightness_change_little() -> None:
    rng = np.random.default_rng(1)
    steps = np.kron(rng.integers(0, 120, (8, 8)), np.ones((16, 16)))
    one, other = edges_of(steps), edges_of(2 * steps + 10)
    np.testing.assert_allclose(one.sum(), other.sum(), rtol=0.02)


def test_a_fine_pattern_counts_less_than_a_limb() -> None:
    columns = np.indices(MASK.shape)[1]
    stripes, limb = (np.where(columns % (2 * w) < w, 60, 180) for w in (2, 24))
    assert edges_of(stripes).sum() < 0.4 * edges_of(limb).sum()


@pytest.mark.parametrize('mask', [np.zeros((40, 40), np.uint8), np.eye(40, dtype=np.uint8)])
def test_a_person_too_thin(mask: np.ndarray) -> None:
    assert internal_edges(np.zeros((40, 40), np.uint8), mask, (20, 20), 60.0).max() == 0.0


def test_a_person_who_fills_the_image() -> None:
    grey = np.random.default_rng(2).integers(0, 255, MASK.shape)
    assert np.isfinite(edges_of(grey, np.ones_like(MASK))).all()
