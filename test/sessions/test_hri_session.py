"""The HRI session: mixtures become bodies of REP 155."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import Camera
from hmt_ros.body.reference_human import REFERENCE_JOINTS
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.sessions import hri_session
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.hri_parameters import HriParameters
from hmt_ros.sessions.hri_session import (
    FRAMES,
    TRACKED,
    HriSession,
    body_topic,
    mixture_source,
    published_topic,
)
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.detections import person_of_skeleton
from msg_tools.messages.images import decode_image
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)

pytestmark = pytest.mark.usefixtures('hri_msgs')

P1, P2 = mixture_source('/humans/bodies/p1'), mixture_source('/humans/bodies/p2')
CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


@pytest.fixture
def session(outputs):
    def make(**values):
        parameters = with_values(HriParameters(), values)
        return HriSession(parameters, outputs.append)

    return make


@pytest.fixture
def people(likelihoods):
    """Makes mixtures of a track with two modes; the second bends an elbow more."""

    def make(
        index, track=1, state=TrackState.TRACKING, weights=(0.6, 0.4), at=(0.0, 0.0), **fields
    ):
        mixture, body = likelihoods.mixture(index), likelihoods.body
        means = mixture.means.copy()
        means[:, :2] = at
        mixture = type(mixture)(np.array(weights), means, mixture.covariances)
        content = PoseMixture.of_body(
            body,
            None if state is TrackState.NOBODY else mixture,
            MixtureKind.POSTERIOR,
            likelihoods.stamp(index),
            'lens',
            state=state,
            track_id=track,
            identities=None if state is TrackState.NOBODY else np.array([7, 8], dtype=np.uint32),
            **fields,
        )
        return pose_mixture_message(likelihoods.messages, content)

    return make


def read(outputs, topic):
    kind = published_topic(topic).msgtype
    return [deserialise(output.data, kind) for output in outputs if output.topic == topic]


def tracked(outputs):
    return [message.ids for message in read(outputs, TRACKED)]


def test_a_body_is_a_track(session, outputs, people, small_camera):
    one = session()
    assert one.state.wants == 'a calibrated camera_info'
    one.take(CAMERA_INFO, small_camera.info(0))
    assert one.state.wants == 'a pose mixture'
    for index, (track, state) in enumerate(
        [
            (1, TrackState.TRACKING),
            (1, TrackState.LOST),
            (1, TrackState.TRACKING),
            (1, TrackState.NOBODY),
            (2, TrackState.UNKNOWN),
        ]
    ):
        one.take(P1, people(index, track, state))
    assert tracked(outputs) == [['p1_1'], [], ['p1_1'], [], ['p1_2']]
    assert one.state.counts == {'received': 5, 'converted': 5}
    assert (one.state.status, one.state.bodies) == ('tracking', ('p1_2',))
    assert one.identities == {'p1_2'}
    # Lost tracks are not shown.
    stamps = [o.stamp_ns for o in outputs if o.topic == body_topic('p1_1', 'joint_states')]
    assert stamps == [small_camera.stamp(i) for i in (0, 2)]


def test_tracks_without_a_number_are_counted(session, outputs, people):
    one = session()
    states = [TrackState.UNKNOWN, TrackState.UNKNOWN, TrackState.NOBODY, TrackState.UNKNOWN]
    for index, state in enumerate(states):
        one.take(mixture_source('/'), people(index, 0, state))
    assert tracked(outputs) == [['body_1'], ['body_1'], [], ['body_2']]


def test_no_identity_is_used_twice(session, outputs, people):
    """A restarted filter counts its tracks from 1 again."""
    one = session()
    one.take(P1, people(0, 3))
    one.take(P1, people(1, 3, TrackState.NOBODY))
    one.take(P1, people(2, 1))
    one.take(P1, people(3, 1))
    one.take(P1, people(4, 2))
    assert tracked(outputs) == [['p1_3'], [], ['p1_4'], ['p1_4'], ['p1_5']]


def test_people_who_are_gone_are_forgotten(session, outputs, people, monkeypatch):
    monkeypatch.setattr(hri_session, '_MAX_REMEMBERED_PEOPLE', 3)
    one = session()
    one.take(P1, people(0))
    gone = people(0, 1, TrackState.NOBODY)
    for number in range(10):
        one.take(mixture_source(f'/humans/bodies/n{number}'), gone)
    assert len(one._people) == 4
    assert one.identities == {'p1_1'}


def test_who_is_silent_is_not_tracked(session, outputs, people, small_camera, monkeypatch):
    monkeypatch.setattr(hri_session, 'MAX_SILENCE', 0.5)
    one = session()
    one.take(CAMERA_INFO, small_camera.info(0))
    one.take(P1, people(0))
    one.take(CAMERA_INFO, small_camera.info(5))
    assert tracked(outputs) == [['p1_1']]
    one.take(CAMERA_INFO, small_camera.info(6))
    assert tracked(outputs) == [['p1_1'], []]
    assert one.identities == set()


def test_joint_states_and_frames_are_those_of_the_urdf(session, outputs, people, likelihoods):
    one = session()
    one.take(P1, people(3))
    one.take(P1, people(4))
    (urdf,) = read(outputs, body_topic('p1_1', 'urdf'))
    _, states = read(outputs, body_topic('p1_1', 'joint_states'))
    _, frames = read(outputs, FRAMES)
    assert {f'{name}_p1_1' for name in REFERENCE_JOINTS} < set(states.name)
    angles = dict(zip(states.name, states.position, strict=True))
    # Forward kinematics from the URDF alone, as in robot_state_publisher.
    robot = ET.fromstring(urdf.data)
    assert robot.find("link[@name='body_p1_1']") is not None
    root = frames.transforms[0]
    assert (root.header.frame_id, root.child_frame_id) == ('lens', 'body_p1_1')
    placed = {'body_p1_1': matrix(root.transform)}
    for joint in robot.iter('joint'):
        step = np.eye(4)
        step[:3, 3] = [float(x) for x in joint.find('origin').attrib['xyz'].split()]
        if joint.attrib['type'] == 'revolute':
            axis = np.array([float(x) for x in joint.find('axis').attrib['xyz'].split()])
            step[:3, :3] = Rotation.from_rotvec(axis * angles[joint.attrib['name']]).as_matrix()
            assert abs(angles[joint.attrib['name']]) <= float(joint.find('limit').attrib['upper'])
        parent = joint.find('parent').attrib['link']
        placed[joint.find('child').attrib['link']] = placed[parent] @ step
    for each in frames.transforms[1:]:
        assert each.header.frame_id == 'body_p1_1'
        np.testing.assert_allclose(
            placed['body_p1_1'] @ matrix(each.transform), placed[each.child_frame_id], atol=1e-9
        )
    assert len(frames.transforms) == len(placed)
    # The links pass through the joints of the heaviest mode.
    body = likelihoods.body
    pose = likelihoods.mixture(4).means[0].copy()
    pose[:2] = 0.0
    places = dict(zip(body.joint_names, body.joint_positions(pose[None])[0], strict=True))
    for link, joint in (('r_ankle', 'right_ankle'), ('l_wrist', 'left_wrist'), ('head', 'head')):
        np.testing.assert_allclose(placed[f'{link}_p1_1'][:3, 3], places[joint], atol=1e-3)


def matrix(transform):
    result = np.eye(4)
    q, t = transform.rotation, transform.translation
    result[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    result[:3, 3] = t.x, t.y, t.z
    return result


def test_frames_for_a_robot_state_publisher(session, outputs, people):
    one = session(publish_links=False, added_joints=False)
    one.take(P1, people(0))
    (frames,) = read(outputs, FRAMES)
    assert [each.child_frame_id for each in frames.transforms] == ['body_p1_1']
    (states,) = read(outputs, body_topic('p1_1', 'joint_states'))
    assert sorted(states.name) == sorted(f'{name}_p1_1' for name in REFERENCE_JOINTS)


def test_a_person_who_grows_is_described_anew(session, outputs, people, likelihoods):
    one = session()
    body = likelihoods.body
    for index, thigh in enumerate((0.415, 0.418, 0.45)):
        grown = body.with_segment_lengths({'thigh': thigh})
        joints = grown.joint_positions(likelihoods.mixture(0).means)
        one.take(P1, people(index, joint_positions=joints))
    stamps = [o.stamp_ns for o in outputs if o.topic.endswith('/urdf')]
    assert stamps == [likelihoods.stamp(i) for i in (0, 2)]


def test_region_and_landmarks(session, outputs, people, small_camera, likelihoods):
    one = session()
    one.take(P1, people(0))
    assert not any(o.topic.endswith(('roi', 'skeleton2d', 'cropped')) for o in outputs)
    one.take(CAMERA_INFO, small_camera.info(0))
    one.take(IMAGE, small_camera.image(1))
    one.take(P1, people(1))
    (region,) = read(outputs, body_topic('p1_1', 'roi'))
    assert 0 < region.xmin < region.xmax < 1
    assert 0 < region.ymin < region.ymax < 1
    # Both modes fill the same region: they differ by a bent elbow.
    assert region.c == pytest.approx(1.0)
    body, means = likelihoods.body, likelihoods.mixture(1).means.copy()
    means[:, :2] = 0.0
    joints = body.joint_positions(means)
    pixels = CAMERA.project(joints[0]) + 0.5
    assert (pixels.min(0) / (64, 48) > (region.xmin, region.ymin)).all()
    assert (pixels.max(0) / (64, 48) < (region.xmax, region.ymax)).all()
    # The adapter reads what the bridge writes.
    (message,) = read(outputs, body_topic('p1_1', 'skeleton2d'))
    keypoints = person_of_skeleton(message, 64, 48).keypoints
    names = schemes()['skeleton2d'].names
    at = dict(zip(names, keypoints.pixels, strict=True))
    sure = dict(zip(names, keypoints.confidences, strict=True))
    for name in ('left_wrist', 'right_knee', 'neck', 'right_hip'):
        joint = list(body.joint_names).index(name)
        np.testing.assert_allclose(at[name], CAMERA.project(joints[0, joint]), atol=1e-4)
        # A mode with another elbow angle has the wrist elsewhere.
        assert sure[name] == pytest.approx(0.6 if name == 'left_wrist' else 1.0)
    assert sure['left_eye'] == sure['right_eye'] == 0.0
    # A person at rest faces the camera: the left ear is on the right in the image.
    assert at['right_ear'][0] < at['nose'][0] < at['left_ear'][0]
    assert at['nose'][1] < at['neck'][1]
    (crop,) = read(outputs, body_topic('p1_1', 'cropped'))
    left, top = int(region.xmin * 64), int(region.ymin * 48)
    picture = small_camera.picture(1)[top : top + crop.height, left : left + crop.width]
    np.testing.assert_array_equal(decode_image(crop), picture)
    assert crop.width == int(np.ceil(region.xmax * 64)) - left
    assert crop.header == small_camera.image(1).header


def test_a_body_beyond_the_image_has_no_region(session, outputs, people, small_camera):
    one = session()
    one.take(CAMERA_INFO, small_camera.info(0))
    one.take(P1, people(0, at=(9.0, 0.0)))
    assert not any(o.topic.endswith(('roi', 'skeleton2d', 'cropped')) for o in outputs)
    assert tracked(outputs) == [['p1_1']]
    # Half a body at the border.
    one.take(P1, people(1, at=(2.1, 0.0)))
    (region,) = read(outputs, body_topic('p1_1', 'roi'))
    assert region.xmax == 1.0
    (message,) = read(outputs, body_topic('p1_1', 'skeleton2d'))
    points = np.array([(p.x, p.y, p.c) for p in message.skeleton])
    assert ((points[:, :2] >= 0) & (points[:, :2] <= 1)).all()
    assert (points[(points[:, :2] == 0).all(1), 2] == 0).all()
    assert 0 < (points[:, 2] > 0).sum() < 16


def test_a_mode_is_shown_as_long_as_it_counts(session, outputs, people):
    one = session()
    for index, weights in enumerate([(0.6, 0.4), (0.4, 0.6), (0.3, 0.7), (0.55, 0.45)]):
        one.take(P1, people(index, weights=weights))
    elbows = [
        dict(zip(m.name, m.position, strict=True))['l_elbow_p1_1']
        for m in read(outputs, body_topic('p1_1', 'joint_states'))
    ]
    # The first mode; the same although another is heavier; the second, as the first is too light;
    # and the second again.
    wanted = [0.5, 0.55, 0.6 + 0.8, 0.65 + 0.8]
    np.testing.assert_allclose(elbows, wanted, atol=1e-3)


def test_what_can_not_be_used_is_told(session, outputs, people, small_camera):
    one = session()
    one.take(CAMERA_INFO, small_camera.uncalibrated())
    assert one.state.faults['camera_info'] == 1
    one.take(P1, people(1))
    (fault,) = one.take(P1, people(1)).faults
    assert 'wanted stamps that increase' in fault
    (fault,) = one.take(P1, people(0)).faults
    assert 'with reset_on_time_jump every body would start again' in fault
    broken = people(2)
    broken.joint_names = [f'x_{name}' for name in broken.joint_names]
    (fault,) = one.take(P1, broken).faults
    assert 'shows no body: joint positions of pelvis' in fault
    assert tracked(outputs) == [['p1_1'], []]
    broken = people(3)
    broken.components[0].weight = 2.0
    assert one.take(P1, broken).faults
    assert one.state.counts == {'received': 5, 'converted': 1, 'skipped': 4}


def test_the_same_messages_give_the_same_bytes(session, outputs, people, small_camera):
    for _ in range(2):
        one = session()
        one.take(CAMERA_INFO, small_camera.info(0))
        for index in range(3):
            one.take(IMAGE, small_camera.image(index))
            one.take(P1, people(index))
    half = len(outputs) // 2
    assert half == 3 + 1 + 3 * 5
    assert outputs[:half] == outputs[half:]


def test_parameters():
    assert HriParameters(namespaces='/a /b/c /a').named == ('/a', '/b/c')
    with pytest.raises(ValueError, match=r"wanted names such as .* saw 'p1'"):
        HriParameters(namespaces='/a p1')
    with pytest.raises(ValueError, match=r"mixture_topic must be one of .* saw 'x'"):
        HriParameters(mixture_topic='x')


@pytest.mark.parametrize('far', [36_000, -36_000])
def test_stray_stamps_change_nothing(session, outputs, people, small_camera, far):
    for strays in (False, True):
        one = session()
        one.take(CAMERA_INFO, small_camera.info(0))
        for index in range(6):
            if strays and index in (2, 4):
                one.take(CAMERA_INFO, small_camera.info(index + far))
                one.take(P1, people(index + far))
            one.take(CAMERA_INFO, small_camera.info(index))
            one.take(P1, people(index))
    half = len(outputs) // 2
    assert half > 6
    assert outputs[:half] == outputs[half:]
    assert one.state.faults['stray stamp'] == 2
