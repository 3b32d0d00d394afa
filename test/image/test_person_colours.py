"""Colours of a person: shares, surroundings, and where they are in an image."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.image.person_colours import Colours


def scene(left, colour=(40, 40, 200)):
    """A person in red, 20 px wide from a column on, before a green wall, and the mask."""
    image = np.full((120, 160, 3), (60, 160, 60), dtype=np.uint8)
    model = np.zeros((120, 160), dtype=np.bool_)
    if left is not None:
        image[30:100, left : left + 20] = colour
        model[30:100, left : left + 20] = True
    return image, model


def textured(left):
    """The same person before a striped wall."""
    image, model = scene(left)
    image[:, ::8][~model[:, ::8]] = 120, 60, 20
    return image, model


def test_a_scene_is_still_whoever_leaves_it():
    rng = np.random.default_rng(0)
    colours = Colours()
    image, model = textured(20)
    assert colours.stillness(image) == 0.0
    colours.learn(image, model, 0.1)
    noisy = np.clip(textured(None)[0] + rng.normal(0.0, 8.0, image.shape), 0, 255)
    assert colours.stillness(image) == 1.0
    assert colours.stillness(noisy.astype(np.uint8)) == 1.0


@pytest.mark.parametrize('left', [60, 120, 130])
def test_a_scene_in_which_somebody_moves_is_another(left):
    colours = Colours()
    colours.learn(*textured(20), 0.1)
    assert colours.stillness(textured(left)[0]) == 0.0


@pytest.mark.parametrize('shift', [2, 5, 30])
def test_a_camera_that_turns_sees_another_scene(shift):
    colours = Colours()
    colours.learn(*textured(20), 0.1)
    assert colours.stillness(np.roll(textured(None)[0], shift, axis=1)) == 0.0


def test_colours_that_no_image_had_may_be_those_of_the_person():
    colours = Colours()
    colours.learn(*scene(20), 0.1)
    back = scene(20, (200, 40, 40))[0]
    assert colours.score(back) == pytest.approx(0.0, abs=0.05)
    assert colours.score(back, unseen=1.0) == pytest.approx(1.0, abs=0.05)
    assert colours.score(scene(None)[0], unseen=1.0) == pytest.approx(0.0, abs=0.05)
