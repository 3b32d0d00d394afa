"""What became of a message: what sessions tell of each, and what they count over all of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, NamedTuple

from msg_tools import MessageFactory
from msg_tools.files.error_line import one_line
from msg_tools.messages.headers import time_message, time_ns

HANDLED = 'hmt_msgs/msg/Handled'


class Output(NamedTuple):
    """A message that is to be published.

    Attributes:
        topic: one of those that the node publishes.
        stamp_ns: of the image that it is about.
        data: CDR bytes.
    """

    topic: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Handled:
    """What became of a message.

    Attributes:
        source: where it came from.
        stamp_ns: of the message.
        faults: why it, or something that waited for it, could not be used; empty: all was well.
        warnings: what a person should be told: the first fault of each kind, an estimate that
            starts anew.
        published: (topic, stamp) of all messages that were published, in their order.
    """

    source: str
    stamp_ns: int
    faults: tuple[str, ...]
    warnings: tuple[str, ...]
    published: tuple[tuple[str, int], ...]


class HandlingLog:
    """Collects what is to be told of the message that is being handled, and counts.

    Attributes:
        counts: number of the messages that are estimated from, over all of them: 'received', and of
            these 'skipped', 'dropped' and whatever the owner counts.
        faults: number by kind, over all messages.
        last_fault: the newest; '' before the first.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.last_fault = ''
        self.begin()

    def begin(self) -> None:
        """The next message is being handled."""
        self._told: list[str] = []
        self._warned: list[str] = []
        self._published: list[tuple[str, int]] = []

    def fault(self, kind: str, text: str) -> None:
        """Something could not be used."""
        self._told.append(one_line(text))
        self.note(kind, text)

    def note(self, kind: str, text: str) -> None:
        """A warning about the first of a kind; the others are counted."""
        self.faults[kind] += 1
        self.last_fault = one_line(text)
        if self.faults[kind] == 1:
            self._warned.append(self.last_fault)

    def skip(self, kind: str, text: str) -> None:
        """A message that would be estimated from can not be used."""
        self.counts['skipped'] += 1
        self.fault(kind, text)

    def count_dropped(self, messages: int) -> None:
        """Counts messages that were dropped before they came here."""
        self.counts['received'] += messages
        self.counts['dropped'] += messages

    def published(self, topic: str, stamp_ns: int) -> None:
        """A message was published."""
        self._published.append((topic, stamp_ns))

    def handled(self, source: str, stamp_ns: int) -> Handled:
        """What became of the message."""
        return Handled(
            source, stamp_ns, tuple(self._told), tuple(self._warned), tuple(self._published)
        )


def handled_message(messages: MessageFactory, handled: Handled) -> Any:
    """hmt_msgs/Handled, which a node publishes on `~/handled`."""
    return messages.create(
        HANDLED,
        source=handled.source,
        stamp=time_message(messages, handled.stamp_ns),
        faults=list(handled.faults),
        warnings=list(handled.warnings),
        published_topics=[topic for topic, _ in handled.published],
        published_stamps=[time_message(messages, stamp) for _, stamp in handled.published],
    )


def handled_of(message: Any) -> Handled:
    """The content of an hmt_msgs/Handled, of `rosbags` or of ROS."""
    published = zip(message.published_topics, message.published_stamps, strict=True)
    return Handled(
        source=str(message.source),
        stamp_ns=time_ns(message.stamp),
        faults=tuple(map(str, message.faults)),
        warnings=tuple(map(str, message.warnings)),
        published=tuple((str(topic), time_ns(stamp)) for topic, stamp in published),
    )
