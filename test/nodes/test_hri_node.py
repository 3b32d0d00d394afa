"""The node for REP 155, over DDS, if hri_msgs is installed."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from hmt_ros.sessions.hri_parameters import HriParameters
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)

pytestmark = pytest.mark.ros
TOPIC = '/humans/bodies/p1/pose_mixture'


@pytest.fixture
def installed():
    if find_spec('hri_msgs') is None:
        pytest.skip('package hri_msgs is not installed')


def mixture(likelihoods, index, track=1, state=TrackState.TRACKING):
    body, modes = likelihoods.body, likelihoods.mixture(index)
    means = modes.means.copy()
    means[:, :2] = 0.0
    modes = type(modes)(modes.weights, means, modes.covariances)
    nobody = state is TrackState.NOBODY
    content = PoseMixture.of_body(
        body,
        None if nobody else modes,
        MixtureKind.POSTERIOR,
        likelihoods.stamp(index),
        'lens',
        state=state,
        track_id=track,
    )
    return pose_mixture_message(likelihoods.messages, content)


def test_people_come_and_go(installed, world_of, small_camera, likelihoods):
    from hmt_msgs.msg import PoseMixture as PoseMixtureMessage
    from hri_msgs.msg import IdsList, NormalizedRegionOfInterest2D, Skeleton2D
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import CameraInfo, Image, JointState
    from std_msgs.msg import String
    from tf2_msgs.msg import TFMessage

    from hmt_ros.nodes.hri_node import HriNode

    inputs = {'camera_info': CameraInfo, 'image': Image}
    one = world_of(HriNode, 'hri_node', inputs)
    one.start()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    ids, frames = [], []
    one.listen(IdsList, '/humans/bodies/tracked', ids, latched)
    one.listen(TFMessage, '/tf', frames)
    one.send('camera_info', small_camera.info(0))
    # An unannounced person appears.
    one.publishers[TOPIC] = one.other.create_publisher(PoseMixtureMessage, TOPIC, 100)
    one.spin_until(one.publishers[TOPIC].get_subscription_count, 'a subscription')
    source = f'pose_mixture of {TOPIC.rpartition("/")[0]}'
    one.send(source, mixture(likelihoods, 0), TOPIC)
    one.spin_until(lambda: ids and list(ids[-1].ids) == ['p1_1'])
    found = {}
    kinds = {
        'roi': NormalizedRegionOfInterest2D,
        'skeleton2d': Skeleton2D,
        'cropped': Image,
        'joint_states': JointState,
        'urdf': String,
    }
    for name, kind in kinds.items():
        found[name] = []
        qos = latched if name == 'urdf' else 100
        one.listen(kind, f'/humans/bodies/p1_1/{name}', found[name], qos)
    one.spin_until(lambda: all(one.is_heard(f'/humans/bodies/p1_1/{name}') for name in kinds))
    one.send('image', small_camera.image(1))
    one.send(source, mixture(likelihoods, 1), TOPIC)
    one.spin_until(lambda: all(found.values()), 'all topics of a body')
    assert 0 < found['roi'][0].xmin < found['roi'][0].xmax < 1
    assert len(found['skeleton2d'][0].skeleton) == 18
    assert found['cropped'][0].encoding == 'bgr8'
    assert 'waist_p1_1' in found['joint_states'][0].name
    urdf = found['urdf'][0].data
    assert urdf.startswith('<robot name="human_p1_1">')
    assert one.node.get_parameter('human_description_p1_1').value == urdf
    one.spin_until(lambda: len(frames) >= 1)
    assert frames[-1].transforms[0].child_frame_id == 'body_p1_1'
    _, text, values = one.diagnosis()
    assert text == 'tracking, 1 bodies'
    assert values['bodies'] == 'p1_1'
    assert values['mixtures converted'] == '2'

    # Another track is another body; the topics of the first one disappear.
    one.send(source, mixture(likelihoods, 2, track=2), TOPIC)
    one.spin_until(lambda: list(ids[-1].ids) == ['p1_2'])
    one.spin_until(lambda: one.other.count_publishers('/humans/bodies/p1_1/roi') == 0)
    assert not one.node.has_parameter('human_description_p1_1')
    one.send(source, mixture(likelihoods, 3, 2, TrackState.NOBODY), TOPIC)
    one.spin_until(lambda: not len(ids[-1].ids))
    assert one.change_state('deactivate')
    assert one.change_state('activate')
    one.spin_until(one.publishers[TOPIC].get_subscription_count, 'a subscription')
    one.send(source, mixture(likelihoods, 4, 3), TOPIC)
    one.spin_until(lambda: list(ids[-1].ids) == ['p1_3'])
    # Deactivating the node removes all bodies.
    assert one.change_state('deactivate')
    one.spin_until(lambda: not len(ids[-1].ids))
    assert one.change_state('cleanup')
    assert one.node._of_bodies == {}
    assert not one.node.has_parameter('human_description_p1_3')
    one.assert_described(HriParameters())


@pytest.fixture
def without_hri(monkeypatch):
    """A node that publishes nothing, and needs no hri_msgs."""
    from hmt_ros.nodes import hri_node

    monkeypatch.setattr(hri_node.HriSession, 'TOPICS', {})
    monkeypatch.setattr(hri_node.HriNode, '_messages_of_others', lambda *_: {})
    return hri_node


def test_a_person_is_subscribed_to_once(without_hri, world_of, monkeypatch):
    from hmt_msgs.msg import PoseMixture as PoseMixtureMessage
    from sensor_msgs.msg import CameraInfo

    monkeypatch.setattr(without_hri, '_MAX_TOPICS', 3)
    inputs = {'camera_info': CameraInfo}
    one = world_of(without_hri.HriNode, 'hri_node', inputs, publish_cropped=False).start()
    first = one.other.create_publisher(PoseMixtureMessage, TOPIC, 100)
    one.spin_until(first.get_subscription_count, 'a subscription')
    # A later person is found by a later search, which finds the first person again.
    later = one.other.create_publisher(PoseMixtureMessage, TOPIC.replace('p1', 'p2'), 100)
    one.spin_until(later.get_subscription_count, 'a subscription')
    assert one.other.count_subscribers(TOPIC) == 1
    one.other.destroy_publisher(first)
    one.spin_until(lambda: one.other.count_subscribers(TOPIC) == 0, 'an end')
    assert one.other.count_subscribers(TOPIC.replace('p1', 'p2')) == 1
    assert one.warnings() == []


def test_a_package_that_is_not_installed_is_told(world_of):
    if find_spec('hri_msgs') is not None:
        pytest.skip('package hri_msgs is installed')
    from hmt_ros.nodes.hri_node import HriNode

    one = world_of(HriNode, 'hri_node', {})
    one.node.start()
    (text,) = one.errors()
    assert 'hri_node needs hri_msgs/IdsList, but the package hri_msgs is not installed' in text
