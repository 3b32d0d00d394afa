"""The session for several people, with stub trackers."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions import track_start
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.image_inputs import DETECTIONS
from hmt_ros.sessions.people_session import OVERLAY, PEOPLE, PeopleSession, published_topic
from hmt_ros.sessions.tracking_parameters import PeopleParameters
from hmt_ros.tracking import Status
from hmt_ros.tracking.beginning import Source
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.detections import (
    PEOPLE_2D,
    DetectedPerson,
    people_message,
    people_of_message,
)
from msg_tools.messages.headers import header_message
from msg_tools.messages.images import decode_image
from msg_tools.messages.keep_out import KEEP_OUT, keep_out_of
from test.sessions.conftest import StubTracker

NAMES = (
    'left_shoulder', 'right_shoulder', 'left_hip', 'right_hip', 'left_knee', 'right_knee',
    'left_ankle', 'right_ankle',
)  # fmt: skip
IMAGE_TYPE = published_topic(OVERLAY).msgtype
SHAPE = np.array([[3, -10], [-3, -10], [2, 0], [-2, 0], [2, 7], [-2, 7], [2, 14], [-2, 14.0]])


class Follower(StubTracker):
    """Stub at its keypoints, 4 m away; its track ends after three images without keypoints."""

    missed = 0
    pose = None
    others = None

    @property
    def modes(self):
        return SimpleNamespace(
            poses=np.stack([self.pose] * 2), log_weights=np.log([0.75, 0.25]),
            log_likelihoods=np.array([-1.0, -2.0]), identities=np.arange(2),
        )  # fmt: skip

    @property
    def published(self):
        return self.modes

    @property
    def point_estimate(self):
        return self.pose

    def step(self, image, stamp, keypoints=None, *args, others=None, **inputs):
        self.others = others
        self.image = image
        seen = keypoints is not None and keypoints.seen.any()
        self.missed = 0 if seen else self.missed + (keypoints is not None)
        if not seen and (self.pose is None or self.missed > 2):
            self.status = Status.NOBODY if self.pose is not None else Status.WAITING
            return None, None
        if self.pose is None:
            self.pose, self.started_from = self.body.prior_mean.copy(), Source.KEYPOINTS
        if seen:
            middle = keypoints.pixels[keypoints.seen].mean(0)
            away = 4.0 if middle[0] < 32 else 5.0
            ray = self.camera.rays(middle[None])[0]
            self.pose[:3] = away * ray / ray[2]
        self.start = SimpleNamespace(means=self.pose[None])
        return super().step(image, stamp, keypoints, *args, **inputs)


@pytest.fixture
def session(outputs, monkeypatch):
    monkeypatch.setattr(track_start, 'Tracker', Follower)
    monkeypatch.setattr(StubTracker, 'made', [])

    def make(**values):
        return PeopleSession(with_values(PeopleParameters(), values), outputs.append)

    return make


def somebody_at(column, name='', row=24.0, names=NAMES, scale=1.0, box=None):
    pixels = scale * SHAPE[: len(names)] + np.array([column, row])
    unknown = np.full((len(names), 2, 2), np.nan)
    keypoints = Keypoints(tuple(names), pixels, unknown, np.full(len(names), 0.9))
    return DetectedPerson(name, keypoints, box)


def seen(camera, index, *people):
    return people_message(camera.messages, people, camera.stamp(index), 'lens')


def show(one, camera, index, *people):
    """Sends an image and its detections; returns both results."""
    first = one.take(DETECTIONS, seen(camera, index, *people))
    second = one.take(IMAGE, camera.image(index))
    return [*first.events, *first.warnings, *second.events, *second.warnings]


def listed(outputs):
    """Identities in the messages about all."""
    return [
        [person.name for person in people_of_message(deserialise(x.data, PEOPLE_2D), 0.0)]
        for x in outputs
        if x.topic == PEOPLE
    ]


def started(one, camera):
    one.take(CAMERA_INFO, camera.info())
    return one


def test_two_people_have_topics_of_their_own(session, outputs, small_camera):
    one = started(session(), small_camera)
    one.take(DETECTIONS, seen(small_camera, 0, somebody_at(15), somebody_at(50)))
    handled = one.take(IMAGE, small_camera.image(0))
    assert handled.warnings == ()
    assert {text.partition(':')[0] for text in handled.events} == {'p1', 'p2'}
    topics = {output.topic for output in outputs}
    for name in ('p1', 'p2'):
        for topic in ('body', 'pose_mixture', 'human_joint_states', 'markers'):
            assert f'humans/bodies/{name}/{topic}' in topics
    assert '/tf' in topics
    assert published_topic('humans/bodies/p1/overlay/compressed').msgtype.endswith('ssedImage')
    assert published_topic('/tf').msgtype == 'tf2_msgs/msg/TFMessage'
    frames = {
        each.child_frame_id.partition('/')[0]
        for x in outputs
        if x.topic == '/tf'
        for each in deserialise(x.data, 'tf2_msgs/msg/TFMessage').transforms
    }
    assert frames == {'body_p1', 'body_p2'}
    assert listed(outputs) == [['p1', 'p2']]
    assert one.state.counts == {'received': 1, 'tracked': 1}
    assert (one.state.people, one.state.status) == (('p1', 'p2'), 'tracking')
    # One image, decoded once, and one background.
    first, second = StubTracker.made
    assert first.image is second.image
    assert first.silhouettes.background is second.silhouettes.background


def test_everybody_is_shown_together_until_they_leave(session, outputs, small_camera):
    one = started(session(), small_camera)
    show(one, small_camera, 0, somebody_at(15), somebody_at(50))
    for i in range(1, 7):
        show(one, small_camera, i, somebody_at(15))
    kind = published_topic('markers').msgtype
    arrays = [deserialise(x.data, kind).markers for x in outputs if x.topic == 'markers']
    # Actions on the markers by person: 0 adds, 2 deletes.
    actions = [
        {name: {x.action for x in each if x.ns.startswith(name)} for name in ('p1', 'p2')}
        for each in arrays
    ]
    assert actions[0] == {'p1': {0, 2}, 'p2': {0, 2}}
    last = max(i for i, each in enumerate(actions) if each['p2'])
    assert actions[last] == {'p1': {0, 2}, 'p2': {2}}
    assert actions[-1] == {'p1': {0, 2}, 'p2': set()}
    pictures = [deserialise(x.data, IMAGE_TYPE) for x in outputs if x.topic == OVERLAY]
    assert len(pictures) == len(arrays) == 7
    first, *_, final = map(decode_image, pictures)
    assert cv2.absdiff(first, final).max() > 40


def test_identities_stay_through_a_crossing(session, outputs, small_camera):
    one = started(session(), small_camera)
    for i in range(11):
        people = [somebody_at(12 + 4 * i), somebody_at(52 - 4 * i)]
        show(one, small_camera, i, *(people if i % 2 else people[::-1]))
    last = [x for x in outputs if x.topic == PEOPLE][-1]
    found = people_of_message(deserialise(last.data, PEOPLE_2D), 0.0)
    columns = {x.name: float(np.nanmean(x.keypoints.pixels[:, 0])) for x in found}
    # In the first image the second person is listed first.
    assert columns['p1'] == pytest.approx(12, abs=4)
    assert columns['p2'] == pytest.approx(52, abs=4)
    assert len(StubTracker.made) == 2


def test_who_is_nearer_hides_who_is_farther(session, small_camera):
    one = started(session(), small_camera)
    for i in range(3):
        show(one, small_camera, i, somebody_at(28), somebody_at(34))
    near, far = StubTracker.made
    assert near.pose[2] < far.pose[2]
    # The nearer person hides image parts from the other, who also hides a part from the nearer one.
    assert far.others.sum() > 2 * near.others.sum() > 0
    assert (near.others & far.others).sum() < 0.2 * near.others.sum()


def test_an_identity_of_the_detector_is_kept(session, outputs, small_camera):
    one = started(session(), small_camera)
    show(one, small_camera, 0, somebody_at(15, 'anna'), somebody_at(50, '7'))
    # The detector reports that they suddenly swap places.
    show(one, small_camera, 1, somebody_at(15, '7'), somebody_at(50, 'anna'))
    assert listed(outputs) == [['anna', 'p7']] * 2
    columns = [person.pose[0] for person in StubTracker.made]
    assert columns[0] > 0 > columns[1]


def test_who_leaves_ends_and_who_comes_begins(session, outputs, small_camera):
    one = started(session(), small_camera)
    show(one, small_camera, 0, somebody_at(12), somebody_at(50))
    for i in range(1, 5):
        show(one, small_camera, i, somebody_at(12))
    last = [x for x in outputs if x.topic == 'humans/bodies/p2/pose_mixture'][-1]
    assert not deserialise(last.data, 'hmt_msgs/msg/PoseMixture').components
    show(one, small_camera, 12, somebody_at(12), somebody_at(50))
    assert listed(outputs) == [['p1', 'p2']] * 3 + [['p1']] * 2 + [['p1', 'p3']]
    for i in range(13, 17):
        show(one, small_camera, i)
    assert listed(outputs)[-1] == []
    assert one.state.status == 'nobody'


def test_the_largest_are_followed_and_the_others_are_told_once(session, outputs, small_camera):
    one = started(session(max_people=2), small_camera)
    crowd = [somebody_at(3 * i, scale=1.0 + 0.05 * i) for i in range(20)]
    (text,) = [x for x in show(one, small_camera, 0, *crowd) if 'max_people' in x]
    assert text.startswith('20 people are detected in the image of 17000')
    assert 'max_people is 2: the others are not followed' in text
    assert not any('max_people' in x for x in show(one, small_camera, 1, *crowd))
    assert len(StubTracker.made) == 2
    # Detections too near to the largest one may be the same person.
    assert {round(x.pose[0] * 60 / x.pose[2] + 31.5) for x in StubTracker.made} == {57, 45}


@pytest.mark.parametrize(
    ('people', 'text'),
    [
        ([somebody_at(15, 'x'), somebody_at(50, 'x')], "the id 'x' twice, wanted each id once"),
        ([somebody_at(15), somebody_at(50, names=('left_hip', 'tail', 'nostril', *NAMES[3:]))],
         "keypoints ['nostril', 'tail'] are not used"),
    ],
)  # fmt: skip
def test_bad_people_are_told_once(session, outputs, small_camera, people, text):
    one = started(session(), small_camera)
    assert sum(text in x for x in show(one, small_camera, 0, *people)) == 1
    assert sum(text in x for x in show(one, small_camera, 1, *people)) == 0
    assert len(one.state.people) == 2


def test_messages_that_contradict_themselves_are_no_detections(session, small_camera):
    one = started(session(), small_camera)
    message = seen(small_camera, 0, somebody_at(15))
    message.ids.append('b')
    (fault,) = one.take(DETECTIONS, message).faults
    assert 'people: 2 ids with 1 keypoints, wanted 2 or none' in fault
    assert one.take(IMAGE, small_camera.image(0)).faults == ()
    assert StubTracker.made == []


def test_detections_without_an_image_and_images_without_detections(session, small_camera):
    one = started(session(), small_camera)
    show(one, small_camera, 0, somebody_at(15))
    one.take(DETECTIONS, seen(small_camera, 0.5, somebody_at(15)))
    told = show(one, small_camera, 1, somebody_at(15))
    assert [x for x in told if 'no image with this stamp waits' in x]
    # The image of 2 waits for its detections, until those of 3 come.
    assert one.take(IMAGE, small_camera.image(2)).published == ()
    told = show(one, small_camera, 3, somebody_at(15))
    assert [x for x in told if 'no detections came for the image' in x]
    assert one.state.counts['tracked'] == 4


def test_boxes_start_tracks(session, monkeypatch, small_camera):
    boxes = []
    monkeypatch.setattr(Follower, 'reset', lambda self, start=None, box=None: boxes.append(box))
    one = started(session(source='boxes'), small_camera)

    def box(name, column, kind):
        position = SimpleNamespace(x=column, y=20.0)
        hypothesis = SimpleNamespace(hypothesis=SimpleNamespace(class_id=kind))
        return SimpleNamespace(
            id=name, results=[hypothesis],
            bbox=SimpleNamespace(
                center=SimpleNamespace(position=position), size_x=8.0, size_y=60.0
            ),
        )  # fmt: skip

    header = header_message(small_camera.messages, small_camera.stamp(0), 'lens')
    detections = [box('1', 20.0, 'person'), box('2', 40.0, 'dog')]
    one.take(DETECTIONS, SimpleNamespace(header=header, detections=detections))
    one.take(IMAGE, small_camera.image(0))
    assert boxes == [(16, 0, 24, 48)]
    detections[0].bbox.size_x = 0.0
    header = header_message(small_camera.messages, small_camera.stamp(1), 'lens')
    (fault,) = one.take(DETECTIONS, SimpleNamespace(header=header, detections=detections)).faults
    assert 'wanted a box within 1e+06 px' in fault


def test_an_empty_scene_is_learned_until_somebody_comes(session, small_camera):
    one = started(session(), small_camera)
    for i in range(6):
        show(one, small_camera, i)
    show(one, small_camera, 6, somebody_at(15))
    show(one, small_camera, 7, somebody_at(15))
    assert StubTracker.made[0].silhouettes.background.frames == 6


def test_a_jump_back_and_a_reset_begin_anew(session, outputs, small_camera):
    one = started(session(reset_on_time_jump=True), small_camera)
    for i in (5, 6, 1, 2, 3):
        show(one, small_camera, i, somebody_at(15), somebody_at(50))
    assert listed(outputs) == [['p1', 'p2']] * 5
    assert len(StubTracker.made) == 4
    one.restart()
    assert one.state.people == ()


@pytest.mark.parametrize(
    ('values', 'text'),
    [
        ({'source': 'openpose'}, "source must be one of ('people', 'yolo', 'boxes', 'floats')"),
        ({'keypoint_scheme': 'coco'}, "saw 'coco'"),
        ({'use_predictions': True}, 'people_node takes no input of one person'),
        ({'subject_file': 'x.yaml'}, "subject_file is 'x.yaml'"),
    ],
)
def test_parameters_of_one_person_are_refused(values, text):
    with pytest.raises(ValueError, match=r'.') as error:
        with_values(PeopleParameters(), values)
    assert text in str(error.value)


def test_a_moved_camera_is_told_once_for_all(session, small_camera, tmp_path):
    wall = np.full((48, 64, 3), 90, np.uint8)
    wall[:, 40:] = 160
    wall[30:, :] = 40
    file = tmp_path / 'background.png'
    assert cv2.imwrite(str(file), wall)
    one, told = started(session(background_file=str(file)), small_camera), []
    small_camera.picture = lambda index, size=None: np.roll(wall, 8, axis=1)
    for index in range(30):
        people = [somebody_at(15), somebody_at(50)]
        told += [x for x in show(one, small_camera, index, *people) if 'camera has moved' in x]
    assert len(told) == 1
    assert one.state.trouble() == 'the camera has moved since the background was taken'


def test_parameters_that_change_reach_those_who_are_followed(session, outputs, small_camera):
    one = started(session(keep_out_probability=0.5), small_camera)
    for index, values in enumerate(({}, {'keep_out_probability': 0.9, 'publish_tf': False})):
        one.parameters = with_values(one.parameters, values)
        outputs.clear()
        show(one, small_camera, index, somebody_at(15))
        topics = {output.topic: output.data for output in outputs}
        assert ('/tf' in topics) == (index == 0)
        told = keep_out_of(deserialise(topics['humans/bodies/p1/keep_out'], KEEP_OUT))
        assert told.probability == (0.5, 0.9)[index]
