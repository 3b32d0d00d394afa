"""Tracks with a camera on its side are the turned tracks of an upright camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_ros.body import load_body
from hmt_ros.body.camera import roll
from hmt_ros.image.likelihood import OFF
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.tracking import KnownGround, Tracker, TrackerSettings
from hmt_ros.tracking.track_state import Estimate

UP = np.array([0.0, -1.0, 0.0])
IMAGES, STEP = 4, 100_000_000


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def walking(body) -> np.ndarray:
    return procedural_motion('walk', body, 1.0, 10.0, 2)[:IMAGES]


def by_keypoints() -> TrackerSettings:
    settings = TrackerSettings(flow_weight=0.0)
    off = {term.name: OFF for term in TERMS}
    return replace(settings, likelihood=replace(settings.likelihood, **off))


def tracked(body, camera, keypoints_of, poses, up: np.ndarray, level: np.ndarray) -> Estimate:
    """The estimate after images of a camera turned by a level, with a given vertical."""
    image = np.full((camera.height, camera.width, 3), 90, np.uint8)
    tracker = Tracker(body, camera, by_keypoints(), known_ground=KnownGround(up))
    middle = np.array([camera.cx, camera.cy])
    for index, pose in enumerate(poses):
        seen = keypoints_of(body, pose, 2.0)
        seen = replace(seen, pixels=(seen.pixels - middle) @ level[:2, :2].T + middle)
        tracker.step(image, index * STEP, seen)
    return tracker.estimate


@pytest.mark.parametrize('degrees', [90.0, 180.0])
def test_a_track_before_a_turned_camera_is_the_same(body, camera, keypoints_of, walking, degrees):
    angle = np.radians(degrees)
    level = roll([np.sin(angle), -np.cos(angle), 0.0])
    upright = tracked(body, camera, keypoints_of, walking, UP, np.eye(3))
    turned = tracked(body, camera, keypoints_of, walking, level @ UP, level)
    assert upright.body.level == pytest.approx(np.eye(3))
    assert turned.body.level == pytest.approx(level)
    joints = [x.body.joint_positions(x.posterior.means[:1])[0] for x in (upright, turned)]
    assert np.abs(joints[1] - joints[0] @ level.T).max() < 0.02
    assert not turned.gravity_contradicted
    assert not turned.gravity_reversed


def test_the_reading_of_an_accelerometer_is_turned_round(body, camera, keypoints_of, walking):
    known = tracked(body, camera, keypoints_of, walking, UP, np.eye(3))
    turned = tracked(body, camera, keypoints_of, walking, -UP, np.eye(3))
    assert turned.gravity_reversed
    assert turned.vertical == pytest.approx(UP)
    assert turned.body.joint_positions(turned.posterior.means) == pytest.approx(
        known.body.joint_positions(known.posterior.means)
    )
