"""Topics of the nodes: subscriptions, and the quality of service of publications."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.image_inputs import DETECTIONS, MAX_MESSAGE_BYTES, ImageInput
from hmt_ros.sessions.session import PublishedTopic
from hmt_ros.sessions.transform_buffer import TF, TF_STATIC, TRANSFORMS_TYPE
from msg_tools.messages.images import MAX_PIXELS
from msg_tools.messages.message_types import register_definitions
from msg_tools.messages.pose_mixtures import POSE_MIXTURE

RELIABLE_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# A client of `~/handled` that waits for each report must not miss any in a burst of reports: one
# turn of the estimating thread reports up to 100 dropped messages and all waiting messages.
HANDLED_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


# Maximum size of an accepted image, bytes.
MAX_IMAGE_BYTES = 8 * MAX_PIXELS + 2**16
# Maximum numbers of messages that wait during an estimate: small messages, messages as large as
# images, and transforms of a whole robot.
SMALL_QUEUE, LARGE_QUEUE, TF_QUEUE = 100, 20, 2000


class SubscribedTopic(NamedTuple):
    """A subscribed topic.

    Attributes:
        source: name of the topic in the session.
        topic: name of the topic in ROS.
        msgtype: message type, for example 'sensor_msgs/msg/Image'.
        qos: quality of service of the subscription.
        largest: maximum size of an accepted message, bytes.
        waiting: maximum number of messages that wait during an estimate.
    """

    source: str
    topic: str
    msgtype: str
    qos: QoSProfile = qos_profile_sensor_data
    largest: int = MAX_MESSAGE_BYTES
    waiting: int = SMALL_QUEUE


# The same QoS as in the listener of tf2.
_TF_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
_TF_STATIC_QOS = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
TRANSFORM_TOPICS = (
    SubscribedTopic(TF_STATIC, '/tf_static', TRANSFORMS_TYPE, _TF_STATIC_QOS, waiting=TF_QUEUE),
    SubscribedTopic(TF, '/tf', TRANSFORMS_TYPE, _TF_QOS, waiting=TF_QUEUE),
)
# Deep enough for the mixtures that arrive while `~/smooth_window` runs for some seconds.
_MIXTURE_QOS = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
CAMERA_INFO_TOPIC = SubscribedTopic(CAMERA_INFO, 'camera_info', 'sensor_msgs/msg/CameraInfo')


def image_topic(image_transport: str) -> SubscribedTopic:
    """The image topic for a transport, 'raw' or 'compressed'."""
    topic, kind = ('image', 'Image')
    if image_transport == 'compressed':
        topic, kind = ('image/compressed', 'CompressedImage')
    return SubscribedTopic(IMAGE, topic, f'sensor_msgs/msg/{kind}', largest=MAX_IMAGE_BYTES)


def input_topics(rows: Iterable[ImageInput]) -> Iterator[SubscribedTopic]:
    """Topics of the inputs in `rows`, which accompany the images."""
    for row in rows:
        for source, msgtype in row.types.items():
            yield SubscribedTopic(
                source,
                source,
                msgtype,
                RELIABLE_QOS if row.reliable else qos_profile_sensor_data,
                row.largest,
                LARGE_QUEUE if row.pixels is not None else SMALL_QUEUE,
            )


def types_of_others(rows: Iterable[ImageInput], source: str) -> dict[str, str]:
    """Message types from other packages, each mapped to the `source` that needs it."""
    return {row.types[DETECTIONS]: f'source {source}' for row in rows if DETECTIONS in row.types}


def published_with(published: PublishedTopic) -> tuple[str, QoSProfile]:
    """Type and quality of service of a topic that a session publishes."""
    return published.msgtype, LATCHED_QOS if published.latched else RELIABLE_QOS


def mixture_topic(source: str, topic: str) -> SubscribedTopic:
    """Topic of a person's pose mixtures, with a queue for the messages of several seconds."""
    return SubscribedTopic(source, topic, POSE_MIXTURE, _MIXTURE_QOS)


def message_class(msgtype: str) -> Any:
    """The generated class of a message type."""
    package, _, name = msgtype.split('/')
    return getattr(import_module(f'{package}.msg'), name)


@cache
def opens_with_header(msgtype: str) -> bool:
    """Whether the first field of a message type is a std_msgs/Header."""
    first = next(iter(message_class(msgtype).get_fields_and_field_types().values()), '')
    return bool(first == 'std_msgs/Header')


def read_installed_messages(msgtype: str, needed_by: str) -> None:
    """Reads the message definitions of an installed package.

    Args:
        needed_by: feature that needs the messages, for the error message.

    Raises:
        ValueError: the package is not installed.
    """
    package = msgtype.partition('/')[0]
    try:
        message_class(msgtype)
        folder = Path(get_package_share_directory(package)) / 'msg'
    except (ImportError, AttributeError, PackageNotFoundError) as error:
        raise ValueError(
            f'{needed_by} needs {msgtype.replace("/msg/", "/")}, but the package {package} is '
            'not installed: install it, or build and source its workspace'
        ) from error
    register_definitions(package, folder)
