"""Messages that wait for the thread that estimates: bounded, the oldest images are dropped."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, NamedTuple


class Waiting(NamedTuple):
    """Something that waits.

    Attributes:
        source: where it comes from.
        content: what it is.
        arrival: when it came, in seconds of a clock that does not jump.
        dropped: images that were dropped since the last one was taken out.
    """

    source: str
    content: Any
    arrival: float
    dropped: int


class InputQueue:
    """First in, first out, between two threads.

    Args:
        limits: most that may wait, by source; a source that is not named has none.
        counted: the source whose dropped members are counted.
    """

    def __init__(self, limits: Mapping[str, int], counted: str) -> None:
        self._limits = dict(limits)
        self._counted = counted
        self._waiting: deque[tuple[str, Any, float]] = deque()
        self._sizes: Counter[str] = Counter()
        self._dropped = 0
        self._closed = False
        self._changed = threading.Condition()

    def limit(self, source: str, most: int) -> None:
        """Changes how many of a source may wait."""
        with self._changed:
            self._limits[source] = most

    def put(self, source: str, content: Any, arrival: float) -> None:
        """Adds something; drops the oldest of its source where there are too many."""
        with self._changed:
            if self._closed:
                return
            self._waiting.append((source, content, arrival))
            self._sizes[source] += 1
            while self._sizes[source] > self._limits.get(source, self._sizes[source]):
                index = next(i for i, item in enumerate(self._waiting) if item[0] == source)
                del self._waiting[index]
                self._sizes[source] -= 1
                self._dropped += source == self._counted
            self._changed.notify()

    def get(self) -> Waiting | None:
        """Waits for something and takes it out; None: the queue is closed."""
        with self._changed:
            while not self._waiting and not self._closed:
                self._changed.wait()
            if self._closed:
                return None
            source, content, arrival = self._waiting.popleft()
            self._sizes[source] -= 1
            dropped, self._dropped = self._dropped, 0
            return Waiting(source, content, arrival, dropped)

    def close(self) -> list[Waiting]:
        """Ends every `get`; returns what waited."""
        with self._changed:
            self._closed = True
            left = [Waiting(*waiting, dropped=0) for waiting in self._waiting]
            if left:
                left[0] = left[0]._replace(dropped=self._dropped)
            self._waiting.clear()
            self._sizes.clear()
            self._changed.notify_all()
            return left

    def __len__(self) -> int:
        with self._changed:
            return len(self._waiting)
