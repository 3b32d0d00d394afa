"""Keypoints of other detectors, as the filter and the experts receive them."""

from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.image_inputs import DETECTIONS
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools.messages.headers import header_message


@pytest.fixture
def session(stub_tracker, subject_file, outputs):
    def make(source, **values):
        values = {
            'source': source,
            'use_keypoints': True,
            'subject_file': str(subject_file),
            **values,
        }
        return TrackingSession(with_values(FilterParameters(), values), outputs.append)

    return make


@pytest.fixture
def seen(stub_tracker):
    """Keypoints of the images that were tracked, by name."""

    def found():
        every = [keypoints for _, keypoints in stub_tracker.made[0].seen]
        return [
            None if one is None else dict(zip(one.names, one.pixels[:, 0].tolist(), strict=True))
            for one in every
        ]

    return found


def skeleton(camera, index, x=0.5):
    point = SimpleNamespace(x=x, y=0.25, c=0.5)
    header = header_message(camera.messages, camera.stamp(index), 'lens')
    return SimpleNamespace(header=header, skeleton=[point] * 18)


def yolo(camera, index, **people):
    """Detections of people by id, from the column of their left side and their height, px."""
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


def test_a_skeleton_needs_the_size_of_the_image(session, seen, small_camera):
    one = session('skeleton2d')
    (fault,) = one.take(DETECTIONS, skeleton(small_camera, 0)).faults
    assert 'it comes before a calibrated camera_info, which gives the size of the image' in fault
    one.take(CAMERA_INFO, small_camera.info())
    assert one.take(DETECTIONS, skeleton(small_camera, 1)).faults == ()
    one.take(IMAGE, small_camera.image(1))
    (found,) = seen()
    assert set(found.values()) == {31.5}
    assert {'neck', 'left_wrist'} <= found.keys()
    sources = {each.sources for each in one.needed_inputs()}
    assert (DETECTIONS,) in sources
    assert ('keypoints',) not in sources


def people(one, camera, *detections):
    """Hands over the images 0, 1, ... and what a detector sees in them."""
    one.take(CAMERA_INFO, camera.info())
    for index, seen in enumerate(detections):
        assert one.take(DETECTIONS, yolo(camera, index, **seen)).faults == ()
        one.take(IMAGE, camera.image(index))


def test_a_person_by_identity(session, seen, small_camera):
    people(
        session('yolo', person_id='a'), small_camera,
        {'a': (10.0, 20.0), 'b': (100.0, 30.0)}, {'b': (10.0, 40.0), 'a': (101.0, 20.0)},
        {'b': (10.0, 40.0)},
    )  # fmt: skip
    assert [set(found.values()) for found in seen()] == [{10.0}, {101.0}, set()]


def test_floats_have_the_stamp_of_the_image(session, seen, small_camera):
    one = session('floats', keypoint_scheme='coco17')
    rows = np.ones((17, 3))
    (fault,) = one.take(DETECTIONS, floats(small_camera, rows)).faults
    assert 'it comes before a camera_info, which gives its stamp' in fault
    one.take(CAMERA_INFO, small_camera.info(3))
    one.take(DETECTIONS, floats(small_camera, rows))
    one.take(IMAGE, small_camera.image(3))
    one.take(DETECTIONS, floats(small_camera, rows[:, :2], str(small_camera.stamp(4))))
    one.take(IMAGE, small_camera.image(4))
    assert [set(found.values()) for found in seen()] == [{1.0}, {1.0}]


def test_detections_that_can_not_be_used_are_told(session, small_camera):
    one = session('floats', keypoint_scheme='halpe26')
    one.take(CAMERA_INFO, small_camera.info(0))
    (fault,) = one.take(DETECTIONS, floats(small_camera, np.ones((17, 3)))).faults
    assert 'wanted 26x2 or 26x3 of the scheme halpe26' in fault
    # It counts as no detection: the image need not wait.
    one.take(IMAGE, small_camera.image(0))
    assert one.state.counts['tracked'] == 1
