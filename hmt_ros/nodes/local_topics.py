"""Topics between nodes that run in one process.

What one node publishes, another gets as it is, without the middleware. What comes from other
processes is subscribed to once, by the first node that listens, which hands it to the others.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(eq=False)
class Listener:
    """A node that listens to a topic.

    Attributes:
        topic: its full name.
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

    `deliver` and `listeners` may be called by any thread, the others by that of the executor.
    """

    def __init__(self) -> None:
        self._offered: set[str] = set()
        # The tuples are replaced as a whole: other threads may be going through the old ones.
        self._listeners: defaultdict[str, tuple[Listener, ...]] = defaultdict(tuple)
        self._changing = threading.Lock()

    def offer(self, topic: str) -> None:
        """A node of this process publishes a topic; to be told before anybody listens."""
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

    def deliver(self, topic: str, data: bytes) -> None:
        """Hands a message to all who listen."""
        for listener in self._listeners.get(topic, ()):
            listener.receive(data)

    def listeners(self, topic: str) -> int:
        """How many nodes of this process listen to a topic."""
        return len(self._listeners.get(topic, ()))
