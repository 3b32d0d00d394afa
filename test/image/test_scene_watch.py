"""A moved camera is noticed; people and changes of light are not mistaken for it."""

from functools import cache

import cv2
import numpy as np
import pytest

from hmt_ros.image.background import BackgroundModel, SceneWatch

SIZE = (640, 480)


@pytest.fixture(scope='module')
def room():
    """An empty room (480, 640, 3) with furniture, in soft light."""
    rng = np.random.default_rng(3)
    image = np.full((480, 640, 3), 120, np.uint8)
    for _ in range(25):
        x, y = rng.integers(0, 600), rng.integers(0, 440)
        width, height = rng.integers(20, 160, 2)
        colour = tuple(int(c) for c in rng.integers(30, 220, 3))
        cv2.rectangle(image, (int(x), int(y)), (int(x + width), int(y + height)), colour, -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def seen(room, index, shift=(0.0, 0.0), angle=0.0, light=1.0):
    """The room with noise and a person who walks through it, from a moved camera."""
    image = room.copy()
    left = 40 + 6 * index
    cv2.rectangle(image, (left, 120), (left + 110, 460), (40, 60, 200), -1)
    cv2.circle(image, (left + 55, 90), 40, (150, 170, 220), -1)
    turn = cv2.getRotationMatrix2D((320, 240), angle, 1.0)
    turn[:, 2] += shift
    image = cv2.warpAffine(image, turn, SIZE, borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(index).normal(0.0, 3.0, image.shape)
    return np.clip(light * image + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope='module')
def still(room):
    """Function (index) -> the image of a camera that has not moved, drawn once."""
    return cache(lambda index: seen(room, index))


def watched(room, still, count=60, **change):
    """The watch after a change in the middle, and the index of the image that revealed it."""
    watch, background, first = SceneWatch(), BackgroundModel.from_image(room), None
    for index in range(count):
        image = seen(room, index, **change) if index >= count // 2 else still(index)
        watch.update(image, background)
        if watch.moved and first is None:
            first = index
    return watch, first


@pytest.mark.parametrize('light', [1.0, 0.6, 1.3])
def test_people_and_light_are_no_motion_of_the_camera(room, still, light):
    watch, first = watched(room, still, light=light)
    assert first is None
    assert watch.shift == 0.0


@pytest.mark.parametrize('shift', [(4.0, 0.0), (-6.0, 8.0), (0.0, 20.0), (36.0, 0.0)])
def test_a_bump_is_noticed_and_measured(room, still, shift):
    watch, first = watched(room, still, shift=shift)
    assert watch.moved
    assert 30 <= first <= 50
    assert np.isclose(watch.shift, np.hypot(*shift), atol=2.0)


@pytest.mark.parametrize('change', [{'angle': 20.0}, {'shift': (200.0, 90.0)}])
def test_another_view_is_noticed(room, still, change):
    watch, first = watched(room, still, **change)
    assert watch.moved
    assert first >= 30


def test_one_bad_image_is_no_motion(room, still):
    watch, background = SceneWatch(), BackgroundModel.from_image(room)
    for index in range(60):
        image = seen(room, index, shift=(12.0, 0.0)) if index == 30 else still(index)
        watch.update(image, background)
        assert not watch.moved
