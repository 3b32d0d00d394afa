"""The keypoints node over DDS, with a stub detector and with MediaPipe."""

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from hmt_ros.detectors.registry import DETECTORS
from hmt_ros.sessions.keypoints_session import KeypointsParameters
from msg_tools import BagReader
from test.sessions.test_keypoints_session import STUB

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]
CLIP = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'video' / 'wander'


@pytest.fixture
def world(world_of):
    from sensor_msgs.msg import CompressedImage, Image

    from hmt_ros.nodes.keypoints_node import KeypointsNode

    def make(**values):
        inputs = {'image': Image}
        if values.get('image_transport') == 'compressed':
            inputs = {'image/compressed': CompressedImage}
        return world_of(KeypointsNode, 'keypoints_node', inputs, **values)

    return make


def listening(one):
    """Messages of all topics of the node, by topic."""
    from hmt_msgs.msg import Keypoints2D, Keypoints3D
    from sensor_msgs.msg import Image

    return one.hear({'keypoints': Keypoints2D, 'keypoints_3d': Keypoints3D, 'mask': Image})


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_images_become_keypoints(world, somebody, monkeypatch):
    monkeypatch.setitem(DETECTORS, 'mediapipe', STUB)
    one = world(publish_mask=True).start()
    found = listening(one)
    for message in (somebody.image(0), somebody.empty(1)):
        published = one.send('image', message).published
        assert [topic for topic, _ in published] == list(found)
    one.spin_until(lambda: all(len(messages) == 2 for messages in found.values()))
    assert [len(message.names) for message in found['keypoints']] == [33, 0]
    assert [len(message.x) for message in found['keypoints_3d']] == [33, 0]
    assert [any(message.data) for message in found['mask']] == [True, False]
    for messages in found.values():
        assert [stamp_of(message) for message in messages] == [somebody.stamp(i) for i in (0, 1)]
    level, text, values = one.diagnosis()
    assert (level, text) == (0, 'nobody, 0 landmarks')
    assert (values['images detected'], values['images without a person']) == ('2', '1')
    one.assert_described(KeypointsParameters())


def test_without_a_detector_one_line_says_what_to_do(world, monkeypatch):
    for name in ('ai_edge_litert', 'ai_edge_litert.interpreter'):
        monkeypatch.setitem(sys.modules, name, None)
    one = world()
    one.node.start()
    (text,) = one.errors()
    assert 'not installed' in text
    assert 'run "ros2 run hmt_ros install-detector"' in text


def test_mediapipe_pose_itself(world, mediapipe_pose):
    """In images of the topic it finds the same as MediaPipe when the clip was made."""
    if not CLIP.is_dir():
        pytest.skip(f'no development clip in {CLIP} (set HMT_SHARED)')
    with np.load(CLIP / 'keypoints_mediapipe.npz') as file:
        pixels, world_positions = file['pixels'], file['world']
    one = world(image_transport='compressed', publish_mask=True).start()
    found = listening(one)
    with BagReader(CLIP) as bag:
        for _, stored in zip(range(5), bag.messages(['image/compressed'])):
            assert one.send('image', stored.message, 'image/compressed').faults == ()
    one.spin_until(lambda: all(len(messages) == 5 for messages in found.values()))
    for index, message in enumerate(found['keypoints']):
        plane = np.stack([message.u, message.v], 1)
        assert np.median(abs(plane - pixels[index])) < 0.3
        np.testing.assert_allclose(plane, pixels[index], atol=2.0)
        lifted = found['keypoints_3d'][index]
        positions = np.stack([lifted.x, lifted.y, lifted.z], 1)
        np.testing.assert_allclose(positions, world_positions[index], atol=0.02)
    mask = np.array(found['mask'][0].data).reshape(480, 640)
    assert set(np.unique(mask)) == {0, 255}
    _, _, _, height = cv2.boundingRect(mask)
    seen = pixels[0]
    assert height == pytest.approx(np.ptp(seen[:, 1]), rel=0.3)
