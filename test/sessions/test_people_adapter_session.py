"""People for other packages, whose messages are built here from their published fields."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.people_adapter_parameters import PeopleAdapterParameters
from hmt_ros.sessions.people_adapter_session import TOPICS, PeopleAdapterSession
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.message_types import register_definitions
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)

# people_msgs 1.4 and vision_msgs 4.1, as far as they are spoken here.
DEFINITIONS = {
    'people_msgs': {
        'Person': (
            'string name\ngeometry_msgs/Point position\ngeometry_msgs/Point velocity\n'
            'float64 reliability\nstring[] tagnames\nstring[] tags\n'
        ),
        'People': 'std_msgs/Header header\nPerson[] people\n',
    },
    'vision_msgs': {
        'ObjectHypothesis': 'string class_id\nfloat64 score\n',
        'ObjectHypothesisWithPose': (
            'ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
        ),
        'BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n',
        'Detection3D': (
            'std_msgs/Header header\nObjectHypothesisWithPose[] results\n'
            'BoundingBox3D bbox\nstring id\n'
        ),
        'Detection3DArray': 'std_msgs/Header header\nDetection3D[] detections\n',
    },
}
ANNA, BOB = '/lab/anna/pose_mixture', '/lab/bob/pose_mixture'


@pytest.fixture(scope='module', autouse=True)
def definitions(tmp_path_factory):
    for package, types in DEFINITIONS.items():
        folder = tmp_path_factory.mktemp(package)
        for name, text in types.items():
            (folder / f'{name}.msg').write_text(text)
        register_definitions(package, folder)


@pytest.fixture
def session(outputs):
    def make(**values):
        parameters = with_values(PeopleAdapterParameters(), values)
        return PeopleAdapterSession(parameters, outputs.append)

    return make


@pytest.fixture
def mixture(likelihoods):
    def make(index, state=TrackState.TRACKING, at=0.0, frame='lens', **fields):
        body, modes = likelihoods.body, likelihoods.mixture(index)
        means = modes.means.copy()
        means[:, 0] = [at, at + 1.0]
        velocities = np.zeros_like(means)
        velocities[:, 2] = -1.5
        content = PoseMixture.of_body(
            body,
            None
            if state is TrackState.NOBODY
            else type(modes)(modes.weights, means, modes.covariances),
            MixtureKind.POSTERIOR,
            likelihoods.stamp(index),
            frame,
            state=state,
            track_id=2,
            velocities=None if state is TrackState.NOBODY else velocities,
        )
        return pose_mixture_message(likelihoods.messages, content)

    return make


def read(outputs, topic):
    kind = TOPICS[topic].msgtype
    return [deserialise(output.data, kind) for output in outputs if output.topic == topic]


def names(outputs):
    people = [[person.name for person in message.people] for message in read(outputs, 'people')]
    boxes = [[each.id for each in message.detections] for message in read(outputs, 'detections')]
    assert people == boxes
    return people


def test_a_person_as_point_and_box(session, outputs, mixture, likelihoods):
    one = session()
    assert one.state.status == 'waiting'
    message = mixture(0)
    handled = one.take('pose_mixture', message)
    assert [topic for topic, _ in handled.published] == ['people', 'detections']
    (people,) = read(outputs, 'people')
    (person,) = people.people
    body = likelihoods.body
    joints = np.array([(p.x, p.y, p.z) for p in message.components[0].joint_positions])
    pelvis = joints[body.joint_names.index('pelvis')]
    assert (people.header.frame_id, person.name) == ('lens', 'person_2')
    assert people.header.stamp == message.header.stamp
    for point in (
        person.position,
        read(outputs, 'detections')[0].detections[0].results[0].pose.pose.position,
    ):
        np.testing.assert_allclose([point.x, point.y, point.z], pelvis, atol=1e-9)
    velocity = person.velocity
    np.testing.assert_allclose([velocity.x, velocity.y, velocity.z], [0.0, 0.0, -1.5], atol=1e-9)
    # The other mode is a metre away.
    assert person.reliability == pytest.approx(0.6)
    (found,) = read(outputs, 'detections')[0].detections
    (result,) = found.results
    assert (result.hypothesis.class_id, result.hypothesis.score) == ('person', person.reliability)
    centre, size = found.bbox.center.position, found.bbox.size
    middle = np.array([centre.x, centre.y, centre.z])
    assert (np.abs(joints - middle) < np.array([size.x, size.y, size.z]) / 2).all()
    assert 1.4 < size.y < 2.2
    covariance = result.pose.covariance.reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0
    # The modes are a metre apart along x.
    assert covariance[0, 0] > 0.4 > covariance[1, 1]
    q = result.pose.pose.orientation
    up = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()[:, 2]
    assert up @ [0.0, -1.0, 0.0] > 0.9
    assert (one.state.status, one.state.summary()) == ('seeing', '1 people')


def test_people_come_and_go(session, outputs, mixture):
    one = session(namespaces='/lab/anna /lab/bob', longest_silence=0.25)
    one.take(ANNA, mixture(0))
    one.take(BOB, mixture(0, at=-1.0))
    one.take(ANNA, mixture(1, state=TrackState.LOST))
    one.take(ANNA, mixture(2))
    one.take(BOB, mixture(2, state=TrackState.NOBODY))
    one.take(BOB, mixture(3))
    # Of anna nothing has been heard for 0.4 s.
    one.take(BOB, mixture(6))
    assert names(outputs) == [
        ['anna_2'],
        ['anna_2', 'bob_2'],
        ['bob_2'],
        ['anna_2', 'bob_2'],
        ['anna_2'],
        ['anna_2', 'bob_2'],
        ['bob_2'],
    ]
    assert one.state.counts == {'received': 7, 'converted': 7}


def test_frames_are_not_mixed(session, outputs, mixture):
    one = session()
    one.take(ANNA, mixture(0))
    one.take(BOB, mixture(0, frame='other'))
    assert names(outputs) == [['anna_2'], ['bob_2']]


def test_what_can_not_be_used_is_skipped(session, outputs, mixture):
    one = session()
    one.take(ANNA, mixture(1))
    assert one.take(ANNA, mixture(1)).faults
    strange = mixture(2)
    strange.body_model = 'centaur'
    (fault,) = one.take(ANNA, strange).faults
    assert 'centaur' in fault
    bare = mixture(3)
    for component in bare.components:
        component.covariance = np.empty(0)
    (fault,) = one.take(ANNA, bare).faults
    assert 'no covariances' in fault
    assert names(outputs) == [['anna_2']]
    with pytest.raises(ValueError, match='namespaces: wanted names such as'):
        session(namespaces='lab')


def test_only_what_somebody_wants_is_made(outputs, mixture):
    one = PeopleAdapterSession(
        PeopleAdapterParameters(), outputs.append, lambda topic: topic == 'people'
    )
    one.take(ANNA, mixture(0))
    assert [output.topic for output in outputs] == ['people']
