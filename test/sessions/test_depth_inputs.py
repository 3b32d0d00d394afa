"""Depth images in the session of the filter, with a stub tracker."""

import numpy as np
import pytest

from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.image_inputs import DEPTH, DETECTIONS
from hmt_ros.sessions.people_session import PeopleSession
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools.messages.detections import PEOPLE_2D
from msg_tools.messages.headers import header_message
from msg_tools.messages.images import depth_message


@pytest.fixture
def session(stub_tracker, subject_file, outputs, small_camera):
    def make(**values):
        values = {'subject_file': str(subject_file), 'use_depth': True, **values}
        one = TrackingSession(with_values(FilterParameters(), values), outputs.append)
        one.take(CAMERA_INFO, small_camera.info())
        return one

    return make


def depths(stub_tracker):
    """The largest depth passed with each image, None without a depth image."""
    return [
        None if depth is None else float(depth.max())
        for tracker in stub_tracker.made
        for depth in tracker.depths
    ]


def test_depth_goes_with_the_image_of_its_stamp(session, small_camera, stub_tracker):
    """This holds in any order of arrival, in mm and in m."""
    one = session()
    one.take(IMAGE, small_camera.image(0))
    one.take(IMAGE, small_camera.image(1))
    assert depths(stub_tracker) == []
    metres = np.full((48, 64), 2.0, np.float32)
    one.take(DEPTH, depth_message(small_camera.messages, metres, small_camera.stamp(1), ''))
    one.take(DEPTH, small_camera.depth(2))
    one.take(DEPTH, small_camera.depth(0, metres=4.0))
    one.take(IMAGE, small_camera.image(2))
    assert depths(stub_tracker)[1:] == [2.0, 3.0]


@pytest.mark.parametrize(
    ('bad', 'text'),
    [
        (lambda c: c.mask(0), "depth has encoding 'mono8', wanted 16UC1 in mm or 32FC1 in m"),
        (lambda c: c.depth(0, size=(32, 24)), 'has 32x24 pixels, wanted the 64x48 of its image'),
        (lambda c: c.depth(0, metres=0.0), 'has no value between 0.2 and 20 m'),
        (lambda c: c.depth(0, metres=60.0), 'has no value between 0.2 and 20 m'),
    ],
)
def test_bad_depth_is_told_once_and_not_used(session, small_camera, stub_tracker, bad, text):
    """The image stops waiting, and the next depth image is used."""
    one = session()
    first = one.take(DEPTH, bad(small_camera))
    second = one.take(IMAGE, small_camera.image(0))
    (warning,) = first.warnings + tuple(w for w in second.warnings if 'depth' in w)
    assert text in warning
    one.take(DEPTH, small_camera.depth(1))
    one.take(IMAGE, small_camera.image(1))
    assert depths(stub_tracker) == [None, 3.0]
    assert one.state.faults == {'depth': 1}


def test_depth_of_something_else_is_told_once(session, small_camera, stub_tracker):
    one = session()
    for index in range(4):
        one.take(DEPTH, small_camera.depth(index))
        warnings = one.take(IMAGE, small_camera.image(index)).warnings
        assert len(warnings) == (index == 2)
        stub_tracker.made[0].validity._depth = np.array([index != 0, index == 0], float)
    assert one.state.faults == {'depth of something else': 2}


def test_several_people_are_seen_with_the_same_depth(small_camera, monkeypatch):
    """Images wait for the depth as for the detections, and are processed without it at last."""
    seen = []

    def nobody(self, waiting, *_):
        seen.append(waiting.depth)
        return iter(())

    monkeypatch.setattr(PeopleSession, '_nearest_first', nobody)
    values = {'use_depth': True, 'input_timeout': 0.25}
    one = PeopleSession(with_values(PeopleParameters(), values), lambda output: None)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(5):
        one.take(IMAGE, small_camera.image(index))
        header = header_message(small_camera.messages, small_camera.stamp(index), 'lens')
        one.take(DETECTIONS, small_camera.messages.create(PEOPLE_2D, header=header))
        if index == 0:
            assert seen == []
            one.take(DEPTH, small_camera.depth(index))
    assert seen[0].max() == 3.0
    assert seen[1] is None
    assert one.state.faults['no depth'] >= 1
