"""Topics between nodes that run in one process.

A message of one node goes to another as it is, without the middleware. A topic of other processes
is subscribed to once, by the first node that listens, which hands messages to the others.
"""

from __future__ import annotations

import threading
from collections import Counter, defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hmt_ros.inference.arrays import Image
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.images import decode_image

# Messages that are shared, the newest, and their least size, bytes: small ones are read again.
SHARED, LARGE = 4, 10_000
# Messages that may be on their way back; those of a middleware that returns none are forgotten.
_MOST_OWN = 1000


@dataclass(eq=False)
class Listener:
    """A node that listens to a topic.

    Attributes:
        topic: its full name; before it, of a topic that is not shared here, that of the node.
        receive: takes the bytes of a message; may be called by any thread.
        connect: subscribes to the topic of other processes, and returns the subscription.
        subscription: the node's own; None while another node, or none, has it.
    """

    topic: str
    receive: Callable[[bytes], None]
    connect: Callable[[], Any]
    subscription: Any = None


class LocalTopics:
    """Hands messages from node to node.

    All but `offer`, `listen` and `leave` may be called by any thread, these by the executor's.
    """

    def __init__(self) -> None:
        # Messages and pictures that several nodes share: the newest, with their sources.
        self._read: deque[tuple[bytes, Any]] = deque(maxlen=SHARED)
        self._decoded: deque[tuple[Any, Image]] = deque(maxlen=SHARED)
        self._offered: set[str] = set()
        # The tuples are replaced as a whole: other threads may be going through the old ones.
        self._listeners: defaultdict[str, tuple[Listener, ...]] = defaultdict(tuple)
        self._changing = threading.Lock()

    def offer(self, topic: str) -> None:
        """Notes a topic that a node of this process publishes, before anybody listens."""
        self._offered.add(topic)

    def listen(self, listener: Listener) -> None:
        """Begins to listen."""
        with self._changing:
            others = self._listeners[listener.topic]
            self._listeners[listener.topic] = (*others, listener)
        if listener.topic not in self._offered and not any(x.subscription for x in others):
            listener.subscription = listener.connect()

    def leave(self, listener: Listener) -> Any:
        """Listens no more.

        Returns:
            The subscription that the node has to destroy, if it has one.
        """
        with self._changing:
            left = tuple(x for x in self._listeners[listener.topic] if x is not listener)
            self._listeners[listener.topic] = left
        subscription, listener.subscription = listener.subscription, None
        if subscription is not None and left:
            left[0].subscription = left[0].connect()
        return subscription

    def read(self, data: bytes, msgtype: str) -> Any:
        """The message in bytes; the same object for all nodes that got the same large bytes."""
        for known, message in tuple(self._read):
            if known is data:
                return message
        message = deserialise(data, msgtype)
        if len(data) >= LARGE:
            self._read.append((data, message))
        return message

    def decode(self, message: Any) -> Image:
        """The picture of an image, as `decode_image`; decoded once for all nodes that share it."""
        for known, image in tuple(self._decoded):
            if known is message:
                return image
        image = decode_image(message)
        self._decoded.append((message, image))
        return image

    def deliver(self, topic: str, data: bytes) -> None:
        """Hands a message to all listeners."""
        for listener in self._listeners.get(topic, ()):
            listener.receive(data)

    def listeners(self, topic: str) -> int:
        """How many nodes of this process listen to a topic."""
        return len(self._listeners.get(topic, ()))


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
