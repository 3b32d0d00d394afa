"""JointState, TFMessage, Body and headers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import load_body
from msg_tools import MessageError, RosbagsMessages
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.headers import header_message, time_message, time_ns
from msg_tools.messages.message_error import lengths_of
from msg_tools.messages.pose_mixtures import PoseMixture
from msg_tools.messages.states import (
    heaviest_joint_state,
    joint_state_message,
    quaternions,
    transforms_message,
)


@pytest.mark.parametrize('stamp', [0, 1, 999_999_999, 10**9, 1_700_000_000_123_456_789])
def test_time_round_trip(messages: RosbagsMessages, stamp: int) -> None:
    time = time_message(messages, stamp)
    assert time_ns(time) == stamp
    assert 0 <= time.nanosec < 10**9
    assert time_ns(header_message(messages, stamp, 'camera').stamp) == stamp


def test_joint_state_of_the_heaviest(pose_mixture: PoseMixture, messages: RosbagsMessages) -> None:
    state = heaviest_joint_state(messages, pose_mixture)
    assert state.name == list(pose_mixture.dof_names)
    np.testing.assert_array_equal(state.position, pose_mixture.mixture.means[2])
    assert len(state.velocity) == len(state.effort) == 0
    assert time_ns(state.header.stamp) == pose_mixture.stamp_ns
    with pytest.raises(MessageError, match=r'joint state has 2 names, but a pose of shape \(3,\)'):
        joint_state_message(messages, ['a', 'b'], np.zeros(3), 0)


def test_quaternions_agree_with_scipy() -> None:
    rotations = Rotation.random(500, random_state=0)
    half_turns = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0]]]))
    near = Rotation.from_rotvec([[np.pi - 1e-9, 0, 0], [0, 1e-12, 0], [0, 0, 0]])
    for case in (rotations, half_turns, near):
        q = quaternions(case.as_matrix())
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
        assert (q[:, 3] >= 0).all()
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), case.as_matrix(), atol=1e-14)


def test_transforms(messages: RosbagsMessages) -> None:
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


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'parents': ['a']}, r'1 parents, 2 children'),
        ({'rotations': np.eye(3)}, r'rotations \(3, 3\)'),
        ({'translations': np.zeros((3, 3))}, r'translations \(3, 3\)'),
        ({'translations': np.full((2, 3), np.nan)}, r'is not finite'),
    ],
)
def test_transforms_that_do_not_fit(
    messages: RosbagsMessages, changes: dict[str, Any], error: str
) -> None:
    arguments: dict[str, Any] = {
        'parents': ['a', 'b'],
        'children': ['b', 'c'],
        'rotations': np.tile(np.eye(3), (2, 1, 1)),
        'translations': np.zeros((2, 3)),
        'stamp_ns': 0,
    }
    with pytest.raises(MessageError, match=error):
        transforms_message(messages, **{**arguments, **changes})


def test_body_message(messages: RosbagsMessages) -> None:
    body = load_body('human37').with_stature(1.6)
    message = message_of_body(messages, body, 5, 'camera')
    assert (message.name, message.header.frame_id) == ('human37', 'camera')
    assert lengths_of(message, 'body') == body.segment_lengths
    np.testing.assert_array_equal(message.upper, body.upper)
    assert '<link name="camera" />' in message.urdf
