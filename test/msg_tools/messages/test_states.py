"""JointState, TFMessage, Body and headers."""

import importlib
import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import load_body
from msg_tools import GeneratedMessages, MessageError
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.headers import time_ns
from msg_tools.messages.message_error import lengths_of
from msg_tools.messages.states import (
    heaviest_joint_state,
    joint_state_message,
    quaternions,
    transforms_message,
)
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture


def test_joint_state_of_the_heaviest(pose_mixture, messages):
    state = heaviest_joint_state(messages, pose_mixture)
    assert state.name == list(pose_mixture.dof_names)
    np.testing.assert_array_equal(state.position, pose_mixture.mixture.means[2])
    assert len(state.velocity) == len(state.effort) == 0
    assert time_ns(state.header.stamp) == pose_mixture.stamp_ns
    with pytest.raises(MessageError, match=r'joint state has 2 names, but a pose of shape \(3,\)'):
        joint_state_message(messages, ['a', 'b'], np.zeros(3), 0)


STAMPS = (1_700_000_000_900_000_000, 1_700_000_001_000_000_000, 1_700_000_002_150_000_000)
EXAMPLE = Path(__file__).parents[3] / 'examples' / 'joint_trajectory.py'
joint_trajectory = runpy.run_path(str(EXAMPLE))['joint_trajectory']
TRAJECTORIES = TrajectoryMixture(
    weights=np.array([0.3, 0.6, 0.1]),
    means=np.arange(18.0).reshape(3, 3, 2),
    marginal_covariances=None,
    log_joint=np.zeros(3),
    inflation=np.ones(3),
    stamps_ns=STAMPS,
    final_until_ns=0,
    free_energy=np.empty(0),
    body_model='arm',
    dof_names=('shoulder', 'elbow'),
    frame_id='camera',
    identities=np.array([4, 9, 5]),
)


def check_trajectory(messages):
    """Checks the heaviest trajectory and that of an identity."""
    message = joint_trajectory(messages, TRAJECTORIES)
    assert list(message.joint_names) == ['shoulder', 'elbow']
    assert (time_ns(message.header.stamp), message.header.frame_id) == (STAMPS[0], 'camera')
    times = [point.time_from_start for point in message.points]
    assert [(time.sec, time.nanosec) for time in times] == [(0, 0), (0, 10**8), (1, 250_000_000)]
    np.testing.assert_array_equal(
        [list(point.positions) for point in message.points], TRAJECTORIES.means[1]
    )
    assert all(len(x.velocities) == len(x.effort) == 0 for x in message.points)
    other = joint_trajectory(messages, TRAJECTORIES, 5)
    np.testing.assert_array_equal(list(other.points[0].positions), TRAJECTORIES.means[2, 0])
    with pytest.raises(MessageError, match=r'none has the identity 6, they have \[4, 9, 5\]'):
        joint_trajectory(messages, TRAJECTORIES, 6)


def test_joint_trajectory(messages):
    check_trajectory(messages)


@pytest.mark.ros
def test_joint_trajectory_of_ros():
    reason = 'trajectory_msgs is not installed'
    trajectories = pytest.importorskip('trajectory_msgs.msg', reason=reason)
    times = importlib.import_module('builtin_interfaces.msg')
    headers = importlib.import_module('std_msgs.msg')
    classes = [trajectories.JointTrajectory, trajectories.JointTrajectoryPoint]
    check_trajectory(GeneratedMessages([*classes, times.Duration, times.Time, headers.Header]))


def test_quaternions_agree_with_scipy():
    rotations = Rotation.random(500, random_state=0)
    half_turns = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0]]]))
    near = Rotation.from_rotvec([[np.pi - 1e-9, 0, 0], [0, 1e-12, 0], [0, 0, 0]])
    for case in (rotations, half_turns, near):
        q = quaternions(case.as_matrix())
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
        assert (q[:, 3] >= 0).all()
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), case.as_matrix(), atol=1e-14)


def test_transforms(messages):
    turn = Rotation.from_euler('z', 90, degrees=True).as_matrix()
    message = transforms_message(
        messages,
        ['camera', 'pelvis'],
        ['pelvis', 'trunk'],
        [np.eye(3), turn],
        np.arange(6).reshape(2, 3),
        7,
    )
    first, second = message.transforms
    assert (first.header.frame_id, first.child_frame_id) == ('camera', 'pelvis')
    assert first.transform.rotation.w == 1.0
    assert (second.transform.translation.x, second.transform.translation.z) == (3.0, 5.0)
    np.testing.assert_allclose(second.transform.rotation.z, np.sqrt(0.5), atol=1e-15)
    assert second.header.stamp.nanosec == 7


def test_body_message(messages):
    body = load_body('human37').with_stature(1.6)
    message = message_of_body(messages, body, 5, 'camera')
    assert (message.name, message.header.frame_id) == ('human37', 'camera')
    assert lengths_of(message, 'body') == body.segment_lengths
    np.testing.assert_array_equal(message.upper, body.upper)
    assert '<link name="camera" />' in message.urdf
