"""Sources of silhouettes: masks of a segmenter, and backgrounds that show the person."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body.ground_terms import GroundSettings
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.silhouettes import Silhouettes
from hmt_ros.tracking import Status, Subject, Tracker, TrackerSettings
from test.tracking.test_tracker import best_error, in_bytes

FRAME = 100_000_000
# Without ground terms, because feet only rest if a background shows that the camera is fixed.
SETTINGS = TrackerSettings(candidates=8, max_hypotheses=4, ground=GroundSettings(0.0, 0.0))


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses, images and the empty scene of a walking person."""
    return filmed('walk', 0.6, camera)


@pytest.fixture(scope='module')
def subject(film, human32, keypoints_of) -> Subject:
    return Subject(0, keypoints_of(human32, film[0][0]), dict(human32.segment_lengths))


def test_masks_replace_the_background(film, subject, human32, camera):
    """Results do not depend on a background, nor on another person in the mask."""
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
        assert tracker.estimate.status is Status.TRACKING
        assert tracker.estimate.misfit < 0.2
    assert in_bytes(runs[0]) == in_bytes(runs[1])
    errors = [
        best_error(tracker.estimate.body, posterior, human32, pose)
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


@pytest.fixture(scope='module')
def crossing(human32, camera):
    """Poses and images of a person who stands and then walks aside, and the empty scene."""
    view = Viewpoint(distance=4.5)
    pose = procedural_motion('reach', human32, 0.1, 10.0, 3, viewpoint=view)[0]
    poses = np.tile(pose, (36, 1))
    poses[:, 0] += np.concatenate([np.zeros(4), np.minimum(np.arange(32) * 0.08, 1.6)]) - 0.8
    scene = Scene(viewpoint=view, seed=2)
    images = [frame.image for frame in render_frames(human32, poses, camera, scene)]
    return poses, images, np.rint(scene.background(camera)).astype(np.uint8)


def test_a_background_with_the_person_in_it_is_noticed_and_mended(crossing, human32, camera):
    """It is noticed when the person leaves the place where the background was learned."""
    poses, images, empty = crossing
    silhouettes = Silhouettes(BackgroundModel())
    for i in range(21):
        silhouettes.learn(images[i % 4], i * FRAME)
    assert silhouettes.known == 'known'
    silhouettes.check(images[4], human32, camera, poses[4:5])
    assert silhouettes.doubted
    assert silhouettes.silhouette(images[4], 21 * FRAME, None, None) is None
    assert silhouettes.known == 'forgotten, 0% known again'
    doubted = []
    for image, pose in zip(images[4:], poses[4:], strict=True):
        silhouettes.complete(image, human32, camera, pose[None])
        doubted.append(silhouettes.doubted)
    # Only once, from the image in which the person has left.
    assert doubted == sorted(doubted, reverse=True)
    assert 10 < doubted.index(False) < 31
    mask = render_silhouettes(human32, poses[-1:], camera)[0]
    found = silhouettes.silhouette(images[-1], 60 * FRAME, None, None).foreground
    wanted = BackgroundModel.from_image(empty).silhouette(images[-1])
    for one in (found, wanted):
        assert (one & mask).sum() / (one | mask).sum() > 0.8


def test_tracking_where_the_background_was_learned_with_the_person_in_it(
    crossing, human32, camera, keypoints_of
):
    """First with keypoints and without silhouettes, then with silhouettes alone."""
    poses, images, _ = crossing
    tracker = Tracker(human32, camera, SETTINGS)
    seen = keypoints_of(human32, poses[4])
    tracker.reset(Subject(4 * FRAME, seen, dict(human32.segment_lengths)))
    for i in range(20):
        tracker.step(images[i % 4], (i - 20) * FRAME)
    errors, doubted = [], []
    for i, image in enumerate(images):
        alone = bool(doubted) and not doubted[-1]
        given = None if alone else keypoints_of(human32, poses[i], 1.0, i)
        posterior, _ = tracker.step(image, i * FRAME, given)
        if posterior is not None:
            errors.append(best_error(tracker.estimate.body, posterior, human32, poses[i]))
            doubted.append(tracker.silhouettes.doubted)
    assert len(errors) == 32
    known = doubted.index(False)
    assert 10 < known < 28
    assert not any(doubted[known:])
    assert max(errors) < 0.13
