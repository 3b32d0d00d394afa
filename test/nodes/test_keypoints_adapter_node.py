"""The adapter itself, over DDS, with messages of the packages that are installed."""

from importlib import import_module
from importlib.util import find_spec

import numpy as np
import pytest

from hmt_ros.sessions.keypoints_adapter_parameters import SOURCES, KeypointsAdapterParameters
from msg_tools.messages.headers import time_message

pytestmark = pytest.mark.ros


@pytest.fixture
def world(world_of):
    """A world with an adapter, a camera_info that has come, and its keypoints."""

    def make(camera, source, **values):
        from hmt_msgs.msg import Keypoints2D
        from sensor_msgs.msg import CameraInfo

        from hmt_ros.nodes.keypoints_adapter_node import KeypointsAdapterNode

        package, _, name = SOURCES[source].split('/')
        if find_spec(package) is None:
            pytest.skip(f'package {package} is not installed')
        kind = getattr(import_module(f'{package}.msg'), name)
        inputs = {'camera_info': CameraInfo, 'detections': kind}
        one = world_of(
            KeypointsAdapterNode, 'keypoints_adapter_node', inputs, source=source, **values
        )
        one.start()
        found = []
        one.listen(Keypoints2D, 'keypoints', found)
        one.spin_until(lambda: one.node._is_wanted('keypoints'))
        one.send('camera_info', camera.info(0))
        return one, kind, found

    return make


def send(one, message, found):
    """Publishes a message of a package that the tests do not know otherwise."""
    count = len(one.handled)
    one.publishers['detections'].publish(message)
    one.spin_until(lambda: len(one.handled) > count, 'an answer')
    assert one.handled[-1].faults == ()
    one.spin_until(lambda: len(found) == len(one.handled) - 1)
    return found[-1]


def stamped(one, message, camera, index):
    message.header.stamp = one.of_ros(time_message(camera.messages, camera.stamp(index)))
    message.header.frame_id = 'lens'
    return message


def test_floats(world, small_camera):
    one, kind, found = world(small_camera, 'floats', scheme='coco17')
    message = send(one, kind(data=np.ones(51, np.float32).tolist()), found)
    assert list(message.u) == [1.0] * 17
    assert message.names[0] == 'nose'
    _, text, values = one.diagnosis()
    assert text == 'following, one of 1'
    assert values['detections converted'] == '1'
    one.assert_described(KeypointsAdapterParameters())
    one.assert_refused(({'scheme': 'coco'}, "saw 'coco'"), ({'source': 'x'}, "saw 'x'"))


def test_skeletons_of_hri_msgs(world, small_camera):
    one, kind, found = world(small_camera, 'skeleton2d')
    message = stamped(one, kind(), small_camera, 1)
    for point in message.skeleton:
        point.x, point.y, point.c = 0.5, 0.25, 0.5
    keypoints = send(one, message, found)
    assert (list(keypoints.u), list(keypoints.v)) == ([31.5] * 18, [11.5] * 18)
    assert keypoints.names[1] == 'neck'


def test_people_of_yolo_msgs(world, small_camera):
    one, kind, found = world(small_camera, 'yolo', person_id='2')
    module = import_module(kind.__module__.partition('.')[0] + '.msg')
    message = stamped(one, kind(), small_camera, 1)
    for identity, column in (('1', 5.0), ('2', 9.0)):
        person = module.Detection(id=identity)
        point = module.KeyPoint2D(id=1, point=module.Point2D(x=column, y=3.0), score=0.5)
        person.keypoints.data.append(point)
        message.detections.append(person)
    keypoints = send(one, message, found)
    assert (list(keypoints.names), list(keypoints.u)) == (['nose'], [9.0])


@pytest.mark.parametrize('source', ['skeleton2d', 'yolo'])
def test_a_package_that_is_not_installed_is_told(executable, source):
    package = SOURCES[source].partition('/')[0]
    if find_spec(package) is not None:
        pytest.skip(f'package {package} is installed')
    lines = executable('keypoints_adapter_node', '-p', f'source:={source}').stop_at(package)
    (line,) = (line for line in lines if package in line)
    assert '[ERROR]' in line
    assert f'the package {package} is not installed: install it' in line
