"""Who is followed among several people."""

import numpy as np
import pytest

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.keypoint_inputs import ChosenPerson
from msg_tools.messages.detections import DetectedPerson

NAMES = ('left_hip', 'right_hip', 'head')
SECOND = 10**9


def person(column, size=100.0, missing=()):
    """Somebody whose head is in a column."""
    pixels = size * np.array([[-0.1, 1.0], [0.1, 1.0], [0.0, 0.0]]) + (column, 50.0)
    pixels[list(missing)] = np.nan
    covariances = np.tile(np.eye(2), (3, 1, 1))
    return DetectedPerson('', Keypoints(NAMES, pixels, covariances, np.ones(3)))


@pytest.fixture
def choose():
    chosen = ChosenPerson()

    def which(seconds, *people):
        found = chosen.choose(people, int(seconds * SECOND), 1.0)
        return next((i for i, x in enumerate(people) if x.keypoints is found), None)

    which.forget = chosen.forget
    return which


def test_first_the_largest_then_the_nearest(choose):
    assert choose(0.0, person(100, 80), person(400, 120)) == 1
    # The other one comes nearer to the camera, in another order.
    assert choose(0.1, person(410, 100), person(110, 300)) == 0
    assert choose(0.2, person(130, 300), person(420, 100)) == 1


def test_somebody_else_is_not_taken_for_the_person(choose):
    assert choose(0.0, person(100)) == 0
    assert choose(0.1, person(400)) is None
    assert choose(0.2) is None
    assert choose(0.9, person(400), person(120)) == 1


def test_after_an_absence_the_largest_is_chosen_anew(choose):
    assert choose(0.0, person(100)) == 0
    assert choose(1.0, person(400)) is None
    assert choose(1.1, person(400)) == 0
    choose.forget()
    assert choose(1.2, person(100, 150), person(400)) == 0


def test_landmarks_that_are_missing(choose):
    assert choose(0.0, person(100)) == 0
    assert choose(0.1, person(300, missing=(1, 2)), person(105, missing=(1, 2))) == 1
    # Of the left hip before, nothing is seen.
    assert choose(0.2, person(300, missing=(0, 2)), person(110, missing=(0, 2))) == 1
    assert choose(0.3, person(100, missing=(0, 1, 2))) is None
