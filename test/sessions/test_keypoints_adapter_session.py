"""The rules of the adapter of other detectors."""

from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.sessions.camera_session import CAMERA_INFO
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.keypoints_adapter_parameters import KeypointsAdapterParameters
from hmt_ros.sessions.keypoints_adapter_session import DETECTIONS, KeypointsAdapterSession
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import header_message
from msg_tools.messages.keypoints import keypoints_of

COCO = schemes()['coco17'].names


@pytest.fixture
def session(outputs):
    def make(source, **values):
        parameters = with_values(KeypointsAdapterParameters(), {'source': source, **values})
        return KeypointsAdapterSession(parameters, outputs.append)

    return make


def read(outputs):
    return [deserialise(output.data, 'hmt_msgs/msg/Keypoints2D') for output in outputs]


def skeleton(camera, index, x=0.5):
    point = SimpleNamespace(x=x, y=0.25, c=0.5)
    header = header_message(camera.messages, camera.stamp(index), 'lens')
    return SimpleNamespace(header=header, skeleton=[point] * 18)


def yolo(camera, index, **people):
    """People by id: column of their left side and height, px."""
    detections = []
    for name, (column, height) in people.items():
        places = [(column, 10.0), (column, 10.0 + height)]
        data = [
            SimpleNamespace(id=6 + i, point=SimpleNamespace(x=u, y=v), score=0.75)
            for i, (u, v) in enumerate(places)
        ]
        detections.append(SimpleNamespace(id=name, keypoints=SimpleNamespace(data=data)))
    header = header_message(camera.messages, camera.stamp(index), 'other')
    return SimpleNamespace(header=header, detections=detections)


def floats(camera, rows, label=''):
    dimension = camera.messages.create(
        'std_msgs/msg/MultiArrayDimension', size=len(rows), label=label
    )
    columns = camera.messages.create(
        'std_msgs/msg/MultiArrayDimension', size=rows.shape[1], label=''
    )
    layout = camera.messages.create('std_msgs/msg/MultiArrayLayout', dim=[dimension, columns])
    return camera.messages.create(
        'std_msgs/msg/Float32MultiArray', layout=layout, data=rows.ravel()
    )


def test_a_skeleton_needs_the_size_of_the_image(session, outputs, small_camera):
    one = session('skeleton2d')
    assert one.state.wants.startswith('a calibrated camera_info')
    (fault,) = one.take(DETECTIONS, skeleton(small_camera, 0)).faults
    assert 'detection comes before a calibrated camera_info' in fault
    one.take(CAMERA_INFO, small_camera.uncalibrated())
    assert one.state.wants.startswith('a calibrated camera_info')
    one.take(CAMERA_INFO, small_camera.info())
    stamp = small_camera.stamp(1)
    assert one.take(DETECTIONS, skeleton(small_camera, 1)).published == (('keypoints', stamp),)
    (message,) = read(outputs)
    keypoints = keypoints_of(message, 5.0)
    assert keypoints.names == schemes()['skeleton2d'].names
    np.testing.assert_array_equal(keypoints.pixels[0], [31.5, 11.5])
    np.testing.assert_array_equal(keypoints.confidences, np.full(18, 0.5))
    assert (message.header.frame_id, len(message.covariance)) == ('lens', 0)
    assert one.state.status == 'following'


def test_a_camera_is_needed_until_it_is_known(session, small_camera):
    one = session(source='skeleton2d')
    assert [each.sources for each in one.needed_inputs()] == [('detections',), ('camera_info',)]
    (text,) = one.take(CAMERA_INFO, small_camera.uncalibrated()).warnings
    assert text.startswith('camera_info has k[0] = 0: uncalibrated; calibrate the camera')
    one.take(CAMERA_INFO, small_camera.info())
    assert [each.sources for each in one.needed_inputs()] == [('detections',)]


def test_a_person_by_nearness(session, outputs, small_camera):
    one = session('yolo')
    one.take(DETECTIONS, yolo(small_camera, 0, a=(10.0, 20.0), b=(100.0, 30.0)))
    one.take(DETECTIONS, yolo(small_camera, 1, b=(10.0, 40.0), a=(101.0, 20.0)))
    one.take(DETECTIONS, yolo(small_camera, 2, b=(10.0, 40.0)))
    found = [dict(zip(message.names, message.u, strict=True)) for message in read(outputs)]
    names = (COCO[5], COCO[6])
    assert found == [dict.fromkeys(names, 100.0), dict.fromkeys(names, 101.0), {}]
    assert one.state.counts == {'received': 3, 'converted': 3, 'empty': 1}
    assert (one.state.status, one.state.people) == ('nobody', 1)


def test_a_person_by_identity(session, outputs, small_camera):
    one = session('yolo', person_id='a')
    one.take(DETECTIONS, yolo(small_camera, 0, a=(10.0, 20.0), b=(100.0, 30.0)))
    one.take(DETECTIONS, yolo(small_camera, 1, b=(10.0, 40.0), a=(101.0, 20.0)))
    one.take(DETECTIONS, yolo(small_camera, 2, b=(10.0, 40.0)))
    assert [message.u.tolist() for message in read(outputs)] == [[10.0] * 2, [101.0] * 2, []]


def test_floats_have_the_stamp_of_the_image(session, outputs, small_camera):
    one = session('floats', scheme='coco17')
    rows = np.ones((17, 3))
    assert 'before a camera_info' in one.take(DETECTIONS, floats(small_camera, rows)).faults[0]
    one.take(CAMERA_INFO, small_camera.info(3))
    one.take(DETECTIONS, floats(small_camera, rows))
    told = str(small_camera.stamp(4))
    one.take(DETECTIONS, floats(small_camera, rows[:, :2], told))
    assert [output.stamp_ns for output in outputs] == [small_camera.stamp(i) for i in (3, 4)]
    assert [message.header.frame_id for message in read(outputs)] == ['lens', 'lens']
    assert list(read(outputs)[0].names) == list(COCO)
    (fault,) = one.take(DETECTIONS, floats(small_camera, rows, told)).faults
    assert 'wanted stamps that increase' in fault


def test_detections_that_can_not_be_used_are_told(session, outputs, small_camera):
    one = session('floats', scheme='halpe26')
    one.take(CAMERA_INFO, small_camera.info(0))
    (fault,) = one.take(DETECTIONS, floats(small_camera, np.ones((17, 3)))).faults
    assert 'wanted 26x2 or 26x3 of the scheme halpe26' in fault
    assert outputs == []


def test_parameters():
    with pytest.raises(ValueError, match=r"source must be one of .* saw 'pigeon'"):
        KeypointsAdapterParameters(source='pigeon')
    with pytest.raises(ValueError, match=r"scheme must be one of .* saw 'coco'"):
        KeypointsAdapterParameters(scheme='coco')


def test_time_that_jumps_back(session, outputs, small_camera):
    one = session('yolo', reset_on_time_jump=True)
    one.take(DETECTIONS, yolo(small_camera, 9, a=(10.0, 20.0)))
    handled = one.take(DETECTIONS, yolo(small_camera, 0, b=(500.0, 20.0)))
    assert 'the sequence starts anew' in handled.warnings[0]
    assert [message.u.tolist() for message in read(outputs)] == [[10.0] * 2, [500.0] * 2]
