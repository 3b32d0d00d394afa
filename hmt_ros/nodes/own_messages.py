"""Messages that a node receives back because it subscribes to a topic that it publishes."""

from __future__ import annotations

import threading
from collections import deque

# Maximum number of sent messages that are remembered; the oldest are forgotten, because some
# middleware never returns a node's own messages.
_MAX_OWN_MESSAGES = 1000


class OwnMessages:
    """Recognises a node's own messages on topics that it also subscribes to; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[bytes] = deque(maxlen=_MAX_OWN_MESSAGES)

    def sent(self, data: bytes) -> None:
        """Records a message, as CDR bytes, before it is published."""
        with self._lock:
            self._waiting.append(_key(data))

    def is_own(self, data: bytes) -> bool:
        """Whether a received message was sent by this node; recognises each message once."""
        key = _key(data)
        with self._lock:
            if known := key in self._waiting:
                self._waiting.remove(key)
            return known


def _key(data: bytes) -> bytes:
    """The message without its CDR header and without the middleware's trailing padding."""
    return bytes(data[4:]).rstrip(b'\0')
