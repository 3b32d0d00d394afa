"""Colours of a person: shares, surroundings, and where an image shows them."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.tracking.colours import BINS, Colours, binned, shares, surroundings


def test_surroundings_are_near_and_not_the_model():
    model = np.zeros((60, 80), dtype=np.bool_)
    model[20:40, 30:40] = True
    around = surroundings(model)
    assert not (around & model).any()
    assert around[20, 22]
    assert not around[20, 28]  # a margin, for the clothes
    rows, columns = np.nonzero(around)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 49, 20, 49)


def test_shares_of_colours():
    image = np.zeros((2, 4, 3), dtype=np.uint8)
    image[0, 1:] = (10, 100, 250)
    where = np.ones((2, 4), dtype=np.bool_)
    where[1] = False
    found = shares(binned(image), where)
    assert found[0] == 0.25
    assert found[(0 * BINS + 3) * BINS + 7] == 0.75
    assert found.sum() == 1.0
    assert shares(binned(image), np.zeros((2, 4), dtype=np.bool_)).sum() == 0.0


def scene(left, colour=(40, 40, 200)):
    """Somebody in red before a green wall, 20 px wide, from a column on, and where."""
    image = np.full((120, 160, 3), (60, 160, 60), dtype=np.uint8)
    model = np.zeros((120, 160), dtype=np.bool_)
    if left is not None:
        image[30:100, left : left + 20] = colour
        model[30:100, left : left + 20] = True
    return image, model


def test_they_are_found_anywhere():
    colours = Colours()
    assert colours.score(scene(20)[0]) is None
    for _ in range(3):
        colours.learn(*scene(20), 0.1)
    assert colours.score(scene(20)[0]) == pytest.approx(1.0, abs=0.05)
    assert colours.score(scene(100)[0]) == pytest.approx(1.0, abs=0.05)
    assert colours.score(scene(None)[0]) == pytest.approx(0.0, abs=0.05)
    assert colours.score(scene(20, (200, 40, 40))[0]) == pytest.approx(0.0, abs=0.05)
    # An image in other colours is another light, or a covered lens.
    assert colours.score(np.zeros((120, 160, 3), np.uint8)) is None


def test_colours_of_the_wall_say_nothing():
    colours = Colours()
    for _ in range(3):
        colours.learn(*scene(20, (60, 160, 60)), 0.1)
    assert colours.score(scene(20, (60, 160, 60))[0]) is None
