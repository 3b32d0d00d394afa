"""Topics between nodes of one process, without ROS."""

from dataclasses import dataclass, field

import pytest

from hmt_ros.nodes.local_topics import LARGE, SHARED, Listener, LocalTopics
from msg_tools.messages.cdr import serialise
from msg_tools.messages.images import ImageError


@dataclass
class Node:
    """Whoever listens: what came, and the subscriptions that were made."""

    local: LocalTopics
    came: list[bytes] = field(default_factory=list)
    made: int = 0

    def listen(self, topic):
        def connect():
            self.made += 1
            return f'subscription {self.made}'

        self.listener = Listener(topic, self.came.append, connect)
        self.local.listen(self.listener)
        return self


def test_what_a_node_publishes_the_others_get_as_it_is():
    local = LocalTopics()
    local.offer('/a')
    one, other = Node(local).listen('/a'), Node(local).listen('/b')
    data = b'as it is'
    local.deliver('/a', data)
    local.deliver('/c', b'nobody listens')
    assert one.came == [data]
    assert one.came[0] is data
    assert other.came == []
    assert local.listeners('/a') == 1
    # No message comes a second time, by way of the middleware.
    assert (one.made, other.made) == (0, 1)


def test_what_comes_from_other_processes_comes_in_once():
    local = LocalTopics()
    nodes = [Node(local).listen('/image') for _ in range(3)]
    assert [node.made for node in nodes] == [1, 0, 0]
    local.deliver('/image', b'x')
    assert [node.came for node in nodes] == [[b'x']] * 3


def test_who_leaves_hands_the_subscription_on():
    local = LocalTopics()
    first, second, third = (Node(local).listen('/image') for _ in range(3))
    assert local.leave(second.listener) is None
    assert local.leave(first.listener) == 'subscription 1'
    assert third.listener.subscription == 'subscription 1'
    assert third.made == 1
    local.deliver('/image', b'x')
    assert (first.came, second.came, third.came) == ([], [], [b'x'])
    assert local.leave(third.listener) == 'subscription 1'
    assert local.listeners('/image') == 0
    # Whoever comes then subscribes anew.
    assert Node(local).listen('/image').made == 1


def test_what_several_read_is_read_and_decoded_once(small_camera):
    local, other = LocalTopics(), LocalTopics()
    data = serialise(small_camera.image(0))
    kind = 'sensor_msgs/msg/Image'
    assert len(data) < LARGE
    assert local.read(data, kind) is not local.read(data, kind)
    large = serialise(small_camera.image(1, (640, 480)))
    message = local.read(large, kind)
    assert local.read(large, kind) is message
    assert local.read(bytes(bytearray(large)), kind) is not message
    assert other.read(large, kind) is not message
    image = local.decode(message)
    assert local.decode(message) is image
    assert image.shape == (480, 640, 3)
    # What comes later takes the place of what was shared.
    for _ in range(SHARED):
        local.read(bytes(bytearray(large)), kind)
    assert local.read(large, kind) is not message
    broken = small_camera.image(0)
    broken.encoding = 'infrared'
    with pytest.raises(ImageError, match='infrared'):
        local.decode(broken)
