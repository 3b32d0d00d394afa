"""The node for several people, over DDS."""

from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from hmt_ros.sessions.tracking_parameters import PeopleParameters
from test.sessions.conftest import StubTracker
from test.sessions.test_people_session import Follower, seen, somebody_at

pytestmark = pytest.mark.ros


@pytest.fixture
def world(world_of, monkeypatch):
    """A world with the node and stub trackers, and its messages about people."""
    from hmt_msgs.msg import People2D, PoseMixture
    from sensor_msgs.msg import CameraInfo, Image

    from hmt_ros.nodes.people_node import PeopleNode
    from hmt_ros.sessions import track_start

    monkeypatch.setattr(track_start, 'Tracker', Follower)
    monkeypatch.setattr(StubTracker, 'made', [])
    monkeypatch.setattr('hmt_ros.nodes.people_node.CLOSING_PERIODS', 1)

    def make(camera, **values):
        inputs = {'camera_info': CameraInfo, 'detections': People2D, 'image': Image}
        one = world_of(PeopleNode, 'people_node', inputs, **values)
        one.start()
        one.found, one.mixtures = [], {}
        one.listen(People2D, 'people', one.found)
        for name in ('anna', 'p1'):
            one.mixtures[name] = []
            one.listen(PoseMixture, f'humans/bodies/{name}/pose_mixture', one.mixtures[name])
        one.spin_until(lambda: one.is_heard('people'))
        one.send('camera_info', camera.info(0))
        return one

    return make


def show(one, camera, index, *people):
    """Sends an image and its detections, and waits for the list of people."""
    count = len(one.found)
    one.send('detections', seen(camera, index, *people))
    handled = one.send('image', camera.image(index))
    one.spin_until(lambda: len(one.found) > count, 'the list of people')
    return handled


def topics(one):
    return {
        name for name, _ in one.other.get_topic_names_and_types()
        if name.endswith('pose_mixture') and one.other.count_publishers(name)
    }  # fmt: skip


def test_topics_come_and_go_with_the_people(world, small_camera):
    one = world(small_camera)
    show(one, small_camera, 0, somebody_at(15, 'anna'), somebody_at(50))
    assert one.found[-1].ids == ['anna', 'p1']
    wanted = {f'/humans/bodies/{name}/pose_mixture' for name in ('anna', 'p1')}
    one.spin_until(lambda: topics(one) == wanted, 'the topics of both')
    for name in ('anna', 'p1'):
        one.spin_until(lambda name=name: one.is_heard(f'humans/bodies/{name}/pose_mixture'))
    for index in range(1, 5):
        show(one, small_camera, index, somebody_at(15, 'anna'))
    one.spin_until(lambda: one.mixtures['p1'] and not one.mixtures['p1'][-1].components)
    one.spin_until(lambda: one.mixtures['anna'] and one.mixtures['anna'][-1].components)
    one.spin_until(lambda: topics(one) == {'/humans/bodies/anna/pose_mixture'}, 'the topic to go')
    _, text, values = one.diagnosis()
    assert text == 'tracking, 1 of 1 people'
    assert (values['people'], values['people detected']) == ('anna', '1')
    one.assert_described(PeopleParameters(), 'filter_node')


def test_a_detector_that_is_killed_and_started_again(world, small_camera):
    """Images without detections are reported, and the person is the same afterwards."""
    one = world(small_camera)
    show(one, small_camera, 0, somebody_at(15, 'anna'))
    one.spin_until(lambda: one.is_heard('humans/bodies/anna/pose_mixture'))
    for index in range(1, 9):
        one.send('image', small_camera.image(index))
    show(one, small_camera, 9, somebody_at(15, 'anna'))
    assert any(text.startswith('no detections came for the image of') for text in one.warnings())
    one.spin_until(lambda: one.diagnosis()[2]['faults: no detections'] == '8', 'all images')
    assert one.found[-1].ids == ['anna']
    assert len(StubTracker.made) == 1


def test_reset_drops_all_tracks(world, small_camera):
    from hmt_msgs.srv import Reset
    from sensor_msgs.msg import RegionOfInterest

    one = world(small_camera)
    show(one, small_camera, 0, somebody_at(15, 'anna'))
    answer = one.call(Reset, 'reset', box=RegionOfInterest(width=5, height=5))
    assert (answer.success, answer.message[:26]) == (False, 'a mixture or a box is for ')
    answer = one.call(Reset, 'reset')
    assert (answer.success, answer.message) == (True, 'a new track waits for detections of people')
    show(one, small_camera, 1, somebody_at(15, 'anna'))
    assert len(StubTracker.made) == 2


def test_a_reset_that_can_not_be_done_is_refused(world, small_camera, tmp_path):
    from hmt_msgs.srv import Reset

    file = tmp_path / 'background.png'
    file.write_bytes(cv2.imencode('.png', np.full((48, 64, 3), 90, np.uint8))[1].tobytes())
    one = world(small_camera, background_file=str(file))
    show(one, small_camera, 0, somebody_at(15, 'anna'))
    file.unlink()
    answer = one.call(Reset, 'reset')
    assert not answer.success
    assert str(file) in answer.message
    # The tracks go on.
    show(one, small_camera, 1, somebody_at(15, 'anna'))
    assert len(StubTracker.made) == 1


def test_boxes_need_their_package(world_of):
    if find_spec('vision_msgs') is not None:
        pytest.skip('package vision_msgs is installed')
    from hmt_ros.nodes.people_node import PeopleNode

    one = world_of(PeopleNode, 'people_node', {}, source='boxes')
    one.node.start()
    (text,) = one.errors()
    assert 'the package vision_msgs is not installed: install it' in text
