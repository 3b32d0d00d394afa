"""Channels and messages of the files of a bag, their merging by time, and `BagError`."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from msg_tools.files.error_line import error_line


class Channel(NamedTuple):
    """Description of the messages of one topic in a bag.

    Attributes:
        topic: as written, with or without a leading slash.
        msgtype: as written; '' if the bag does not contain it.
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


class BagError(ValueError):
    """A bag that can not be read or written, in one line: what was seen, wanted, and what to do."""

    def __init__(self, text: str) -> None:
        super().__init__(' '.join(text.split()))


def absolute_name(topic: str, namespace: str = '') -> str:
    """Name of a topic as rosbag2 records and compares it: with its namespace and a leading slash.

    Args:
        topic: a relative name is in the namespace; an absolute one stays.
        namespace: '/humans/bodies/p1' for example; '' for the root.
    """
    if topic.startswith('/'):
        return topic
    inside = namespace.strip('/')
    return f'/{inside}/{topic}' if inside else f'/{topic}'


def reason(error: BaseException) -> str:
    """The text of a library's exception as one line of at most 160 characters."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = error_line(error)
    return text if len(text) <= 160 else f'{text[:157]}...'


Timed = tuple[int, Any]


class Source(NamedTuple):
    """A stream that is opened when its time has come.

    Attributes:
        start: no item of the stream is earlier than this.
        order: unique; of two items of the same time the one of the lower order comes first.
        open: gives (time, item) in order of time.
    """

    start: int
    order: int
    open: Callable[[], Iterator[Timed]]


def merge(sources: Iterable[Source]) -> Iterator[Timed]:
    """All items of all sources by time, then source, then position in the source.

    Only sources whose span of time contains the present item are open.
    """
    waiting = deque(sorted(sources, key=lambda source: (source.start, source.order)))
    heads: list[tuple[int, int, Timed, Iterator[Timed]]] = []
    while waiting or heads:
        while waiting and (not heads or waiting[0][:2] < heads[0][:2]):
            source = waiting.popleft()
            stream = source.open()
            for head in stream:
                heapq.heappush(heads, (head[0], source.order, head, stream))
                break
        if heads:
            _, order, head, stream = heads[0]
            yield head
            following = next(stream, None)
            if following is None:
                heapq.heappop(heads)
            else:
                heapq.heapreplace(heads, (following[0], order, following, stream))
