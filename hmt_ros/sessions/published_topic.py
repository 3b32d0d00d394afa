"""A topic that a node publishes, by which bags and nodes are made alike."""

from __future__ import annotations

from typing import NamedTuple

# What diagnostics say before the name of a topic: how many are connected to its publisher.
SUBSCRIBERS = 'subscribers of '


class PublishedTopic(NamedTuple):
    """A topic of a node.

    Attributes:
        msgtype: for example 'hmt_msgs/msg/PoseMixture'.
        latched: late subscribers get the last message.
    """

    msgtype: str
    latched: bool = False
