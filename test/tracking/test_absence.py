"""The tracker where nobody is: a person leaves and returns, nobody comes, images show nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body.camera import Viewpoint
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.motion.procedural_motion import procedural_motion
from hmt_ros.rendering.renderer import render, render_frames
from hmt_ros.rendering.scene import Scene
from hmt_ros.tracking import PosePrediction, Status, Tracker, TrackerSettings

FRAME = 100_000_000  # ns
SETTINGS = TrackerSettings(
    candidates=8, max_hypotheses=4, searched_chains=1, facing_trial=0.0, shape_images=0
)
NO_KEYPOINTS = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses and images of a second, and the empty scene."""
    return filmed('reach', 1.0, camera)


@pytest.fixture(scope='module')
def tracked(film, human32, camera):
    """Function (images, given with each) -> statuses, track numbers, components, the tracker."""

    def run(images, inputs=lambda i: {}, background=True, settings=SETTINGS, start=None):
        empty = BackgroundModel.from_image(film[2]) if background else BackgroundModel()
        tracker = Tracker(human32, camera, settings, empty)
        if start is None:
            start = near(film[0][0])
        tracker.reset(start or None)
        found = []
        for i, image in enumerate(images):
            posterior, likelihood = tracker.step(image, i * FRAME, **inputs(i))
            assert (posterior is None) == (likelihood is None)
            found.append(
                (tracker.status, tracker.track_id, 0 if posterior is None else len(posterior))
            )
        return *(list(x) for x in zip(*found, strict=True)), tracker

    return run


def near(pose):
    return GaussianMixture(np.ones(1), pose[None], 1e-3 * np.eye(len(pose))[None])


def with_noise(image, seed):
    noise = np.random.default_rng(seed).normal(0.0, 2.5, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def nothing(film, kind, count):
    shape = film[2].shape
    if kind == 'empty':
        return [with_noise(film[2], seed) for seed in range(count)]
    if kind == 'black':
        return [np.zeros(shape, np.uint8)] * count
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(count)]


@pytest.mark.parametrize('kind', ['empty', 'black', 'noise'])
def test_a_person_leaves_and_returns(film, tracked, kind, human32):
    poses, images, _ = film
    statuses, tracks, components, tracker = tracked(
        [*images[:5], *nothing(film, kind, 10), *images[:10]]
    )
    tracking, nobody = Status.TRACKING, Status.NOBODY
    assert statuses[:5] == [tracking] * 5
    # Half a second after the last image of the person, which is number 4.
    assert statuses[5:15] == [tracking] * 4 + [nobody] * 6
    assert statuses[15:] == [nobody] * 2 + [tracking] * 8
    assert tracks == [1] * 17 + [2] * 8
    assert [count > 0 for count in components] == [x is not nobody for x in statuses]
    # Of the old track the lengths are kept.
    assert tracker.body.segment_lengths == human32.segment_lengths
    # A silhouette alone does not tell the pose at once, but the place.
    assert np.abs(tracker.posterior.means[0, :3] - poses[9][:3]).max() < 0.3


@pytest.mark.parametrize('kind', ['empty', 'black', 'noise'])
def test_nobody_from_the_start(film, tracked, kind):
    statuses, tracks, components, tracker = tracked(nothing(film, kind, 9))
    assert statuses == [Status.TRACKING] * 5 + [Status.NOBODY] * 4
    assert tracks == [1] * 9
    assert components[5:] == [0] * 4
    with pytest.raises(ValueError, match='no track yet'):
        _ = tracker.posterior
    # A reset starts as it did the first time.
    tracker.reset()
    assert tracker.status is Status.WAITING
    assert tracker.step(film[1][0], 0)[0] is not None
    assert (tracker.status, tracker.track_id) == (Status.TRACKING, 2)


def test_what_is_not_seen_moves_on_and_gets_wider(film, tracked):
    _, _, _, tracker = tracked(film[1][:4])
    before = tracker.posterior
    empty = nothing(film, 'empty', 2)
    first, likelihood = tracker.step(empty[0], 4 * FRAME)
    second, _ = tracker.step(empty[1], 5 * FRAME)
    assert tracker.evaluations == 0
    volumes = [np.linalg.slogdet(x.covariances)[1] for x in (before, first, second)]
    assert (np.diff(volumes, axis=0) > 0).all()
    assert np.array_equal(first.weights, before.weights)
    # Such an image says nothing of where the person is.
    depth = likelihood.covariances[:, 2, 2]
    assert (depth > 1.0).all()
    # What follows is the same person.
    again, _ = tracker.step(film[1][5], 6 * FRAME)
    assert (tracker.status, tracker.track_id) == (Status.TRACKING, 1)
    assert np.abs(again.means[0, :3] - film[0][5][:3]).max() < 0.2


def test_the_time_is_that_of_the_stamps(film, tracked):
    settings = TrackerSettings(candidates=8, max_hypotheses=4, searched_chains=1, absence_time=0.2)
    statuses, *_ = tracked([*film[1][:3], *nothing(film, 'empty', 4)], settings=settings)
    assert statuses == [Status.TRACKING] * 4 + [Status.NOBODY] * 3


@pytest.mark.parametrize('closer', [0.5, -0.7])
def test_two_persons_cross(tracked, human32, camera, closer):
    """Somebody walks by before or behind the person; the track survives."""
    view = Viewpoint(distance=3.2)
    scene, other = Scene(viewpoint=view, seed=2), Scene(viewpoint=view, seed=7)
    poses = procedural_motion('reach', human32, 2.0, 10.0, 3, viewpoint=view)
    images = []
    for i, frame in enumerate(render_frames(human32, poses, camera, scene)):
        passer = poses[0].copy()
        passer[:3] += [0.25 * i - 2.4, 0.0, -closer]
        front = render(human32, passer, camera, other, i)
        seen = front.depth < frame.depth
        images.append(np.where(seen[:, :, None], front.image, frame.image))
    # With as many hypotheses as usual, and heavy tails: with lighter ones the track may go off with
    # the passer.
    settings = replace(SETTINGS, candidates=16, max_hypotheses=8, tails=4.0)
    statuses, tracks, components, tracker = tracked(images, settings=settings, start=near(poses[0]))
    assert Status.NOBODY not in statuses
    assert set(tracks) == {1}
    assert min(components) > 0
    if closer < 0:
        assert np.abs(tracker.posterior.means[0, :3] - poses[-1][:3]).max() < 0.5


def keypoint_inputs(film, human32, keypoints_of, seen):
    def inputs(i):
        if not seen(i):
            return {'keypoints': NO_KEYPOINTS}
        return {'keypoints': keypoints_of(human32, film[0][i % 10], 2.0, i)}

    return inputs


def test_a_detector_sees_nobody(film, tracked, human32, keypoints_of):
    """There is no background, and the scene is grey: nothing else knows."""
    grey = [np.full(film[2].shape, 90, np.uint8)] * 20
    inputs = keypoint_inputs(film, human32, keypoints_of, lambda i: not 5 <= i < 14)
    statuses, tracks, components, tracker = tracked(grey, inputs, background=False)
    tracking, nobody = Status.TRACKING, Status.NOBODY
    assert statuses == [tracking] * 9 + [nobody] * 7 + [tracking] * 4
    assert tracks == [1] * 16 + [2] * 4
    assert [count > 0 for count in components] == [x is not nobody for x in statuses]
    joints = tracker.body.joint_positions(tracker.posterior.means)
    truth = human32.joint_positions(film[0][9][None])
    gaps = joints - joints[:, :1] - (truth - truth[:, :1])
    assert np.linalg.norm(gaps, axis=2).mean(1).min() < 0.08


def test_a_detector_that_fails_ends_nothing(film, tracked, human32, keypoints_of):
    inputs = keypoint_inputs(film, human32, keypoints_of, lambda i: i < 2)
    statuses, tracks, *_ = tracked(film[1][:9], inputs)
    assert statuses == [Status.TRACKING] * 9
    assert tracks == [1] * 9


def test_no_keypoints_are_not_the_same_as_no_answer(film, tracked, human32, keypoints_of):
    grey = [np.full(film[2].shape, 90, np.uint8)] * 9

    def inputs(i):
        return {'keypoints': keypoints_of(human32, film[0][i], 2.0, i)} if i < 2 else {}

    statuses, *_ = tracked(grey, inputs, background=False)
    assert statuses == [Status.TRACKING] * 9


def test_a_predictor_sees_nobody_and_then_somebody(film, tracked, human32):
    grey = [np.full(film[2].shape, 90, np.uint8)] * 16
    prediction = PosePrediction(near(film[0][0]), human32)

    def inputs(i):
        return {'nobody_predicted': True} if 3 <= i < 11 else {'prediction': prediction}

    statuses, tracks, components, _ = tracked(grey, inputs, background=False, start=False)
    tracking, nobody = Status.TRACKING, Status.NOBODY
    assert statuses == [tracking] * 7 + [nobody] * 6 + [tracking] * 3
    assert tracks == [1] * 13 + [2] * 3
    assert components[7:13] == [0] * 6


def test_a_prediction_does_not_start_a_track_in_an_empty_scene(film, tracked, human32):
    prediction = PosePrediction(near(film[0][0]), human32)
    statuses, *_ = tracked(
        nothing(film, 'empty', 10), lambda i: {'prediction': prediction}, start=False
    )
    assert statuses == [Status.TRACKING] * 5 + [Status.NOBODY] * 5


def test_somebody_at_the_border_is_waited_for(film, tracked):
    """Until the silhouette is whole, or for 0.6 s."""
    images = [np.roll(image, -150, axis=1) for image in film[1]]
    cut = []
    for image in images:
        one = film[2].copy()
        one[:, :60] = image[:, :60]
        cut.append(one)
    statuses, *_ = tracked([*nothing(film, 'empty', 7), *cut[:9]])
    assert statuses[7:] == [Status.NOBODY] * 6 + [Status.TRACKING] * 3
