"""The types of the project, and types that come with their definition."""

from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

import msg_tools
from msg_tools.messages.message_types import typestore, typestore_of_definition

DEFINITIONS = Path(msg_tools.__file__).parent / 'hmt_msgs' / 'msg'


def test_all_definitions_are_registered():
    names = {f'hmt_msgs/msg/{path.stem}' for path in DEFINITIONS.glob('*.msg')}
    assert len(names) == 11
    assert names <= typestore().fielddefs.keys()
    assert typestore() is typestore()
    for name in ('tf2_msgs/msg/TFMessage', 'visualization_msgs/msg/MarkerArray'):
        assert name in typestore().types


@pytest.mark.parametrize('distribution', [Stores.ROS2_FOXY, Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
@pytest.mark.parametrize(
    'msgtype',
    [
        'sensor_msgs/msg/Image',
        'sensor_msgs/msg/CompressedImage',
        'sensor_msgs/msg/CameraInfo',
        'sensor_msgs/msg/JointState',
    ],
)
def test_input_of_older_distributions_agrees_with_ours(distribution, msgtype):
    definition, _ = get_typestore(distribution).generate_msgdef(msgtype, ros_version=2)
    assert typestore_of_definition(msgtype, 'ros2msg', definition) is typestore()


def test_names_of_camera_info_in_capitals():
    definition, _ = typestore().generate_msgdef('sensor_msgs/msg/CameraInfo', ros_version=2)
    for name in 'dkrp':
        for kind in ('float64[]', 'float64[9]', 'float64[12]'):
            definition = definition.replace(f'{kind} {name}\n', f'{kind} {name.upper()}\n')
    assert 'float64[9] K\n' in definition
    store = typestore_of_definition('sensor_msgs/msg/CameraInfo', 'ros2msg', definition)
    assert store is typestore()


def test_only_what_differs_is_taken_from_a_definition():
    rule = '=' * 80
    definition = f'std_msgs/Header header\nint32 x\n{rule}\nMSG: std_msgs/Header\nuint32 seq\n'
    store = typestore_of_definition('my_msgs/msg/X', 'ros2msg', definition)
    assert store is not typestore()
    assert [name for name, _ in store.fielddefs['std_msgs/msg/Header'][1]] == ['seq']
    assert [name for name, _ in typestore().fielddefs['std_msgs/msg/Header'][1]] == [
        'stamp',
        'frame_id',
    ]
    assert 'my_msgs/msg/X' not in typestore().fielddefs
    assert store.fielddefs['hmt_msgs/msg/Body'] == typestore().fielddefs['hmt_msgs/msg/Body']


@pytest.mark.parametrize(
    ('msgtype', 'encoding', 'definition', 'error'),
    [
        ('', 'ros2msg', 'int32 x', "its definition has a type named ''"),
        ('my_msgs/msg/X', '', '', "its definition is '', wanted 'ros2msg'"),
        ('my_msgs/msg/X', 'ros2msg', '?', 'line 1 of its definition is no field'),
        ('my_msgs/msg/X', 'ros2idl', 'struct', "its definition is 'ros2idl', wanted 'ros2msg'"),
        ('my_msgs/msg/X', 'protobuf', '\x01\x02', "its definition is 'protobuf'"),
    ],
)
def test_types_that_can_not_be_known(msgtype, encoding, definition, error):
    with pytest.raises(ValueError, match=error):
        typestore_of_definition(msgtype, encoding, definition)
