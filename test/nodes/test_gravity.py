"""Gravity over DDS: the filter node subscribes to /tf and /tf_static and publishes on /tf."""

import numpy as np
import pytest

from msg_tools import RosbagsMessages
from msg_tools.messages.ground import ground_of
from msg_tools.messages.states import transforms_message

pytestmark = pytest.mark.ros

# A camera 1.2 m above the floor that looks down by the angle whose cosine is 0.8.
ROTATION = np.array([[-1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, -0.8, -0.6]])


def camera_place(stamp, parent='map', child='lens'):
    return transforms_message(
        RosbagsMessages(), [parent], [child], ROTATION.T[None], [[0.0, 0.0, 1.2]], stamp
    )


@pytest.fixture
def world(stub_tracker, subject_file, world_of):
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_msgs.msg import TFMessage

    from hmt_ros.nodes.filter_node import FilterNode

    inputs = {'image': Image, 'camera_info': CameraInfo, 'tf': TFMessage, 'tf_static': TFMessage}

    def make(**values):
        values = {'subject_file': str(subject_file), **values}
        used = inputs if values.get('gravity_frame') else dict(list(inputs.items())[:2])
        return world_of(FilterNode, 'filter_node', used, **values)

    return make


def test_gravity_of_a_frame(world, small_camera, stub_tracker):
    from hmt_msgs.msg import Ground
    from tf2_msgs.msg import TFMessage

    one = world(gravity_frame='map', floor_in_gravity_frame=True)
    found, transforms = [], []
    one.listen(Ground, 'ground', found)
    one.listen(TFMessage, '/tf', transforms)
    one.start()
    one.spin_until(lambda: one.is_heard('ground'))
    one.send('camera_info', small_camera.info())
    # A static mount, sent once and latched, and a robot that stands still.
    one.send('tf_static', camera_place(0, 'robot'))
    for index in range(3):
        place = transforms_message(
            RosbagsMessages(), ['map'], ['robot'], np.eye(3)[None], [[index, 0.0, 0.5]],
            small_camera.stamp(index),
        )  # fmt: skip
        one.send('tf', place)
        handled = one.send('image', small_camera.image(index))
        assert (handled.faults, handled.warnings) == ((), ())
    one.spin_until(lambda: len(found) == 3 and len(transforms) == 6)
    for message in found:
        content = ground_of(message)
        np.testing.assert_allclose(content.up, [0.0, -0.8, -0.6], atol=1e-12)
        assert content.frame_id == 'lens'
        assert np.isclose(content.height, 1.7)
        assert content.contacts == {'left_foot': 0.75, 'right_foot': 0.0}
    (tracker,) = stub_tracker.made
    assert np.isclose(tracker.known_ground.camera_height, 1.7)
    assert len(tracker.gravities) == 2
    # The node does not use its own messages on /tf.
    sources = [handled.source for handled in one.handled]
    assert sources == ['camera_info', 'tf_static', *['tf', 'image'] * 3]
    assert one.session.state.faults == {}


def test_no_value_is_an_empty_list_and_the_parameter_stays(world):
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters

    one = world(gravity=[0.0, 1.0, 0.0]).start()
    nothing = ParameterValue(type=ParameterType.PARAMETER_NOT_SET)
    given = [
        Parameter(name='gravity', value=nothing),
        Parameter(name='camera_height', value=nothing),
    ]
    emptied, refused = one.call(SetParameters, 'set_parameters', parameters=given).results
    assert (emptied.successful, refused.successful) == (True, False)
    assert one.session.parameters.gravity == ()
    names = one.call(ListParameters, 'list_parameters').result.names
    assert {'gravity', 'camera_height'} <= set(names)
    (value,) = one.call(GetParameters, 'get_parameters', names=['gravity']).values
    assert (value.type, list(value.double_array_value)) == (
        ParameterType.PARAMETER_DOUBLE_ARRAY,
        [],
    )
    assert one.set(gravity=[0.0, 2.0, 0.0]) == (True, '')
