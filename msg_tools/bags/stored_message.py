"""What a file of a bag holds: channels, and messages that are still bytes."""

from __future__ import annotations

from typing import NamedTuple


class Channel(NamedTuple):
    """What a bag says about the messages of one topic.

    Attributes:
        topic: as written, with or without a leading slash.
        msgtype: as written; '' when the bag does not tell.
        encoding: 'cdr' for ROS 2.
        definition_encoding: 'ros2msg', 'ros2idl', or '' when there is no definition.
        definition: text of the message definition.
    """

    topic: str
    msgtype: str
    encoding: str
    definition_encoding: str
    definition: bytes


class StoredMessage(NamedTuple):
    """A message as it lies in the file."""

    channel: Channel
    data: memoryview
