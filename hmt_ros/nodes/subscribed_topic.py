"""Topics that nodes subscribe to, and the quality of service of what they publish."""

from __future__ import annotations

from typing import NamedTuple

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from hmt_ros.sessions.camera_input import CAMERA_INFO, IMAGE
from msg_tools.messages.images import MAX_PIXELS

RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# Of `~/handled`: whoever counts on an answer to each message must not miss those to a burst.
ANSWERS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


# Bytes of a message: what is larger is no mixture of a person, or more pixels than are taken.
LARGEST_MESSAGE = 2**24
LARGEST_IMAGE = 8 * MAX_PIXELS + 2**16


class SubscribedTopic(NamedTuple):
    """A subscribed topic.

    Attributes:
        source: what the session calls it.
        topic: its name.
        kind: generated class.
        msgtype: for example 'sensor_msgs/msg/Image'.
        qos: of the subscription.
        largest: bytes of a message that is taken.
    """

    source: str
    topic: str
    kind: type
    msgtype: str
    qos: QoSProfile
    largest: int = LARGEST_MESSAGE


def camera_info_topic() -> SubscribedTopic:
    """The calibration of a camera."""
    kind = 'sensor_msgs/msg/CameraInfo'
    return SubscribedTopic(CAMERA_INFO, 'camera_info', CameraInfo, kind, qos_profile_sensor_data)


def image_topic(image_transport: str) -> SubscribedTopic:
    """The images of a camera, 'raw' or 'compressed'."""
    if image_transport == 'compressed':
        kind = 'sensor_msgs/msg/CompressedImage'
        return SubscribedTopic(
            IMAGE,
            'image/compressed',
            CompressedImage,
            kind,
            qos_profile_sensor_data,
            LARGEST_IMAGE,
        )
    kind = 'sensor_msgs/msg/Image'
    return SubscribedTopic(IMAGE, 'image', Image, kind, qos_profile_sensor_data, LARGEST_IMAGE)
