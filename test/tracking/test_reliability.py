"""How far silhouettes are believed, by what they have shown of each segment."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.image.texture import Textures
from hmt_ros.tracking.reliability import SilhouetteRecall


def seen(segments, pixels):
    n = len(segments)
    return Textures(
        np.array([n]), np.array([segments]), np.zeros((1, n, 3)), np.array([pixels], float),
        np.zeros((1, n, 3)),
    )  # fmt: skip


@pytest.fixture
def textures():
    """Ten points of segment 0 in column 1, ten of segment 2 in column 3."""
    return seen([0] * 10 + [2] * 10, [(1, i) for i in range(10)] + [(3, i) for i in range(10)])


def test_a_segment_that_was_never_foreground_is_not_believed(textures):
    foreground = np.zeros((10, 5), dtype=bool)
    foreground[:, 1] = True
    recall = SilhouetteRecall(3)
    recall.update(textures, 0, foreground)
    assert list(recall.beliefs) == [1.0, 1.0, 0.0]
    assert not recall.believed


def test_belief_comes_back_slowly(textures):
    recall = SilhouetteRecall(3)
    recall.update(textures, 0, np.zeros((10, 5), dtype=bool))
    assert not recall.believed
    images = 0
    while not recall.believed:
        recall.update(textures, 0, np.ones((10, 5), dtype=bool))
        images += 1
    assert 10 < images < 40
    assert recall.beliefs[1] == 1.0


def test_points_outside_the_image_say_nothing():
    recall = SilhouetteRecall(1)
    recall.update(seen([0, 0], [(-3, 0), (7, 0)]), 0, np.zeros((4, 4), dtype=bool))
    assert recall.believed
    assert recall.beliefs[0] == 1.0
    recall.update(seen([], np.zeros((0, 2))), 0, np.zeros((4, 4), dtype=bool))
    assert recall.beliefs[0] == 1.0
