"""Behaviour common to all sessions, and to those that take images."""

import pytest

from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession


@pytest.fixture
def one(stub_tracker, subject_file, outputs):
    found = TrackingSession(FilterParameters(subject_file=str(subject_file)), outputs.append)
    found.topic_names = {IMAGE: '/cam/image', CAMERA_INFO: '/cam/camera_info'}
    return found


def test_frames_of_image_and_camera_info_that_differ_are_told_once(one, small_camera):
    one.take(CAMERA_INFO, small_camera.info(frame_id='camera_link'))
    handled = [one.take(IMAGE, small_camera.image(index)) for index in range(3)]
    assert [len(each.warnings) for each in handled] == [1, 0, 0]
    assert (
        handled[0]
        .warnings[0]
        .startswith(
            "image on /cam/image has frame_id 'lens', camera_info on /cam/camera_info has "
            "'camera_link': results are in the frame of the image; "
        )
    )
    # The image is used nevertheless.
    assert handled[0].faults == ()
    assert one.state.counts['tracked'] == 3
    assert one.state.frame_id == 'lens'


def test_two_publishers_of_images_are_told_once(one, small_camera):
    one.take(CAMERA_INFO, small_camera.info())
    handled = [
        one.take(IMAGE, small_camera.image(index, frame_id=('lens', 'other')[index % 2]))
        for index in range(6)
    ]
    assert [len(each.warnings) for each in handled] == [0, 1, 0, 0, 0, 0]
    assert handled[1].warnings == (
        "image on /cam/image has messages of the frames 'lens' and 'other': wanted those of one "
        'camera; stop or remap one of the publishers',
    )
