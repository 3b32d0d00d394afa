"""The vertical from the lines of a scene: drawn rooms, clutter, and uninformative images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hmt_ros.body import Camera
from hmt_ros.image.vertical_lines import seen_vertical
from test.image.drawn_rooms import ROOM_CAMERA as CAMERA
from test.image.drawn_rooms import drawn, room, turn


def boards() -> np.ndarray:
    """Lines (N, 2, 3) of a wooden floor, all in one direction."""
    return np.array([[[x, 1.5, 1.5], [x, 1.5, 8.0]] for x in np.arange(-3.0, 3.1, 0.25)])


def angle(up: np.ndarray, rotation: np.ndarray) -> float:
    """Angle between a vertical and the true one, deg."""
    true = rotation @ np.array([0.0, -1.0, 0.0])
    return float(np.degrees(np.arccos(np.clip(up @ true, -1.0, 1.0))))


@pytest.mark.parametrize(('pitch', 'roll'), [(0, 0), (10, 2), (20, -5), (32, 3), (-12, 0)])
def test_furniture_shows_the_vertical(pitch, roll):
    rotation = turn(np.radians(pitch), np.radians(roll))
    found = seen_vertical(drawn(room(), rotation), CAMERA)
    assert found is not None
    assert angle(found.up, rotation) < 1.0
    assert angle(found.up, rotation) < 2.5 * np.degrees(found.sigma)
    assert np.linalg.norm(found.up) == pytest.approx(1.0)


def test_boards_of_a_floor_are_not_the_vertical():
    """From above, they converge like vertical lines in front of a camera that looks up."""
    rotation = turn(np.radians(30.0), 0.0)
    assert seen_vertical(drawn(boards(), rotation), CAMERA) is None
    both = seen_vertical(drawn(np.concatenate([boards(), room()]), rotation), CAMERA)
    assert both is not None
    assert angle(both.up, rotation) < 1.0


def test_a_lens_that_bends_lines_is_taken_into_account():
    bent = Camera(330.0, 330.0, 319.5, 239.5, 640, 480, (-0.12, 0.02, 0.0, 0.0, 0.0))
    rotation = turn(np.radians(15.0), 0.0)
    edges = room()
    steps = np.linspace(0.0, 1.0, 9)
    pieces = edges[:, :1] + steps[None, :, None] * (edges[:, 1:] - edges[:, :1])
    short = np.stack([pieces[:, :-1], pieces[:, 1:]], axis=2).reshape(-1, 2, 3)
    found = seen_vertical(drawn(short, rotation, bent), bent)
    assert found is not None
    assert angle(found.up, rotation) < 1.5


@pytest.mark.parametrize('count', [0, 1, 10, 30, 100])
def test_clutter_shows_none(count):
    rng = np.random.default_rng(count)
    image = np.full((480, 640, 3), 128, np.uint8)
    for _ in range(count):
        place, way, length = (
            rng.uniform(0, 1, 2) * (640, 480),
            rng.uniform(0, np.pi),
            rng.uniform(20, 200),
        )
        end = place + length * np.array([np.cos(way), np.sin(way)])
        grey = int(rng.integers(0, 255))
        cv2.line(image, tuple(map(int, place)), tuple(map(int, end)), (grey, grey, grey), 2)
    assert seen_vertical(image, CAMERA) is None


def test_the_same_image_gives_the_same_bytes():
    image = drawn(room(), turn(np.radians(10.0), 0.0))
    first, second = seen_vertical(image, CAMERA), seen_vertical(image.copy(), CAMERA)
    assert first is not None
    assert second is not None
    assert first.up.tobytes() == second.up.tobytes()
    assert first.sigma == second.sigma
