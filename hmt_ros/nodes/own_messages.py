"""Messages that come back to their publisher, which subscribes to the same topic."""

from __future__ import annotations

import threading
from collections import Counter, deque

# Messages that may be on their way back; those of a middleware that returns none are forgotten.
_MOST_OWN = 1000


class OwnMessages:
    """Messages published on a topic to which the publisher subscribes, too; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: Counter[bytes] = Counter()
        self._order: deque[bytes] = deque()

    def sent(self, data: bytes) -> None:
        """Notes a message, before it is published; CDR bytes."""
        key = _key(data)
        with self._lock:
            self._waiting[key] += 1
            self._order.append(key)
            while len(self._order) > _MOST_OWN:
                self._forget(self._order.popleft())

    def is_own(self, data: bytes) -> bool:
        """Whether a message that was received is an own one; each comes back once."""
        key = _key(data)
        with self._lock:
            if key not in self._waiting:
                return False
            self._forget(key)
            self._order.remove(key)
            return True

    def _forget(self, key: bytes) -> None:
        self._waiting[key] -= 1
        if not self._waiting[key]:
            del self._waiting[key]


def _key(data: bytes) -> bytes:
    """The message without its head, and without the padding of the middleware at its end."""
    return bytes(data[4:]).rstrip(b'\0')
