"""The keypoints session, with stub detectors."""

import numpy as np
import pytest

from hmt_ros.detectors.detector import DetectorKind
from hmt_ros.detectors.people import SeenPerson
from hmt_ros.detectors.registry import DETECTORS
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions import keypoints_session
from hmt_ros.sessions.camera_session import IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.keypoints_session import TOPICS, KeypointsParameters, KeypointsSession
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.images import decode_mask
from msg_tools.messages.keypoints import keypoints_of, positions_of

NAMES = schemes()['mediapipe33'].names


class StubDetector:
    """Stub of `BlazePose`; a person is where the image is white."""

    def __init__(self, *, with_mask):
        self.with_mask, self.mask = with_mask, None

    def detect(self, image, stamp_ns):
        seen = (image == 250).all(2)
        self.mask = seen if self.with_mask else None
        if not seen.any():
            return None
        pixels = np.tile(np.argwhere(seen)[0, ::-1].astype(float), (33, 1))
        covariances = np.full((33, 2, 2), np.nan)
        return Keypoints(NAMES, pixels, covariances, np.full(33, 0.5), np.full((33, 3), 0.25))


STUB = DetectorKind('Stub', StubDetector, lambda: True, lambda: None)


@pytest.fixture
def session(outputs, monkeypatch):
    monkeypatch.setitem(DETECTORS, 'mediapipe', STUB)

    def make(wanted=lambda topic: True, **values):
        parameters = with_values(KeypointsParameters(), values)
        return KeypointsSession(parameters, outputs.append, wanted)

    return make


def read(outputs):
    """Messages by topic, in their order."""
    found = {}
    for topic, stamp, data in outputs:
        found.setdefault(stamp, {})[topic] = deserialise(data, TOPICS[topic].msgtype)
    return list(found.values())


def test_every_image_has_keypoints(session, outputs, somebody):
    one = session(publish_mask=True)
    assert (one.state.status, one.state.wants) == ('waiting', 'an image')
    stamp = somebody.stamp(0)
    assert one.take(IMAGE, somebody.image(0)) == Handled(
        IMAGE, stamp, (), (), (('keypoints', stamp), ('keypoints_3d', stamp), ('mask', stamp))
    )
    (messages,) = read(outputs)
    plane = messages['keypoints']
    assert plane.header.frame_id == 'lens'
    assert len(plane.covariance) == 0
    keypoints = keypoints_of(plane, 5.0)
    assert keypoints.names == NAMES
    np.testing.assert_array_equal(keypoints.pixels, np.tile([20.0, 12.0], (33, 1)))
    np.testing.assert_array_equal(keypoints.confidences, np.full(33, 0.5))
    np.testing.assert_array_equal(positions_of(messages['keypoints_3d']).positions, 0.25)
    assert decode_mask(messages['mask']).sum() == 240
    assert (one.state.status, one.state.wants, one.state.landmarks) == ('detecting', '', 33)


def test_nobody_is_an_answer(session, outputs, somebody):
    one = session(publish_mask=True)
    one.take(IMAGE, somebody.empty(0))
    (messages,) = read(outputs)
    assert len(messages['keypoints'].names) == len(messages['keypoints_3d'].names) == 0
    assert not decode_mask(messages['mask']).any()
    assert one.state.counts == {'received': 1, 'detected': 1, 'empty': 1}
    assert (one.state.status, one.state.trouble()) == ('nobody', '')


def test_only_what_is_wanted_is_published(session, outputs, somebody):
    one = session(wanted=lambda topic: topic == 'keypoints', publish_mask=True)
    one.take(IMAGE, somebody.image(0))
    assert [output.topic for output in outputs] == ['keypoints']
    two = session()
    two.take(IMAGE, somebody.compressed(1))
    assert [output.topic for output in outputs][1:] == ['keypoints', 'keypoints_3d']


def test_what_goes_wrong_is_told(session, outputs, somebody):
    one = session()
    one.take(IMAGE, somebody.image(5))
    (fault,) = one.take(IMAGE, somebody.image(5)).faults
    assert 'wanted stamps that increase' in fault
    (fault,) = one.take(IMAGE, somebody.image(4)).faults
    assert 'with reset_on_time_jump the sequence would start again' in fault
    bad = somebody.image(6)
    bad.encoding = 'morse'
    assert 'morse' in one.take(IMAGE, bad).faults[0]
    assert one.take(IMAGE, somebody.image(7)).faults == ()
    assert one.state.counts['skipped'] == 3


def test_time_that_jumps_back(session, outputs, somebody):
    one = session(reset_on_time_jump=True)
    one.take(IMAGE, somebody.image(5))
    assert one.take(IMAGE, somebody.image(1)).published == ()
    handled = one.take(IMAGE, somebody.image(2))
    assert 'the sequence starts again' in handled.warnings[0]
    assert len(handled.published) == 4


class StubPeople:
    """Stub of `PeopleDetector`: up to `most` of two people where the image is white."""

    def __init__(self, most):
        self.most, self.left_out = most, 0

    def detect(self, image, stamp_ns):
        seen = (image == 250).all(2)
        if not seen.any():
            self.left_out = 0
            return []
        row, column = np.argwhere(seen)[0]
        unknown = np.full((33, 2, 2), np.nan)
        keypoints = Keypoints(NAMES, np.full((33, 2), float(column)), unknown, np.full(33, 0.5))
        corners = np.array([[column, row], [column + 10.0, row + 24.0]])
        self.left_out = max(2 - self.most, 0)
        return [SeenPerson(x, keypoints, corners, x == 'p7') for x in ('p1', 'p7')[: self.most]]


def test_several_people_are_detections(session, outputs, somebody, monkeypatch):
    monkeypatch.setattr(keypoints_session, 'PeopleDetector', StubPeople)
    one = session(people=2)
    assert one.state.status == 'waiting'
    stamp = somebody.stamp(0)
    handled = one.take(IMAGE, somebody.image(0))
    assert handled.published == (('detections', stamp),)
    assert handled.warnings == ('nothing about p7 has changed for 10 s: a picture or a statue?',)
    ((topic, _, data),) = outputs
    message = deserialise(data, TOPICS[topic].msgtype)
    assert (message.header.frame_id, message.ids) == ('lens', ['p1', 'p7'])
    assert [(x.x_offset, x.y_offset, x.width, x.height) for x in message.boxes] == [
        (20, 12, 10, 24)
    ] * 2
    assert keypoints_of(message.keypoints[0], 5.0).names == NAMES
    assert (one.state.summary(), one.state.status) == ('2 people', 'detecting')
    one.take(IMAGE, somebody.empty(1))
    assert (one.state.summary(), one.state.status) == ('0 people', 'nobody')
    assert one.state.counts == {'received': 2, 'detected': 2, 'empty': 1}


def test_people_beyond_the_maximum_are_told_once(session, outputs, somebody, monkeypatch):
    monkeypatch.setattr(keypoints_session, 'PeopleDetector', StubPeople)
    one = session(people=1)
    (warning,) = one.take(IMAGE, somebody.image(0)).warnings
    assert '2 people are seen' in warning
    assert 'people is 1: the smallest are left out' in warning
    assert one.take(IMAGE, somebody.image(1)).warnings == ()


def test_a_detector_of_one_person_finds_no_two():
    with pytest.raises(ValueError, match=r"finds one person, but people is 2: wanted detector 'me"):
        KeypointsParameters(detector='mediapipe+movenet', people=2)
