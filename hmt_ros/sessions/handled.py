"""Reports of sessions: the outcome of each message, and counts over all messages.

Every fault or remark has a kind, which is a short name for the diagnostics.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from msg_tools import MessageFactory
from msg_tools.files.error_line import one_line
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_message, time_ns

HANDLED = 'hmt_msgs/msg/Handled'


@dataclass(frozen=True, eq=False)
class Output:
    """A message that is to be published.

    Attributes:
        topic: a topic that the node publishes.
        stamp_ns: stamp of the message, ns.
        message: message object, which receivers must not change.
    """

    topic: str
    stamp_ns: int
    message: Any

    @cached_property
    def data(self) -> bytes:
        """CDR bytes."""
        return serialise(self.message)

    def __iter__(self) -> Iterator[Any]:
        """Iterate over topic, stamp and bytes."""
        return iter((self.topic, self.stamp_ns, self.data))

    def __eq__(self, other: object) -> bool:
        """Whether topic, stamp and bytes are equal."""
        return isinstance(other, Output) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True)
class Handled:
    """Outcome of a message.

    Attributes:
        source: source of the message.
        stamp_ns: stamp of the message, ns.
        faults: faults of the message, or of a message that waited for it; empty if it was used.
        warnings: warnings for the log: the first fault of each kind.
        published: (topic, stamp) of all published messages, in the order of publication.
        events: events for the log of a node, for example the start of a track; not part of
            hmt_msgs/Handled.
    """

    source: str
    stamp_ns: int
    faults: tuple[str, ...]
    warnings: tuple[str, ...]
    published: tuple[tuple[str, int], ...]
    events: tuple[str, ...] = ()


class HandlingLog:
    """Collects the report on the present message, and counts over all messages.

    Attributes:
        counts: numbers of messages that trigger estimates, by outcome: 'received', 'skipped',
            'dropped', and keys of the session.
        faults: number of faults by kind.
        last_fault: message about the newest fault; '' before the first fault.
        held_up: input that the last dropped message waited for; '' if the node was only late.
        prefix: prefix of all messages, which names the person if several people are tracked.
    """

    def __init__(self) -> None:
        self.prefix = ''
        self.counts: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.last_fault = ''
        self.held_up = ''
        self.begin()

    def begin(self) -> None:
        """Starts the report on the next message."""
        self._told: list[str] = []
        self._warned: list[str] = []
        self._events: list[str] = []
        self._published: list[tuple[str, int]] = []

    def fault(self, kind: str, text: str) -> None:
        """Reports a message or content that could not be used."""
        self._told.append(one_line(f'{self.prefix}{text}'))
        self.note(kind, text)

    def note(self, kind: str, text: str, *, warn: bool = False) -> None:
        """Counts a remark; logs it if it is the first of its kind or `warn` is true."""
        self.faults[kind] += 1
        self.last_fault = one_line(f'{self.prefix}{text}')
        if warn or self.faults[kind] == 1:
            self._warned.append(self.last_fault)

    def add_event(self, text: str) -> None:
        """Logs an event that is not a fault."""
        self._events.append(one_line(f'{self.prefix}{text}'))

    def skip(self, kind: str, text: str) -> None:
        """Reports a message that should trigger an estimate, but can not be used."""
        self.counts['skipped'] += 1
        self.fault(kind, text)

    def drop(self, text: str) -> None:
        """Reports a message that is dropped because the node is late; this is not a fault."""
        self.counts['dropped'] += 1
        self.held_up = ''
        self._told.append(one_line(text))

    def count_dropped(self, messages: int) -> None:
        """Counts messages that were dropped before they reached the session."""
        self.counts['received'] += messages
        self.counts['dropped'] += messages
        self.held_up = ''

    def give_up(self, kind: str, held_up: str, text: str) -> None:
        """Reports a message that is dropped because an input did not arrive.

        Args:
            held_up: input that the message waited for.
        """
        self.counts['dropped'] += 1
        self.held_up = held_up
        self.fault(kind, text)

    def published(self, topic: str, stamp_ns: int) -> None:
        """Reports a message that was published."""
        self._published.append((topic, stamp_ns))

    def handled(self, source: str, stamp_ns: int) -> Handled:
        """Return the report on the present message."""
        return Handled(
            source,
            stamp_ns,
            tuple(self._told),
            tuple(self._warned),
            tuple(self._published),
            tuple(self._events),
        )


def handled_message(messages: MessageFactory, handled: Handled) -> Any:
    """Return hmt_msgs/Handled, which a node publishes on `~/handled`."""
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
    """Return the content of an hmt_msgs/Handled message, from `rosbags` or from ROS."""
    published = zip(message.published_topics, message.published_stamps, strict=True)
    return Handled(
        source=str(message.source),
        stamp_ns=time_ns(message.stamp),
        faults=tuple(map(str, message.faults)),
        warnings=tuple(map(str, message.warnings)),
        published=tuple((str(topic), time_ns(stamp)) for topic, stamp in published),
    )
