"""Merging streams of messages into one, in the order of their times."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

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
