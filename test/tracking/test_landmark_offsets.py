"""Landmark offsets of one person, learned together with the poses."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.image.terms.keypoints import KEYPOINTS, Keypoints
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking import Tracker, TrackerSettings
from hmt_ros.tracking.landmark_offsets import OFFSET_SIGMA, LandmarkOffsets

BODY = load_body('human37')
CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
OWN = {'left_wrist': np.array([0.02, 0.0, 0.03]), 'right_knee': np.array([0.0, -0.025, 0.0])}
DT = 1.0 / 30.0


def seen_at(pose, own=OWN) -> Keypoints:
    """Keypoints of a person with individual landmark offsets."""
    scheme = schemes()['mediapipe33']
    n = len(scheme.names)
    unknown = np.full((n, 2, 2), np.nan)
    found, _ = Keypoints(scheme.names, np.zeros((n, 2)), unknown, np.ones(n)).named_for(BODY)
    which = BODY.skeleton.joint_index(found.names)
    more = np.array([own.get(mark, np.zeros(3)) for mark in found.landmarks])
    places = forward(BODY.skeleton, pose[None]).places(
        BODY.skeleton.joint_segments[which],
        BODY.skeleton.joint_offsets[which] + found.offsets + more,
    )
    return replace(found, pixels=CAMERA.project(places[0]))


@pytest.fixture(scope='module')
def poses():
    """Poses of a person who dances for four seconds, 3 m away."""
    result = procedural_motion('dance', BODY, 4.0, 30.0, 1).copy()
    result[:, :3] += np.array([0.0, 0.0, 3.0]) - result[:, :3].mean(0)
    return result


def after(poses, known=None, own=OWN):
    known = known or LandmarkOffsets()
    for pose in poses:
        shown = known.applied(seen_at(pose, own))
        known = known.after(shown, BODY, CAMERA, pose, DT)
    return known


def test_offsets_of_a_person_are_found_within_their_prior(poses):
    known = after(poses)
    for mark, offset in zip(known.landmarks, known.offsets, strict=True):
        true = OWN.get(mark, np.zeros(3))
        assert np.linalg.norm(offset - true) < (0.5 * np.linalg.norm(true) or 1e-6)
    before, now = (
        np.linalg.norm(x.pixels - seen_at(poses[0], {}).pixels, axis=1).max()
        for x in (seen_at(poses[0]), seen_at(poses[0], dict(zip(known.landmarks, known.offsets))))
    )
    assert now > 0.5 * before
    (row,) = (i for i, x in enumerate(known.landmarks) if x == 'left_wrist')
    shown = known.applied(seen_at(poses[0]))
    usual = seen_at(poses[0]).offsets
    np.testing.assert_allclose(shown.offsets[row] - usual[row], known.offsets[row])


def test_a_second_counts_the_same_at_every_rate(poses):
    """Above `RATE` more images add no information; one image has little."""
    known = after(poses[:120])
    often = LandmarkOffsets()
    for pose in poses[:120]:
        for _ in range(3):
            shown = often.applied(seen_at(pose))
            often = often.after(shown, BODY, CAMERA, pose, DT / 3)
    np.testing.assert_allclose(often.precision, known.precision, rtol=0.05, atol=10.0)
    first = after(poses[:1])
    assert np.abs(first.offsets).max() < OFFSET_SIGMA


def test_keypoints_that_are_elsewhere_tell_nothing(poses):
    known = LandmarkOffsets()
    for pose in poses:
        shown = seen_at(pose, {})
        shown = replace(shown, pixels=shown.pixels + 120.0)
        known = known.after(shown, BODY, CAMERA, pose, DT)
    assert np.abs(known.offsets).max() < 0.004


def test_other_landmarks_and_joints_begin_anew(poses):
    known = after(poses)
    shown = seen_at(poses[0])
    some = shown[np.arange(5)]
    assert known.applied(some) is some
    assert known.applied(None) is None
    assert known.after(some, BODY, CAMERA, poses[0], DT).landmarks == some.landmarks
    joints = Keypoints(('left_wrist',), np.ones((1, 2)), np.eye(2)[None], np.ones(1))
    assert known.after(joints, BODY, CAMERA, poses[0], DT) is known
    unseen = replace(shown, confidences=np.zeros(len(shown.names)))
    np.testing.assert_array_equal(
        known.after(unseen, BODY, CAMERA, poses[0], DT).precision, known.precision
    )


def learned_by_tracker(poses, settings):
    """Landmarks with learned offsets after some images of a person, and after a reset."""
    mask = np.zeros((CAMERA.height, CAMERA.width), dtype=np.uint8)
    tracker = Tracker(BODY, CAMERA, settings)
    tracker.reset(GaussianMixture(np.ones(1), poses[:1], 1e-3 * np.eye(BODY.dimension)[None]))
    for t, pose in enumerate(poses):
        (mask,) = render_silhouettes(BODY, pose[None], CAMERA)
        image = np.repeat(np.where(mask, np.uint8(200), np.uint8(40))[..., None], 3, axis=2)
        tracker.step(image, t * 33_333_333, seen_at(pose), mask=mask.view(np.uint8))
    before = tracker._landmarks
    tracker.reset()
    return before, tracker._landmarks


def test_a_tracker_learns_offsets_where_the_image_counts(poses):
    known, none = learned_by_tracker(poses[:12], TrackerSettings())
    assert 'left_wrist' in known.landmarks
    assert np.abs(known.offsets).max() > 1e-3
    assert none.landmarks == ()
    settings = TrackerSettings(likelihood=LikelihoodSettings.of_terms(keypoints=KEYPOINTS))
    assert learned_by_tracker(poses[:3], settings)[0].landmarks == ()
