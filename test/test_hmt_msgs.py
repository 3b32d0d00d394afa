"""hmt_msgs on the wire, between rclpy and rosbags."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_tools.messages.message_types import typestore

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[1]
DOF = 37


def pose_mixture() -> Any:
    """A posterior with two components of 37 degrees of freedom; no value is the default one."""
    from geometry_msgs.msg import Point
    from hmt_msgs.msg import PoseComponent, PoseMixture

    rng = np.random.default_rng(7)
    mixture = PoseMixture()
    mixture.header.frame_id = 'camera_optical_frame'
    mixture.header.stamp.sec = 1_700_000_000
    mixture.header.stamp.nanosec = 123_456_789
    mixture.body_model = 'human37'
    mixture.dof_names = [f'dof_{i}' for i in range(DOF)]
    mixture.joint_names = ['pelvis', 'left_knee']
    mixture.kind = PoseMixture.SMOOTHED
    mixture.state = PoseMixture.STATE_LOST
    mixture.track_id = 12
    mixture.existence_probability = 0.75
    mixture.cue_names, mixture.cue_probabilities = ['depth', 'track'], [0.25, 0.5]
    mixture.error_share, mixture.error_time = 0.5, 0.125
    mixture.shape_covariance = rng.normal(size=DOF * DOF).tolist()
    for weight, log_likelihood in ((0.75, -12.5), (0.25, math.nan)):
        component = PoseComponent(weight=weight, log_likelihood=log_likelihood)
        component.mean = rng.normal(size=DOF).tolist()
        component.covariance = rng.normal(size=DOF * DOF).tolist()
        component.id = 3
        component.degrees_of_freedom = 4.0
        component.joint_covariances = rng.normal(size=2 * 9).tolist()
        component.joint_covariances_relative = rng.normal(size=2 * 9).tolist()
        component.joint_velocities = rng.normal(size=2 * 3).tolist()
        component.joint_positions = [Point(x=x, y=y, z=z) for x, y, z in rng.normal(size=(2, 3))]
        mixture.components.append(component)
    return mixture


def assert_same(first: Any, second: Any) -> None:
    """Field by field, bit by bit; NaN equals NaN. Either may be of rclpy or of rosbags."""
    if hasattr(first, 'get_fields_and_field_types'):
        for name in first.get_fields_and_field_types():
            assert_same(getattr(first, name), getattr(second, name))
    elif isinstance(first, list):
        assert len(first) == len(second)
        for one, other in zip(first, second):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize('known', [True, False])
def test_rosbags_reads_what_rclpy_writes(known: bool) -> None:
    """rclpy makes room for the numbers of a sequence that has none: it must not end in a gap."""
    from rclpy.serialization import serialize_message

    mixture = pose_mixture()
    if not known:
        mixture.shape_covariance = []
    read = typestore().deserialize_cdr(serialize_message(mixture), 'hmt_msgs/msg/PoseMixture')
    assert_same(mixture, read)


def test_rclpy_reads_what_rosbags_writes() -> None:
    from hmt_msgs.msg import PoseMixture
    from rclpy.serialization import deserialize_message, serialize_message

    mixture = pose_mixture()
    store = typestore()
    through_rosbags = store.serialize_cdr(
        store.deserialize_cdr(serialize_message(mixture), 'hmt_msgs/msg/PoseMixture'),
        'hmt_msgs/msg/PoseMixture',
    )
    assert_same(mixture, deserialize_message(bytes(through_rosbags), PoseMixture))


def test_tf_message_has_the_type_hash_of_a_ros_installation() -> None:
    # A listener to /tf elsewhere takes no message of another hash.
    import ament_index_python

    share = Path(ament_index_python.get_package_share_directory('tf2_msgs'))
    description = json.loads((share / 'msg' / 'TFMessage.json').read_text('utf-8'))
    hashes = {entry['type_name']: entry['hash_string'] for entry in description['type_hashes']}
    assert hashes['tf2_msgs/msg/TFMessage'] == (
        'RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087'
    )
