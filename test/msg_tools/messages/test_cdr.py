"""Live and offline messages: the same functions and the same bytes."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import GeneratedMessages, typestore
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.cdr import canonical, deserialise, serialise
from msg_tools.messages.headers import header_message
from msg_tools.messages.images import compressed_image_message, image_message
from msg_tools.messages.keypoints import keypoints_message
from msg_tools.messages.markers import skeleton_markers
from msg_tools.messages.pose_mixtures import pose_mixture_message
from msg_tools.messages.states import heaviest_joint_state, transforms_message
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture, trajectory_mixture_message

STAMP = 1_700_000_000_987_654_321
RNG = np.random.default_rng(11)
PICTURE = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
KEYPOINTS = Keypoints(
    ('neck', 'left_elbow', 'head'),
    np.array([[1.0, 2.5], [np.nan, np.nan], [3.0, 4.0]]),
    np.tile([[4.0, 1.0], [1.0, 9.0]], (3, 1, 1)),
    np.array([1.0, 0.0, 0.5]),
)
TRAJECTORIES = TrajectoryMixture(
    weights=np.array([0.25, 0.75]),
    means=RNG.normal(size=(2, 3, 2)),
    marginal_covariances=np.tile(np.eye(2), (2, 3, 1, 1)),
    log_joint=np.array([-1.0, -2.0]),
    inflation=np.ones(2),
    stamps_ns=(STAMP, STAMP + 5, STAMP + 10),
    final_until_ns=STAMP,
    free_energy=np.array([3.0, 2.0, 1.5]),
    body_model='human37',
    dof_names=('root_x', 'bend'),
    frame_id='camera',
)


def diagnostics(messages):
    value = messages.create('diagnostic_msgs/msg/KeyValue', key='dropped images', value='3')
    status = messages.create(
        'diagnostic_msgs/msg/DiagnosticStatus',
        level=1,
        name='filter',
        message='late',
        values=[value],
    )
    return messages.create(
        'diagnostic_msgs/msg/DiagnosticArray',
        header=header_message(messages, STAMP, ''),
        status=[status],
    )


def body(messages):
    return message_of_body(messages, load_body('human32'), STAMP, 'camera')


def makers(content):
    def pose_component(messages):
        return pose_mixture_message(messages, content).components[1]

    def trajectory_component(messages):
        return trajectory_mixture_message(messages, TRAJECTORIES).components[0]

    def markers(messages):
        return skeleton_markers(
            messages,
            content.joint_positions,
            content.joint_names,
            [('pelvis', 'head')],
            content.weights,
            STAMP,
            'camera',
            ranks=5,
        )

    def transforms(messages):
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return transforms_message(
            messages,
            ['camera', 'pelvis'],
            ['pelvis', 'trunk'],
            [np.eye(3), turn],
            [[0.0, 0.1, 3.0], [0.0, -0.2, 0.0]],
            STAMP,
        )

    return {
        'hmt_msgs/msg/PoseMixture': lambda messages: pose_mixture_message(messages, content),
        'hmt_msgs/msg/PoseComponent': pose_component,
        'hmt_msgs/msg/TrajectoryMixture': lambda m: trajectory_mixture_message(m, TRAJECTORIES),
        'hmt_msgs/msg/TrajectoryComponent': trajectory_component,
        'hmt_msgs/msg/Keypoints2D': lambda messages: keypoints_message(
            messages, KEYPOINTS, STAMP, 'camera'
        ),
        'hmt_msgs/msg/Body': body,
        'sensor_msgs/msg/JointState': lambda messages: heaviest_joint_state(messages, content),
        'sensor_msgs/msg/CompressedImage': lambda m: compressed_image_message(
            m, PICTURE, STAMP, 'c'
        ),
        'sensor_msgs/msg/Image': lambda messages: image_message(messages, PICTURE, STAMP, 'camera'),
        'visualization_msgs/msg/MarkerArray': markers,
        'tf2_msgs/msg/TFMessage': transforms,
        'diagnostic_msgs/msg/DiagnosticArray': diagnostics,
    }


TYPES = [
    *(f'hmt_msgs/msg/{name}' for name in ('PoseMixture', 'PoseComponent', 'TrajectoryMixture')),
    *(f'hmt_msgs/msg/{name}' for name in ('TrajectoryComponent', 'Keypoints2D', 'Body')),
    'sensor_msgs/msg/JointState',
    'sensor_msgs/msg/CompressedImage',
    'sensor_msgs/msg/Image',
    'visualization_msgs/msg/MarkerArray',
    'tf2_msgs/msg/TFMessage',
    'diagnostic_msgs/msg/DiagnosticArray',
]


MIXTURES = {
    *(f'hmt_msgs/msg/{name}' for name in ('PoseMixture', 'PoseComponent')),
    *(f'hmt_msgs/msg/{name}' for name in ('TrajectoryMixture', 'TrajectoryComponent')),
    'std_msgs/msg/Header',
    'builtin_interfaces/msg/Time',
    'geometry_msgs/msg/Point',
}


def types_inside(msgtype):
    """A type and all nested types."""
    found = {msgtype}
    for _, description in typestore().fielddefs[msgtype][1]:
        kind, detail = description
        if kind in (3, 4):
            kind, detail = detail[0]
        if kind == 2:
            found |= types_inside(str(detail))
    return found


@pytest.fixture(scope='module')
def generated():
    """Factory of the classes generated by ROS, for one type and its nested types."""

    def factory(msgtype):
        classes = []
        # Components are created as parts of a mixture, which has a header.
        for name in sorted(types_inside(msgtype) | MIXTURES):
            package, _, cls = name.split('/')
            try:
                module = importlib.import_module(f'{package}.msg')
            except ImportError as error:
                # Missing on PyPI, but in a full installation of ROS.
                if package == 'tf2_msgs':
                    pytest.skip(f'{package} is not installed: {error}')
                raise
            classes.append(getattr(module, cls))
        return GeneratedMessages(classes)

    return factory


@pytest.mark.parametrize('msgtype', TYPES)
def test_bytes_survive_a_round_trip(pose_mixture, messages, msgtype):
    message = makers(pose_mixture)[msgtype](messages)
    data = serialise(message)
    assert message.__msgtype__ == msgtype
    assert canonical(data, msgtype) == data
    # The content of the padding is dropped.
    assert canonical(data + b'\xab\xcd\xef\x01\x02\x03\x04\x05', msgtype) == data


@pytest.mark.ros
@pytest.mark.parametrize('msgtype', TYPES)
def test_live_and_offline_bytes_are_the_same(pose_mixture, messages, generated, msgtype):
    from rclpy.serialization import deserialize_message, serialize_message

    make = makers(pose_mixture)[msgtype]
    live = make(generated(msgtype))
    offline = serialise(make(messages))
    for _ in range(20):
        # rclpy leaves garbage in the padding and, after empty sequences, after the message.
        data = serialize_message(live)
        assert canonical(data, msgtype) == offline
        assert len(data) >= len(offline)
    # Vice versa: an offline message is the same live message.
    back = deserialize_message(offline, type(live))
    assert canonical(serialize_message(back), msgtype) == offline


@pytest.mark.ros
def test_type_hashes_are_those_of_ros():
    from ament_index_python.packages import get_package_share_directory

    folder = Path(get_package_share_directory('hmt_msgs')) / 'msg'
    paths = sorted(folder.glob('*.json'))
    assert len(paths) == 11
    for path in paths:
        hashes = json.loads(path.read_text())['type_hashes']
        wanted = {entry['type_name']: entry['hash_string'] for entry in hashes}
        name = f'hmt_msgs/msg/{path.stem}'
        assert typestore().hash_rihs01(name) == wanted[name]


def test_bytes_that_are_no_message():
    for data in (b'', b'\x00\x01', b'\x00\x02\x00\x00abcd', b'\x01\x00\x00\x00abcd'):
        with pytest.raises(ValueError, match='encapsulation'):
            deserialise(data, 'std_msgs/msg/String')


def test_factory_fills_what_is_not_given(messages):
    pose = messages.create('geometry_msgs/msg/PoseWithCovariance')
    assert pose.pose.orientation.w == 1.0
    assert pose.covariance.shape == (36,)
    state = messages.create('sensor_msgs/msg/JointState', position=[1, 2])
    assert state.position.dtype == np.float64
    assert state.name == []
    assert messages.create('sensor_msgs/msg/JointState').position is not state.position
    with pytest.raises(TypeError, match="JointState has no field 'speed'"):
        messages.create('sensor_msgs/msg/JointState', speed=1)
