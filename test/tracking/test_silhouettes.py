"""Where silhouettes come from: masks of a segmenter, and backgrounds that are not what they seem."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.image.background import BackgroundModel
from hmt_ros.rendering.renderer import render_silhouettes
from hmt_ros.tracking import Status, Subject, Tracker, TrackerSettings
from test.tracking.test_tracker import best_error, in_bytes

FRAME = 100_000_000
SETTINGS = TrackerSettings(candidates=8, max_hypotheses=4, flesh_images=2)


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses, images and the empty scene of a person who walks."""
    return filmed('walk', 0.6, camera)


@pytest.fixture(scope='module')
def subject(film, human32, keypoints_of) -> Subject:
    return Subject(0, keypoints_of(human32, film[0][0]), dict(human32.segment_lengths))


def test_masks_replace_the_background(film, subject, human32, camera):
    """The same with and without a background; somebody else in the mask does not matter."""
    poses, images, empty = film
    masks = render_silhouettes(human32, poses, camera)
    masks[1:, 20:40, 5:15] = True
    runs = []
    for background in (None, BackgroundModel.from_image(empty)):
        tracker = Tracker(human32, camera, SETTINGS, background)
        tracker.reset(subject)
        runs.append(
            [
                tracker.step(image, i * FRAME, mask=mask)
                for i, (image, mask) in enumerate(zip(images, masks, strict=True))
            ]
        )
        assert tracker.status is Status.TRACKING
        assert tracker.misfit < 0.2
    assert in_bytes(runs[0]) == in_bytes(runs[1])
    errors = [
        best_error(tracker.body, posterior, human32, pose)
        for (posterior, _), pose in zip(runs[0], poses, strict=True)
    ]
    assert max(errors) < 0.1


def test_a_mask_without_a_person_is_no_silhouette(film, subject, human32, camera):
    """Although the background is known."""
    _, images, empty = film
    nobody = np.zeros(images[0].shape[:2], dtype=bool)
    runs = []
    for background, mask in ((None, None), (BackgroundModel.from_image(empty), nobody)):
        tracker = Tracker(human32, camera, SETTINGS, background)
        tracker.reset(subject)
        runs.append([tracker.step(images[0], 0, mask=mask)])
    assert in_bytes(runs[0]) == in_bytes(runs[1])


def test_no_background_is_learned_from_what_a_mask_shows_a_person_in(film, human32, camera):
    _, images, _ = film
    mask = np.zeros(images[0].shape[:2], dtype=bool)
    tracker = Tracker(human32, camera)
    tracker.step(images[0], 0, mask=mask)
    assert tracker.background.frames == 1
    mask[50:60, 50:60] = True
    tracker.step(images[1], 1, mask=mask)
    assert tracker.background.frames == 1
    with pytest.raises(ValueError, match=r'images of \(240, 320\), saw a mask of \(120, 320\)'):
        tracker.step(images[1], 2, mask=mask[::2])
