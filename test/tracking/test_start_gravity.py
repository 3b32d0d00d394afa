"""Starts of people whom a camera sees that looks down."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.camera import Viewpoint
from hmt_ros.body.ground_terms import FloorPlane
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import root_rotations
from hmt_ros.motion.procedural_motion import procedural_motion
from hmt_ros.tracking.gravity import Gravity, shortest_turn
from hmt_ros.tracking.ground import UP_SIGMA
from hmt_ros.tracking.initialisation import start_from_keypoints
from hmt_ros.tracking.subject import Subject

DOWN = Viewpoint(distance=3.0, height=2.4, pitch=np.radians(31.0))
UP = DOWN.rotation @ np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def standing(body) -> np.ndarray:
    """(d,) somebody upright, seen by the camera that looks down."""
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


def test_the_shortest_turn_takes_one_direction_to_another():
    rng = np.random.default_rng(0)
    for start, end in rng.normal(size=(5, 2, 3)):
        start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
        turn = shortest_turn(start, end)
        assert np.allclose(turn @ start, end)
        assert np.allclose(turn @ turn.T, np.eye(3))
        assert np.trace(turn) == pytest.approx(1.0 + 2.0 * start @ end)
    upside_down = shortest_turn(np.array([0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    assert np.allclose(upside_down @ [0.0, -1.0, 0.0], [0.0, 1.0, 0.0])
    assert np.linalg.det(upside_down) == pytest.approx(1.0)


def test_poses_are_turned_upright(body):
    poses = np.tile(body.prior_mean, (4, 1))
    poses[:, body.dof_names.index('root_z')] = [-2.0, 0.0, 1.0, 3.0]
    poses[:, 2] = 3.0
    turned = Gravity(plane(UP, 0.01)).turned(body, poses)
    wanted = shortest_turn(np.array([0.0, -1.0, 0.0]), UP) @ root_rotations(body, poses)
    assert np.allclose(root_rotations(body, turned), wanted)
    assert np.allclose(turned[:, :3], poses[:, :3])


def test_only_the_lean_costs_at_the_start(body, standing):
    frames, rows = forward(body.skeleton, standing[None]), np.zeros(1, dtype=np.intp)
    parts = Gravity(FloorPlane(UP, 0.01, 1.0, 0.02), 0.5).term(body).parts(frames, rows)
    assert parts['upright'] > 0
    assert all(parts[name] == 0 for name in ('floor', 'balance', 'contact'))


def test_a_start_is_upright_where_gravity_is_known(body, camera, keypoints_of, standing):
    """Stature and lengths are unknown, so that the lean decides among depths of the joints."""
    keypoints = keypoints_of(body, standing, 3.0)
    subject = Subject(0, keypoints, {}, None)
    found = {
        name: start_from_keypoints(body, camera, subject, upright=upright)
        for name, upright in {
            'known': Gravity(plane(UP, 0.01)),
            'unknown': Gravity(plane(np.array([0.0, -1.0, 0.0]), UP_SIGMA)),
            'camera': None,
        }.items()
    }
    error = {name: lean(body, start.poses[0], standing) for name, start in found.items()}
    assert error['known'] < 10.0
    assert error['known'] < error['camera']
    assert error['unknown'] < error['camera']
    for start in found.values():
        assert (np.diff(start.energies) >= 0).all()
        assert np.linalg.eigvalsh(start.hessians).min() > 0
