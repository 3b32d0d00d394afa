"""Messages that a node receives back because it subscribes to a topic that it publishes."""

from __future__ import annotations

import threading
from collections import deque

# Maximum number of messages that may still return; the oldest are dropped, as some middleware
# returns none.
_MAX_OWN_MESSAGES = 1000


class OwnMessages:
    """Messages on topics that a node both publishes and subscribes to; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[bytes] = deque(maxlen=_MAX_OWN_MESSAGES)

    def sent(self, data: bytes) -> None:
        """Records a message, as CDR bytes, before it is published."""
        with self._lock:
            self._waiting.append(_key(data))

    def is_own(self, data: bytes) -> bool:
        """Whether a received message was sent by this node; each sent message returns once."""
        key = _key(data)
        with self._lock:
            if known := key in self._waiting:
                self._waiting.remove(key)
            return known


def _key(data: bytes) -> bytes:
    """The message without its CDR header, and without trailing padding of the middleware."""
    return bytes(data[4:]).rstrip(b'\0')
