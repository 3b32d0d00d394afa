"""Messages that come back to their publisher, which subscribes to the same topic."""

from __future__ import annotations

import threading
from collections import deque

# Messages that may be on their way back; those of a middleware that returns none are forgotten.
_MOST_OWN = 1000


class OwnMessages:
    """Messages published on a topic to which the publisher subscribes, too; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[bytes] = deque(maxlen=_MOST_OWN)

    def sent(self, data: bytes) -> None:
        """Notes a message, before it is published; CDR bytes."""
        with self._lock:
            self._waiting.append(_key(data))

    def is_own(self, data: bytes) -> bool:
        """Whether a message that was received is an own one; each comes back once."""
        key = _key(data)
        with self._lock:
            if known := key in self._waiting:
                self._waiting.remove(key)
            return known


def _key(data: bytes) -> bytes:
    """The message without its head, and without the padding of the middleware at its end."""
    return bytes(data[4:]).rstrip(b'\0')
