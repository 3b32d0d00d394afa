"""The tracker without a person: a person leaves and returns, or images show nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render, render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import PosePrediction, Status, Subject, Tracker, TrackerSettings

FRAME = 100_000_000  # ns
SETTINGS = TrackerSettings(candidates=8, max_hypotheses=4, searched_chains=1, estimate_shape=False)
# Minimum search, for tests of existence only.
QUICK = replace(SETTINGS, candidates=2, max_hypotheses=2, searched_chains=0)
TRACKING, LOST, NOBODY = Status.TRACKING, Status.LOST, Status.NOBODY
NO_KEYPOINTS = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses and images of a second, and the empty scene."""
    return filmed('reach', 1.0, camera)


@pytest.fixture(scope='module')
def tracked(film, human32, camera):
    """Function (images, other inputs) -> statuses, track numbers, components, the tracker."""

    def run(
        images, inputs=lambda i: {}, background=True, settings=SETTINGS, start=None, stamps=None
    ):
        empty = BackgroundModel.from_image(film[2]) if background else BackgroundModel()
        tracker = Tracker(human32, camera, settings, empty)
        if start is None:
            start = near(film[0][0])
        tracker.reset(start or None)
        found = []
        for i, image in enumerate(images):
            stamp = i * FRAME if stamps is None else round(1e9 * stamps[i])
            posterior, likelihood = tracker.step(image, stamp, **inputs(i))
            assert (posterior is None) == (likelihood is None)
            assert 0.0 <= tracker.estimate.existence_probability <= 1.0
            found.append(
                (
                    tracker.estimate.status,
                    tracker.track_id,
                    0 if posterior is None else len(posterior),
                )
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
    if kind in ('black', 'white'):
        return [np.full(shape, 0 if kind == 'black' else 255, np.uint8)] * count
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(count)]


def test_a_person_leaves_and_returns(film, tracked, human32):
    poses, images, _ = film
    statuses, tracks, components, tracker = tracked(
        [*images[:5], *nothing(film, 'empty', 10), *images[:10]]
    )
    assert statuses[:5] == [TRACKING] * 5
    # NOBODY is reported 0.4 s after the last image of the person, number 4.
    assert statuses[5:15] == [TRACKING] + [LOST] * 2 + [NOBODY] * 7
    assert statuses[15:] == [NOBODY] * 3 + [TRACKING] * 7
    assert tracks == [1] * 18 + [2] * 7
    assert [count > 0 for count in components] == [x is not NOBODY for x in statuses]
    # The lengths of the old track are kept.
    assert tracker.estimate.body.segment_lengths == human32.segment_lengths
    # A silhouette alone determines the position at once, but not the pose.
    assert np.abs(tracker.estimate.posterior.means[0, :3] - poses[9][:3]).max() < 0.3


@pytest.mark.parametrize('evidence', ['silhouettes', 'keypoints'])
def test_after_hours_somebody_else_comes(film, tracked, human32, keypoints_of, evidence):
    """After a minute without images the person is the same, after three hours another."""
    poses, images, _ = film
    long = dict(human32.segment_lengths) | {'thigh': 0.52}
    subject = Subject(0, keypoints_of(human32, poses[0]), long)

    def inputs(i):
        by_keypoints = evidence == 'keypoints'
        return {'keypoints': keypoints_of(human32, poses[i])} if by_keypoints else {}

    for gap, wanted in ((60.0, 1), (10_800.0, 2)):
        stamps = [0.0, 0.1, 0.2, *(gap + 0.1 * np.arange(4))]
        statuses, tracks, components, tracker = tracked(
            images[:7], inputs, evidence == 'silhouettes', start=subject, stamps=stamps
        )
        assert tracks == [1] * 3 + [wanted] * 4
        assert statuses[-1] is TRACKING
        assert min(components) > 0
        kept = (
            tracker.estimate.body.segment_lengths['thigh'] > human32.segment_lengths['thigh'] + 0.04
        )
        assert kept == (wanted == 1)


@pytest.mark.parametrize('kind', ['black', 'noise', 'white'])
def test_images_of_nothing_are_no_empty_scene(film, tracked, kind):
    """After two seconds of a covered lens, noise or flash, the person is the same."""
    statuses, tracks, components, tracker = tracked(
        [*film[1][:5], *nothing(film, kind, 20), *film[1][5:10]]
    )
    assert NOBODY not in statuses
    assert statuses[5:13] == [TRACKING] * 8
    assert statuses[16:25] == [LOST] * 9
    assert statuses[26:] == [TRACKING] * 4
    assert set(tracks) == {1}
    assert min(components) > 0
    assert np.abs(tracker.estimate.posterior.means[0, :3] - film[0][9][:3]).max() < 0.3


def test_what_is_not_seen_moves_on_and_gets_wider(film, tracked):
    _, _, _, tracker = tracked(film[1][:4])
    before, point = tracker.estimate.posterior, tracker.estimate.point_estimate
    empty = nothing(film, 'empty', 2)
    first, likelihood = tracker.step(empty[0], 4 * FRAME)
    second, _ = tracker.step(empty[1], 5 * FRAME)
    assert tracker.estimate.evaluations == 0
    volumes = [np.linalg.slogdet(x.covariances)[1] for x in (before, first, second)]
    assert (np.diff(volumes, axis=0) > 0).all()
    assert np.array_equal(first.weights, before.weights)
    # Each component is the same mode. Poses are random walks, so the best prediction is constant.
    assert np.array_equal(tracker.estimate.origins, np.eye(len(second)))
    assert np.array_equal(tracker.estimate.point_estimate, point)
    # Such an image has no information on the person's position.
    depth = likelihood.covariances[:, 2, 2]
    assert (depth > 1.0).all()
    # The next image shows the same person.
    again, _ = tracker.step(film[1][5], 6 * FRAME)
    assert (tracker.estimate.status, tracker.track_id) == (LOST, 1)
    again, _ = tracker.step(film[1][6], 7 * FRAME)
    assert (tracker.estimate.status, tracker.track_id) == (TRACKING, 1)
    assert np.abs(again.means[0, :3] - film[0][6][:3]).max() < 0.2


@pytest.mark.parametrize('gap', [0.1, 1.0, 10.0, 1000.0])
def test_a_person_who_is_elsewhere_after_a_gap_is_found(film, tracked, gap):
    """1.3 m to the side: the modes do not overlap the silhouette."""
    _, images, empty = film
    shifted = np.roll(images[0], 90, axis=1)
    shifted[:, :90] = empty[:, :90]
    moved = np.where(np.abs(shifted.astype(int) - np.roll(empty, 90, axis=1)).max(2) > 12, 1, 0)
    moved[:, :90] = 0
    elsewhere = np.where(moved[..., None] > 0, shifted, empty).astype(np.uint8)
    stamps = [*np.arange(4) * 0.1, *(0.3 + gap + np.arange(6) * 0.1)]
    statuses, tracks, components, tracker = tracked([*images[:4], *[elsewhere] * 6], stamps=stamps)
    assert NOBODY not in statuses
    assert set(tracks) == {1}
    assert min(components) > 0
    assert statuses[-1] is TRACKING
    place = tracker.estimate.posterior.means[0]
    assert place[0] - film[0][3][0] == pytest.approx(90 / 330 * film[0][3][2], abs=0.3)


def test_a_gap_is_no_absence_until_an_image_says_so(film, tracked):
    stamps = [0.0, 0.1, 1000.0, 1000.1, 1000.2]
    covered = nothing(film, 'black', 1)
    statuses, _, components, tracker = tracked(
        [*film[1][:2], *covered * 2, film[2]], settings=QUICK, stamps=stamps
    )
    assert statuses == [TRACKING] * 2 + [LOST] * 2 + [NOBODY]
    assert components[3] > 0
    assert tracker.estimate.existence_probability < 0.01


@pytest.mark.parametrize('closer', [0.5, -0.7])
def test_two_persons_cross(tracked, human32, camera, closer):
    """Another person passes in front of or behind the person; the track survives."""
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
    settings = replace(SETTINGS, candidates=16, max_hypotheses=8)  # as many as usual
    statuses, tracks, components, tracker = tracked(images, settings=settings, start=near(poses[0]))
    assert Status.NOBODY not in statuses
    assert set(tracks) == {1}
    assert min(components) > 0
    if closer < 0:
        assert np.abs(tracker.estimate.posterior.means[0, :3] - poses[-1][:3]).max() < 0.5


def keypoint_inputs(film, human32, keypoints_of, seen):
    def inputs(i):
        if not seen(i):
            return {'keypoints': NO_KEYPOINTS}
        return {'keypoints': keypoints_of(human32, film[0][i % 10], 2.0, i)}

    return inputs


def test_a_detector_sees_nobody(film, tracked, human32, keypoints_of):
    """There is no background and the scene is grey, so the detector is the only cue.

    Detectors fail for longer than silhouettes, so the decision takes 0.8 s.
    """
    grey = [np.full(film[2].shape, 90, np.uint8)] * 20
    inputs = keypoint_inputs(film, human32, keypoints_of, lambda i: not 5 <= i < 14)
    statuses, tracks, components, tracker = tracked(grey, inputs, background=False)
    assert statuses[:6] == [TRACKING] * 6
    assert statuses[6:12] == [LOST] * 6
    assert statuses[12:] == [NOBODY] * 4 + [TRACKING] * 4
    assert tracks == [1] * 16 + [2] * 4
    assert [count > 0 for count in components] == [x is not NOBODY for x in statuses]
    joints = tracker.estimate.body.joint_positions(tracker.estimate.posterior.means)
    truth = human32.joint_positions(film[0][9][None])
    gaps = joints - joints[:, :1] - (truth - truth[:, :1])
    assert np.linalg.norm(gaps, axis=2).mean(1).min() < 0.08


def test_no_keypoints_are_not_the_same_as_no_answer(film, tracked, human32, keypoints_of):
    grey = [np.full(film[2].shape, 90, np.uint8)] * 9

    def inputs(i):
        return {'keypoints': keypoints_of(human32, film[0][i], 2.0, i)} if i < 2 else {}

    statuses, *_ = tracked(grey, inputs, background=False)
    assert statuses == [Status.TRACKING] * 9


def test_a_predictor_sees_nobody_and_then_somebody(film, tracked, human32):
    grey = [np.full(film[2].shape, 90, np.uint8)] * 20
    prediction = PosePrediction(near(film[0][0]), human32)

    def inputs(i):
        return {'nobody_predicted': True} if 3 <= i < 14 else {'prediction': prediction}

    statuses, tracks, components, _ = tracked(grey, inputs, background=False, start=False)
    assert statuses[:4] == [TRACKING] * 4
    assert statuses[4:10] == [LOST] * 6
    assert statuses[10:] == [NOBODY] * 6 + [TRACKING] * 4
    assert tracks == [1] * 16 + [2] * 4
    assert components[10:16] == [0] * 6


def test_somebody_at_the_border_is_waited_for(film, tracked):
    """The track starts when the silhouette is complete, or after 0.5 s."""
    images = [np.roll(image, -150, axis=1) for image in film[1]]
    cut = []
    for image in images:
        one = film[2].copy()
        one[:, :60] = image[:, :60]
        cut.append(one)
    statuses, *_ = tracked([*nothing(film, 'empty', 7), *cut[:9]])
    assert statuses[7:] == [NOBODY] * 5 + [TRACKING] * 4
