"""Both ways to face are followed until the images have decided."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body.mirror import reverse_depth
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import PosePrediction, Tracker, TrackerSettings
from hmt_ros.tracking.facing import faces_like, left_directions

FRAME = 100_000_000  # ns
SMALL = TrackerSettings(
    candidates=8, max_hypotheses=4, shape_images=0, rounds=1, searched_chains=1, combinations=32
)


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses, images and the empty scene of a person who stands before the camera and reaches."""
    return filmed('reach', 0.8, camera)


@pytest.fixture(scope='module')
def followed(film, human32, camera):
    """Function (seconds of trial) -> tracker and posteriors, of a track that is told the wrong way.

    The last two images see predictions, too.
    """
    poses, images, empty = film
    wrong = PosePrediction(
        GaussianMixture(
            np.ones(1), reverse_depth(human32, poses[:1]), 0.02 * np.eye(human32.dimension)[None]
        ),
        human32,
    )

    def run(seconds):
        tracker = Tracker(
            human32, camera, replace(SMALL, facing_trial=seconds), BackgroundModel.from_image(empty)
        )
        posteriors = []
        for i, image in enumerate(images):
            prediction = None if 0 < i < len(images) - 2 else wrong
            posteriors.append(tracker.step(image, i * FRAME, prediction=prediction)[0])
        return tracker, posteriors

    return run


def test_directions_to_the_left(human32, motion):
    pose = np.array(human32.prior_mean)[None]
    pose[0, 2] = 3.0
    left = left_directions(human32, np.concatenate([pose, motion]))
    assert np.linalg.norm(left, axis=1) == pytest.approx(np.ones(len(left)))
    # Who faces the camera has the left hand at the right side of the image.
    turned = reverse_depth(human32, pose)
    assert left_directions(human32, turned)[0, 0] == pytest.approx(-left[0, 0], abs=1e-9)


def test_the_reversal_in_depth_faces_the_other_way(human32, motion):
    both = np.concatenate([motion, reverse_depth(human32, motion)])
    alike = faces_like(human32, both, motion[0])
    assert alike[: len(motion)].all()
    assert not alike[len(motion) :].any()


def ways(body, posteriors, pose):
    """Of each posterior the weight of the modes that face as a pose does."""
    return [float(p.weights[faces_like(body, p.means, pose)].sum()) for p in posteriors]


def test_both_ways_are_followed_and_become_one_mixture(film, followed, human32):
    poses, _, _ = film
    tracker, posteriors = followed(0.5)
    right = ways(human32, posteriors, poses[0])
    # A person who stands can hardly be told from one who stands back to front.
    assert all(0.05 < share < 0.95 for share in right[:5])
    assert right[-1] > 0.5
    for posterior in posteriors:
        assert posterior.weights.sum() == pytest.approx(1.0)
        assert len(posterior) <= SMALL.max_hypotheses
        assert (np.diff(posterior.weights) <= 0).all()
    assert tracker.modes.textures is not None
    assert len(tracker.modes.textures.counts) == len(posteriors[-1])


def test_the_images_decide(film, followed, human32, monkeypatch):
    poses, _, _ = film
    monkeypatch.setattr('hmt_ros.tracking.facing.DECIDED', 0.1)
    _, posteriors = followed(0.5)
    right = ways(human32, posteriors, poses[0])
    decided = next(i for i, share in enumerate(right) if share in (0.0, 1.0))
    assert decided < 5
    # As far as one can see until then; what was given up was the less probable.
    before = right[decided - 1] if decided else 1.0
    assert (right[decided] == 1.0) == (before > 0.5)


def test_without_a_trial_one_way_is_taken_at_once(followed):
    tracker, _ = followed(0.0)
    assert tracker.modes.textures is not None


def test_the_same_bytes_twice(followed):
    a, b = (followed(0.5)[1] for _ in range(2))
    assert [x.means.tobytes() for x in a] == [x.means.tobytes() for x in b]


def test_a_trial_is_not_shorter_than_nothing():
    with pytest.raises(ValueError, match='facing_trial must be at least 0, saw -1'):
        TrackerSettings(facing_trial=-1.0)


def test_a_start_that_is_repeated_without_silhouettes_follows_two_ways(followed, monkeypatch):
    monkeypatch.setattr('hmt_ros.tracking.facing.Track.believes_silhouettes', False)
    tracker, posteriors = followed(0.5)
    assert all(posterior is not None for posterior in posteriors)
    assert len(tracker.modes.poses) <= SMALL.max_hypotheses
