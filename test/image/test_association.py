"""Association of people from image to image."""

import numpy as np
import pytest

from hmt_ros.image.association import (
    GATE_COST,
    ImageTrack,
    Sighting,
    assigned,
    unknown_area,
)
from hmt_ros.image.terms.keypoints import Keypoints

NAMES = ('left_hip', 'right_hip', 'left_shoulder', 'right_shoulder')
SHAPE = np.array([[-10.0, 20.0], [10.0, 20.0], [-15.0, -30.0], [15.0, -30.0]])
FRAME = 100_000_000


def sighting(column, row=100.0, shape=SHAPE, seen=4):
    pixels = shape + np.array([column, row])
    corners = np.stack([pixels.min(0), pixels.max(0)])
    confidences = np.where(np.arange(4) < seen, 0.9, 0.0)
    keypoints = Keypoints(NAMES, pixels, np.tile(np.eye(2), (4, 1, 1)), confidences)
    return Sighting.of(keypoints, corners)


def walked(start, speed, images=5, **shape):
    """The track of a person who walks at a speed in px per image."""
    track = ImageTrack(sighting(start, **shape), 0)
    for i in range(1, images):
        track.update(sighting(start + i * speed, **shape), i * FRAME)
    return track


def test_two_people_who_cross_keep_their_tracks():
    """In the image of the crossing each is where the other was."""
    right, left = walked(60.0, 10.0), walked(140.0, -10.0)
    for i in range(5, 12):
        places = [60.0 + 10.0 * i, 140.0 - 10.0 * i]
        order = [1, 0] if i % 2 else [0, 1]
        found = [sighting(places[k]) for k in order]
        pairs = assigned([right, left], found, i * FRAME)
        assert [order[pairs[0]], order[pairs[1]]] == [0, 1]
        right.update(found[pairs[0]], i * FRAME)
        left.update(found[pairs[1]], i * FRAME)


def test_the_cost_is_the_median_way_in_sizes():
    track = walked(0.0, 0.0)
    size = np.hypot(30.0, 50.0)
    assert track.cost(sighting(6.0), 5 * FRAME) == pytest.approx(6.0 / size)
    # Without a common joint, the centres of the boxes are compared.
    assert track.cost(sighting(6.0, seen=0), 5 * FRAME) == pytest.approx(6.0 / size)


def test_the_gate_opens_while_somebody_is_not_seen():
    track = walked(0.0, 0.0, images=1)
    assert track.gate(0) == GATE_COST
    assert track.gate(30 * FRAME) == 2.0 * GATE_COST
    far = sighting(0.6 * track.size)
    assert assigned([track], [far], FRAME) == {}
    assert assigned([track], [far], 10 * FRAME) == {0: 0}


def test_nobody_takes_the_detection_of_somebody_who_is_nearer():
    near, far = walked(100.0, 0.0), walked(120.0, 0.0)
    assert assigned([far, near], [sighting(101.0)], 5 * FRAME) == {1: 0}
    assert assigned([near], [], FRAME) == assigned([], [sighting(0.0)], FRAME) == {}


def test_what_others_cover_is_unknown():
    mine, before, behind = (np.zeros((4, 6), bool) for _ in range(3))
    mine[:, 1:4] = before[:, 0:2] = behind[:, 3:6] = True
    unknown = unknown_area(mine, [before], [behind])
    np.testing.assert_array_equal(unknown[0], [True, True, False, False, True, True])
    assert unknown_area(mine, [], [behind & mine]) is None
