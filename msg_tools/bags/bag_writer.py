"""Writes messages into a bag that rosbag2 plays, as a whole or not at all.

Topics have absolute names, because rosbag2 compares names as they are written: a relative name is
in the namespace of the bag, as the one of a node is in the node's. Log time and publish time are
both the stamp that the caller gives. `msg_tools.bags.bag_folder` describes what happens to a bag
that is not completed.

    with BagWriter('out') as bag:
        bag.add_topic('body', 'hmt_msgs/msg/Body', latched=True)
        bag.write('body', stamp_ns, message)
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

from msg_tools.bags.bag_folder import BagFolder
from msg_tools.bags.bag_metadata import quality_of_service
from msg_tools.bags.contents import BagError, Channel, absolute_name, reason
from msg_tools.messages.cdr import serialise
from msg_tools.messages.message_types import typestore


class _Topic(NamedTuple):
    msgtype: str
    channel: int


class BagWriter(AbstractContextManager['BagWriter']):
    """A bag that is open for writing; a context manager, which closes it, or drops it on an error.

    Args:
        path: folder to write, `<name>`; the file in it is `<name>.mcap`.
        overwrite: replace a bag that is there. Anything else that is there is never touched.
        namespace: of the topics with relative names, '/humans/bodies/p1' for example.

    Raises:
        BagError: the folder exists, can not be created or written.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, overwrite: bool = False, namespace: str = ''
    ) -> None:
        self._folder = BagFolder(path, overwrite=overwrite)
        self.path = self._folder.path
        self._namespace = namespace
        self._topics: dict[str, _Topic] = {}

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def add_topic(self, name: str, msgtype: str, *, latched: bool = False) -> None:
        """Announces a topic; one that is written without is not latched.

        Args:
            name: of the topic, absolute or relative to the namespace.
            msgtype: for example 'hmt_msgs/msg/PoseMixture'.
            latched: offered as transient local, so that late subscribers get the last message.

        Raises:
            BagError: an unknown type, or the topic is there already.
        """
        store, name = typestore(), absolute_name(name, self._namespace)
        if msgtype not in store.fielddefs:
            raise BagError(f'{self.path}: topic {name} can not have the unknown type {msgtype!r}')
        if name in self._topics:
            raise BagError(f'{self.path}: topic {name} is there already')
        definition, _ = store.generate_msgdef(msgtype, ros_version=2)
        channel = self._folder.add_channel(
            Channel(name, msgtype, 'cdr', 'ros2msg', definition.encode()),
            quality_of_service(latched),
            store.hash_rihs01(msgtype),
        )
        self._topics[name] = _Topic(msgtype, channel)

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Writes a message of `typestore()`; announces its topic where that has not been done.

        Raises:
            BagError: the topic has another type, a field does not fit the type, the disk is full.
        """
        msgtype, topic = message.__msgtype__, absolute_name(topic, self._namespace)
        if topic not in self._topics:
            self.add_topic(topic, msgtype)
        if self._topics[topic].msgtype != msgtype:
            raise BagError(
                f'{self.path}: topic {topic} has type {self._topics[topic].msgtype}, not {msgtype}'
            )
        try:
            data = serialise(message)
        except Exception as error:
            # Generated code of the library, which does not say what it may raise for a wrong field.
            raise BagError(
                f'{self.path}: message of {topic} does not fit {msgtype}: {reason(error)}'
            ) from error
        self.write_serialised(topic, stamp_ns, data)

    def write_serialised(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Writes a message that is CDR bytes already, of a topic that has been announced.

        Raises:
            BagError: no such topic, a stamp before 1970, the disk is full.
        """
        topic = absolute_name(topic, self._namespace)
        known = self._topics.get(topic)
        if known is None:
            raise BagError(f'{self.path}: topic {topic} has not been added')
        if not 0 <= stamp_ns < 2**63:
            raise BagError(
                f'{self.path}: stamp {stamp_ns} ns of a message of {topic} is not a time'
            )
        self._folder.add_message(known.channel, stamp_ns, data, stamp_ns)

    def close(self) -> None:
        """Completes the bag and moves it to its place; does nothing when that has been done.

        Raises:
            BagError: the disk is full, or the place is taken meanwhile; nothing is left behind.
        """
        self._folder.close()

    def abort(self) -> None:
        """Drops everything that was written."""
        self._folder.abort()
