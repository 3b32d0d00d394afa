"""Starts of tracks without a subject: keypoints, masks and boxes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body.mirror import left_directions
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.empty_scene import UNSEEN
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import Status, Tracker, TrackerSettings
from hmt_ros.tracking.beginning import Source
from hmt_ros.tracking.hypotheses import PosePrediction
from test.clips import read_clip

FRAME = 100_000_000  # ns
SHARED = Path(os.environ.get('HMT_SHARED', Path(__file__).resolve().parents[3] / 'shared'))
FAST = TrackerSettings(
    candidates=8, max_hypotheses=4, searched_chains=1,
    likelihood=LikelihoodSettings.of_terms(keypoints=LikelihoodSettings().keypoints),
    flow_weight=0.0,
)  # fmt: skip
# Joints of COCO detectors.
NAMES = tuple(
    f'{side}_{x}'
    for x in ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle')
    for side in ('left', 'right')
)


@pytest.fixture(scope='module')
def black(camera):
    return np.zeros((camera.height, camera.width, 3), np.uint8)


@pytest.fixture(scope='module')
def walk(human37):
    return procedural_motion('walk', human37, 1.2, 10.0, 3, viewpoint=Viewpoint(distance=3.5))


def detected(keypoints_of, body, pose, seed=0, names=NAMES, exchanged=False, sigma=2.0):
    """Keypoints of some joints with detector noise."""
    every = keypoints_of(body, pose, sigma, seed)
    called = list(names)
    rows = [every.names.index(name) for name in names]
    if exchanged:
        called = [
            x.replace('left', '?').replace('right', 'left').replace('?', 'right') for x in names
        ]
    part = every[np.array(rows)]
    return replace(part, names=tuple(called))


@pytest.fixture(scope='module')
def start(human37, camera, black, keypoints_of, walk):
    """Function (body, **of `detected`) -> tracker after some images."""

    def run(body=human37, images=4, settings=FAST, **given):
        tracker = Tracker(human37, camera, settings)
        for i in range(images):
            keypoints = detected(keypoints_of, body, walk[i], seed=i, **given)
            tracker.step(black, i * FRAME, keypoints)
        return tracker

    return run


def error(body, pose, true_body, true_pose):
    """Mean joint error relative to the pelvis, scaled to the true person, m."""
    joints = body.joint_positions(pose[None])[0] * true_body.scale / body.scale
    truth = true_body.joint_positions(true_pose[None])[0]
    rows = [body.joint_names.index(x) for x in NAMES]
    relative = (joints - joints[0]) - (truth - truth[0])
    return float(np.linalg.norm(relative[rows], axis=1).mean())


def test_keypoints_start_a_track_once_they_last(human37, camera, black, keypoints_of, walk):
    tracker = Tracker(human37, camera, FAST)
    seen = [detected(keypoints_of, human37, walk[i], seed=i) for i in range(3)]
    nothing = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))
    # A person in one image may be a mistake.
    for i, keypoints in enumerate((seen[0], nothing, seen[1])):
        assert tracker.step(black, i * FRAME, keypoints) == (None, None)
        assert tracker.estimate.status is Status.WAITING
    posterior, _ = tracker.step(black, 3 * FRAME, seen[2])
    assert tracker.estimate.status is Status.TRACKING
    assert tracker.estimate.started_from is Source.KEYPOINTS
    assert error(tracker.estimate.body, posterior.means[0], human37, walk[2]) < 0.08
    # The background is not learned with the person in it.
    assert tracker.silhouettes.background.frames == 1


@pytest.mark.parametrize('stature', [1.55, 1.85])
def test_depth_is_as_uncertain_as_the_stature(start, human37, walk, stature):
    """One view does not determine the size; the covariance of the first mixture shows it."""
    person = human37.with_stature(stature)
    tracker = start(person, 2)
    mixture = tracker.estimate.posterior
    sigma = np.sqrt(mixture.covariances[0, 2, 2])
    wrong = mixture.means[0, 2] - walk[1, 2]
    assert 0.04 * walk[1, 2] < sigma < 0.12 * walk[1, 2]
    assert abs(wrong) < 2.5 * sigma
    # Relative to the size, the depth is correct.
    assert mixture.means[0, 2] / tracker.estimate.body.stature == pytest.approx(
        walk[1, 2] / stature, rel=0.06
    )


def test_a_detector_that_begins_with_sides_exchanged(human37, camera, black, keypoints_of, walk):
    """After exchanged first images the person has the right facing within a second."""
    tracker = Tracker(human37, camera, FAST)
    back = []
    for i in range(12):
        keypoints = detected(keypoints_of, human37, walk[i], seed=i, exchanged=i < 3)
        posterior, _ = tracker.step(black, i * FRAME, keypoints)
        if posterior is not None:
            left = left_directions(tracker.estimate.body, posterior.means[:1])[0]
            back.append(left @ left_directions(human37, walk[i : i + 1])[0] < 0)
    assert not any(back[8:])


def test_the_same_keypoints_give_the_same_track(start):
    first, second = (start(images=3).estimate.posterior for _ in range(2))
    assert first.means.tobytes() == second.means.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()


def near(tracker, truth):
    """Whether the heaviest mode's position agrees with a pose to a fifth of the distance."""
    return np.abs(tracker.estimate.posterior.means[0, :3] - truth[:3]).max() < 0.2 * truth[2]


def test_a_mask_starts_a_track(human37, camera, black, walk):
    masks = render_silhouettes(human37, walk, camera)
    tracker = Tracker(human37, camera, replace(FAST, likelihood=LikelihoodSettings()))
    for i in range(2):
        assert tracker.estimate.status is Status.WAITING
        tracker.step(black, i * FRAME, mask=masks[i])
    assert tracker.estimate.status is Status.TRACKING
    assert tracker.estimate.started_from is Source.MASK
    assert near(tracker, walk[1])


def test_a_box_starts_a_track(human37, camera, black, walk):
    (mask,) = render_silhouettes(human37, walk[:1], camera)
    rows, columns = np.nonzero(mask)
    box = (int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max()))
    tracker = Tracker(human37, camera, replace(FAST, likelihood=LikelihoodSettings()))
    tracker.reset(box=box)
    posterior, _ = tracker.step(black, 0)
    assert tracker.estimate.started_from is Source.BOX
    assert near(tracker, walk[0])
    assert np.sqrt(posterior.covariances[0, 2, 2]) > 0.05 * walk[0, 2]
    # It is available for one image only.
    tracker.reset()
    assert tracker.step(black, FRAME) == (None, None)


@pytest.mark.parametrize('name', ['wander', 'follow'])
def test_keypoints_of_a_detector_start_a_track(human37, name):
    folder = SHARED / 'video' / name
    if not (folder / 'keypoints_mediapipe.npz').is_file():
        pytest.skip(f'{folder} is absent')
    clip = read_clip(folder, 8)
    background = None if clip.background is None else BackgroundModel.from_image(clip.background)
    tracker = Tracker(human37, clip.camera, FAST, background)
    for stamp, image in clip.images.items():
        tracker.step(image, stamp, clip.keypoints[stamp])
    names = clip.truth.joint_names
    rows = [names.index(x) for x in NAMES]
    true = clip.truth.joints[stamp][rows]
    found = tracker.estimate.body.joint_positions(tracker.estimate.posterior.means[:1])[0]
    found = found[[human37.joint_names.index(x) for x in NAMES]]
    hips = [NAMES.index('left_hip'), NAMES.index('right_hip')]
    wrong = (found - found[hips].mean(0)) - (true - true[hips].mean(0))
    assert np.linalg.norm(wrong, axis=1).mean() < 0.12
    sigma = np.sqrt(tracker.estimate.posterior.covariances[0, 2, 2])
    depth = found[hips].mean(0)[2] - true[hips].mean(0)[2]
    assert abs(depth) < 2.5 * sigma


def test_why_no_track_starts_is_said(camera, human37, filmed):
    """A person is in view from the first image, without any start information."""
    _, images, _ = filmed('walk', 1.2, camera)
    tracker = Tracker(human37, camera, FAST)
    for i in range(60):
        assert tracker.step(images[i % len(images)], i * FRAME) == (None, None)
    assert tracker.estimate.status is Status.WAITING
    assert tracker.estimate.reason == UNSEEN
    assert np.isnan(tracker.estimate.existence_probability)
    assert not tracker.silhouettes.scene.known


def test_a_track_that_a_ghost_began_ends(camera, human37, filmed):
    """A person stands still while the scene is learned, then walks; a prediction starts a track."""
    _, images, _ = filmed('walk', 1.2, camera)
    tracker = Tracker(human37, camera, TrackerSettings(candidates=8, max_hypotheses=4))
    for i in range(21):
        tracker.step(images[0], i * FRAME)
    assert tracker.silhouettes.scene.known
    covariances = np.tile(1e-2 * np.eye(human37.dimension), (1, 1, 1))
    mean = human37.prior_mean.copy()
    mean[:3] = 0.0, 0.0, 30.0
    prediction = PosePrediction(GaussianMixture(np.ones(1), mean[None], covariances), human37)
    statuses = []
    for i, image in enumerate(images[4:]):
        tracker.step(image, (21 + i) * FRAME, prediction=prediction if i == 0 else None)
        statuses.append(tracker.estimate.status)
    assert statuses[0] is Status.TRACKING
    ended = statuses.index(Status.WAITING)
    assert ended <= 4
    assert set(statuses[ended:]) == {Status.WAITING}
    assert tracker.estimate.reason == UNSEEN
    assert np.isnan(tracker.estimate.existence_probability)
