"""Converts numpy arrays to ROS messages and back, reads and writes bags, makes markers and URDF.

This package does not need ROS: the message types are from `rosbags` and from the .msg files in
`hmt_msgs/`. Nodes use the same functions with the classes that ROS generates.
"""

from msg_tools.bags.bag_metadata import BagError
from msg_tools.bags.bag_reader import BagMessage, BagReader, Topic
from msg_tools.bags.bag_writer import BagWriter
from msg_tools.messages.message_error import MessageError
from msg_tools.messages.message_types import (
    GeneratedMessages,
    MessageFactory,
    RosbagsMessages,
    typestore,
)

__all__ = [
    'BagError',
    'BagMessage',
    'BagReader',
    'BagWriter',
    'GeneratedMessages',
    'MessageError',
    'MessageFactory',
    'RosbagsMessages',
    'Topic',
    'typestore',
]
