"""Starts with a depth image, which determines distance and stature."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames, sensed_depth
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.joint_depths import depths_of, joint_depths
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import Subject, Tracker
from hmt_ros.tracking.beginning import Shown, Source, first_start
from hmt_ros.tracking.existence import Existence
from hmt_ros.tracking.initialisation import start_from_keypoints
from hmt_ros.tracking.misfit import of_depth_at_best
from hmt_ros.tracking.observer import View
from hmt_ros.tracking.validity import DEPTH, Validity

STATURE, AWAY = 1.9, 3.5
MS = 1_000_000


@pytest.fixture(scope='module')
def tall(camera):
    """A tall person: body, poses, images, depth images, m, and the empty scene."""
    body, view = load_body('human37').with_stature(STATURE), Viewpoint(distance=AWAY)
    poses = procedural_motion('reach', body, 0.6, 10.0, 2, viewpoint=view)
    scene = Scene(viewpoint=view, seed=3)
    shown = list(render_frames(body, poses, camera, scene))
    empty = np.rint(scene.background(camera)).astype(np.uint8)
    depths = [
        1e-3 * sensed_depth(np.minimum(one.depth, scene.depth(camera)), camera, 3, i)
        for i, one in enumerate(shown)
    ]
    return body, poses, [one.image for one in shown], depths, empty


def subject_of(keypoints: Keypoints) -> Subject:
    return Subject(0, keypoints, {})


def best(start):
    """The most probable pose of a start, and the stature of its body."""
    return start.poses[0], start.body.stature


def test_the_pull_is_the_derivative_of_the_energy(tall, keypoints_of):
    body, poses, _, depths, _ = tall
    found = joint_depths(body, keypoints_of(body, poses[0], 1.0), depths_of(depths[0]))
    at = body.joint_positions(poses[:1])[0, found.joints, 2] + 0.05
    up, down = (found.residuals(at + step)[0] for step in (1e-6, -1e-6))
    assert np.allclose(found.residuals(at)[1], (up - down) / 2e-6, rtol=1e-5)


def test_a_start_from_keypoints_finds_distance_and_stature(tall, camera, keypoints_of):
    body, poses, _, depths, _ = tall
    model, seen = load_body('human37'), subject_of(keypoints_of(body, poses[0], 1.0))
    without, _ = best(start_from_keypoints(model, camera, seen))
    pose, stature = best(start_from_keypoints(model, camera, seen, depths=depths_of(depths[0])))
    off, off_without = (abs(x[2] - poses[0, 2]) for x in (pose, without))
    assert off < 0.06
    assert off < 0.5 * off_without
    assert stature == pytest.approx(STATURE, abs=0.05)


@pytest.mark.parametrize('wall', [0.5, 1.0, 9.0])
def test_depth_of_something_else_does_not_spoil_a_start(tall, camera, keypoints_of, wall):
    """Such a depth implies an impossible size of the person."""
    body, poses, _, depths, _ = tall
    model, seen = load_body('human37'), subject_of(keypoints_of(body, poses[0], 1.0))
    plain = start_from_keypoints(model, camera, seen)
    flat = depths_of(np.full_like(depths[0], wall))
    spoilt = start_from_keypoints(model, camera, seen, depths=flat)
    assert spoilt.poses[0, 2] == pytest.approx(plain.poses[0, 2], rel=0.02)
    assert spoilt.body.stature == pytest.approx(plain.body.stature, abs=0.02)


def shown(view, stamp, model, camera, given=None, box=None):
    """An image without any other input."""
    view = view._replace(stamp=stamp)
    return Shown(view, model, model, camera, None, given, box)


def test_a_box_starts_at_the_depth_of_the_person(tall, camera):
    body, poses, images, depths, _ = tall
    pixels = camera.project(body.joint_positions(poses[:1]))[0]
    model = load_body('human37')
    box = (*pixels.min(0), *pixels.max(0))
    found = {}
    for name, depth in (('with', depths[0]), ('without', None)):
        view = View(images[0], depth=depth)
        source, start = first_start(shown(view, 0, model, camera, box=box), Existence())
        assert source is Source.BOX
        found[name] = np.abs(start.expected.means[:, 2] - poses[0, 2]).max()
    assert found['with'] < 0.18 < found['without']


@pytest.fixture(scope='module')
def tracked(tall, camera, keypoints_of):
    """Distance errors (T,), m, and final statures, by inputs of the tracker."""
    body, poses, images, depths, empty = tall
    true = body.joint_positions(poses)
    found = {}
    for name in ('depth', 'no depth', 'holes', 'shifted'):
        background = BackgroundModel.from_image(empty)
        tracker = Tracker(load_body('human37'), camera, background=background, seed=1)
        tracker.reset(subject_of(keypoints_of(body, poses[0], 2.0)))
        errors = []
        for t, (image, depth) in enumerate(zip(images[:3], depths)):
            given = {'depth': depth, 'no depth': None, 'holes': np.zeros_like(depth)}
            given['shifted'] = np.roll(depth, 20, axis=1)
            posterior, _ = tracker.step(image, 100 * t * MS, depth=given[name])
            joints = tracker.estimate.body.joint_positions(posterior.means[:1])[0]
            errors.append(np.linalg.norm(joints - true[t], axis=1).mean())
        assert tracker.estimate.validity.is_trusted(DEPTH) == (name != 'shifted')
        found[name] = np.array(errors), posterior
    return found


def test_a_track_is_nearer_with_depth(tracked):
    assert tracked['depth'][0].mean() < 0.5 * tracked['no depth'][0].mean()
    assert tracked['depth'][0].max() < 0.08


def test_depth_makes_the_distance_more_certain(tracked):
    sigma = {name: np.sqrt(mixture.covariance()[2, 2]) for name, (_, mixture) in tracked.items()}
    assert sigma['depth'] < 0.7 * sigma['no depth']


def test_depth_that_is_not_registered_does_no_harm(tracked):
    """It is shifted by 20 px for a person about 50 px wide, and is doubted, see `tracked`."""
    assert tracked['shifted'][0].max() < tracked['no depth'][0].max() + 0.02


def test_the_belief_comes_back(tall, camera):
    body, poses, _, depths, _ = tall
    shifted = np.roll(depths[0], 20, axis=1)
    validity = Validity()

    def see(pose, depth, dt):
        if (shown := depths_of(depth)) is not None:
            validity.update_depths(of_depth_at_best(body, camera, pose, shown), dt)

    wrong = poses[0] * np.where(np.arange(body.dimension) < 3, 1.1, 1.0)
    for depth, pose, believed in (
        (None, wrong, True),
        (np.zeros_like(shifted), wrong, True),
        *[(shifted, wrong, None)] * 5,
        (shifted, wrong, False),
        *[(depths[0], wrong, None)] * 10,
        (depths[0], wrong, True),
    ):
        validity.predict(0.1)
        see(pose, depth, 0.1)
        assert believed is None or validity.is_trusted(DEPTH) == believed
    # One image does not change that.
    see(wrong, shifted, 1.0 / 30.0)
    assert validity.is_trusted(DEPTH)
