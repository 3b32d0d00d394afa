"""Keypoints of other packages at the filter node, over DDS."""

from importlib import import_module
from importlib.util import find_spec

import numpy as np
import pytest

from hmt_ros.sessions.image_inputs import SOURCES
from msg_tools.messages.headers import time_message

pytestmark = pytest.mark.ros


@pytest.fixture
def world(stub_tracker, subject_file, world_of):
    """A world with a filter that has received its calibration."""

    def make(camera, source, **values):
        from sensor_msgs.msg import CameraInfo, Image

        from hmt_ros.nodes.filter_node import FilterNode

        package, _, name = SOURCES[source].split('/')
        if find_spec(package) is None:
            pytest.skip(f'package {package} is not installed')
        kind = getattr(import_module(f'{package}.msg'), name)
        inputs = {'camera_info': CameraInfo, 'detections': kind, 'image': Image}
        one = world_of(
            FilterNode, 'filter_node', inputs, source=source, use_keypoints=True,
            subject_file=str(subject_file), **values,
        )  # fmt: skip
        one.start()
        one.send('camera_info', camera.info(0))
        return one, kind

    return make


def tracked(one, message, camera, index, stub_tracker):
    """The keypoints that the tracker receives with an image."""
    count = len(one.handled)
    one.publishers['detections'].publish(message)
    one.spin_until(lambda: len(one.handled) > count, 'an answer')
    assert one.handled[-1].faults == ()
    one.send('image', camera.image(index))
    return stub_tracker.made[0].seen[-1][1]


def stamped(one, message, camera, index):
    message.header.stamp = one.of_ros(time_message(camera.messages, camera.stamp(index)))
    return message


def test_floats(world, small_camera, stub_tracker):
    one, kind = world(small_camera, 'floats', keypoint_scheme='coco17')
    message = kind(data=np.ones(51, np.float32).tolist())
    keypoints = tracked(one, message, small_camera, 0, stub_tracker)
    assert 'head' in keypoints.names
    np.testing.assert_array_equal(keypoints.pixels, np.ones((len(keypoints.names), 2)))
    one.assert_refused(({'keypoint_scheme': 'coco'}, "saw 'coco'"), ({'source': 'x'}, "saw 'x'"))
    assert one.other.count_subscribers('keypoints') == 0


def test_skeletons_of_hri_msgs(world, small_camera, stub_tracker):
    one, kind = world(small_camera, 'skeleton2d')
    message = stamped(one, kind(), small_camera, 1)
    for point in message.skeleton:
        point.x, point.y, point.c = 0.5, 0.25, 0.5
    keypoints = tracked(one, message, small_camera, 1, stub_tracker)
    assert set(keypoints.pixels[:, 0]) == {31.5}


def test_people_of_yolo_msgs(world, small_camera, stub_tracker):
    one, kind = world(small_camera, 'yolo', person_id='2')
    module = import_module(kind.__module__.partition('.')[0] + '.msg')
    message = stamped(one, kind(), small_camera, 1)
    for identity, column in (('1', 5.0), ('2', 9.0)):
        person = module.Detection(id=identity)
        point = module.KeyPoint2D(id=1, point=module.Point2D(x=column, y=3.0), score=0.5)
        person.keypoints.data.append(point)
        message.detections.append(person)
    keypoints = tracked(one, message, small_camera, 1, stub_tracker)
    assert (keypoints.names, keypoints.pixels[0, 0]) == (('head',), 9.0)


@pytest.mark.parametrize(('node', 'source'), [('filter_node', 'yolo'), ('bme_node', 'skeleton2d')])
def test_a_package_that_is_not_installed_is_told(world_of, node, source):
    package = SOURCES[source].partition('/')[0]
    if find_spec(package) is not None:
        pytest.skip(f'package {package} is installed')
    more = {'predict_from': 'keypoints'} if node == 'bme_node' else {}
    module = import_module(f'hmt_ros.nodes.{node}')
    kind = {'filter_node': 'FilterNode', 'bme_node': 'BmeNode'}[node]
    one = world_of(getattr(module, kind), node, {}, source=source, **more)
    one.node.start()
    (text,) = one.errors()
    assert f'the package {package} is not installed: install it' in text
