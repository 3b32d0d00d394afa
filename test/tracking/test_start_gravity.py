"""Starts of people seen by a camera that looks down."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import load_body
from hmt_ros.body.camera import shortest_turn
from hmt_ros.body.ground_terms import FloorPlane, GroundSettings
from hmt_ros.body.mirror import root_rotations
from hmt_ros.image.subject import Subject
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import KnownGround, Tracker, TrackerSettings
from hmt_ros.tracking.ground import Gravity
from hmt_ros.tracking.initialisation import start_from_keypoints
from test.oracles.single_terms import energy_of

DOWN = Viewpoint(distance=3.0, height=2.4, pitch=np.radians(31.0))
UP = DOWN.rotation @ np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def standing(body) -> np.ndarray:
    """Pose (d,) of an upright person, seen by the camera that looks down."""
    return procedural_motion('reach', body, 0.2, 10.0, 3, viewpoint=DOWN)[0]


def plane(up: np.ndarray, sigma: float) -> FloorPlane:
    return FloorPlane(up, sigma, None, np.inf)


def lean(body, pose: np.ndarray, true: np.ndarray) -> float:
    """Angle between the spine of a pose and that of the true one, degrees."""
    joints = body.joint_positions(np.stack([pose, true]))
    names = body.joint_names
    spine = joints[:, names.index('neck')] - joints[:, names.index('pelvis')]
    spine /= np.linalg.norm(spine, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(spine[0] @ spine[1], -1.0, 1.0))))


def test_poses_are_turned_upright(body):
    poses = np.tile(body.prior_mean, (4, 1))
    poses[:, body.dof_names.index('root_z')] = [-2.0, 0.0, 1.0, 3.0]
    poses[:, 2] = 3.0
    turned = Gravity(plane(UP, 0.01)).turned(body, poses)
    wanted = shortest_turn(np.array([0.0, -1.0, 0.0]), UP) @ root_rotations(body, poses)
    assert np.allclose(root_rotations(body, turned), wanted)
    assert np.allclose(turned[:, :3], poses[:, :3])


def test_only_the_lean_costs_at_the_start(body, standing):
    term = Gravity(FloorPlane(UP, 0.01, 1.0, 0.02), 0.5).term(body)
    sunk = standing.copy()
    sunk[1] += 5.0
    above, below = energy_of(term, body, np.stack([standing, sunk])).value
    assert above > 0
    assert below == pytest.approx(above)


def test_a_start_is_upright_against_gravity(body, camera, keypoints_of, standing):
    """Clicks are inaccurate and the size is unknown, so the lean decides the joints' depths."""
    keypoints = keypoints_of(body, standing, 3.0)
    subject = Subject(0, keypoints, {}, None)
    known, camera_axes = (
        start_from_keypoints(body, camera, subject, upright=upright)
        for upright in (Gravity(plane(UP, 0.01)), None)
    )
    error = lean(body, known.poses[0], standing)
    assert error < 6.0
    assert error < lean(body, camera_axes.poses[0], standing)


def test_a_tracker_passes_gravity_to_a_start_only_where_it_is_known(body, camera, monkeypatch):
    seen = []

    def start(*_, upright, **__):
        seen.append(upright)
        raise ValueError('enough')

    monkeypatch.setattr('hmt_ros.tracking.beginning.start_from_keypoints', start)
    keypoints = Keypoints(('neck',), np.zeros((1, 2)), np.eye(2)[None], np.ones(1))
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    off = TrackerSettings(ground=GroundSettings(upright_weight=0.0))
    for settings, ground in (
        (TrackerSettings(), None),
        (TrackerSettings(), KnownGround(UP)),
        (off, KnownGround(UP)),
    ):
        tracker = Tracker(body, camera, settings, known_ground=ground)
        tracker.reset(Subject(0, keypoints, {}, None))
        with pytest.raises(ValueError, match='enough'):
            tracker.step(image, 1)
    assert [upright is not None for upright in seen] == [False, True, False]
    assert np.allclose(seen[1].plane.up, UP)
