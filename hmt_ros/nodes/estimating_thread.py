"""The thread that estimates: it gives a session its messages in the order of their arrival.

Messages wait in a bounded queue; when an estimate is late the oldest images are dropped.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from hmt_ros.nodes.subscribed_topic import SubscribedTopic
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.session import Session
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import deserialise

_RESTART = 'restart'


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


class InnerFaults:
    """Errors of the node itself since its start.

    Attributes:
        count: how many.
        last: the newest; '' before the first.
    """

    def __init__(self) -> None:
        self.count = 0
        self.last = ''

    def add(self, error: Exception) -> None:
        """Counts one."""
        self.count += 1
        self.last = f'{type(error).__name__}: {error_line(error)}'


class _TooLarge(NamedTuple):
    """Stands for a message that is not kept."""

    size: int
    limit: int


class EstimatingThread:
    """Handles messages from their bytes to the report on them.

    All methods may be called by any thread.

    Args:
        session: used by this thread alone, until `stop` has returned True.
        inputs: where messages come from.
        queue_size: maximum number of images or mixtures that wait.
        tell: takes the report on each message.
        tell_change: called when status or kinds of faults of the session have changed.
        inner_faults: counts errors that the session should not have raised.
        log_error: takes the traceback of such an error.

    Attributes:
        queue: what waits.
    """

    def __init__(
        self,
        session: Session[Any, Any],
        inputs: Iterable[SubscribedTopic],
        queue_size: int,
        *,
        tell: Callable[[Handled], None],
        tell_change: Callable[[], None],
        inner_faults: InnerFaults,
        log_error: Callable[[str], None],
    ) -> None:
        self._session = session
        self._inputs: Mapping[str, SubscribedTopic] = {one.source: one for one in inputs}
        limits = {one.source: one.waiting for one in self._inputs.values()}
        # Of several requests to start anew the last counts.
        limits[_RESTART] = 1
        limits[session.COUNTED] = queue_size
        self.queue = InputQueue(limits, counted=session.COUNTED)
        self._tell, self._tell_change = tell, tell_change
        self._inner_faults, self._log_error = inner_faults, log_error
        self._latencies: deque[float] = deque(maxlen=1000)
        self._durations: deque[float] = deque(maxlen=1000)
        self._thread = threading.Thread(target=self._work, name='estimate', daemon=True)
        self._thread.start()

    def put(self, source: str, data: bytes, arrival: float) -> None:
        """Adds a message."""
        largest = self._inputs[source].largest
        content = data if len(data) <= largest else _TooLarge(len(data), largest)
        self.queue.put(source, content, arrival)

    def restart(self, action: Callable[[], None]) -> None:
        """Restarts the session by an action, after the messages that have come before."""
        self.queue.put(_RESTART, action, time.monotonic())

    def limit(self, queue_size: int) -> None:
        """Changes how many images or mixtures may wait."""
        self.queue.limit(self._session.COUNTED, queue_size)

    def take_latencies(self) -> list[float]:
        """Times from the arrival of messages to their estimates, s, since the last call."""
        return [self._latencies.popleft() for _ in range(len(self._latencies))]

    def take_durations(self) -> list[float]:
        """Times that estimates took by themselves, s, since the last call."""
        return [self._durations.popleft() for _ in range(len(self._durations))]

    def stop(self, timeout: float | None = None) -> bool:
        """Ends the thread after the present message; drops what waits, except a restart.

        Returns:
            Whether the thread has ended within `timeout` s.
        """
        left = self.queue.close()
        self._thread.join(timeout)
        if self._thread.is_alive():
            return False
        for waiting in left:
            self._session.count_dropped(waiting.dropped + (waiting.source == self._session.COUNTED))
            if waiting.source == _RESTART:
                waiting.content()
        return True

    def _work(self) -> None:
        session = self._session
        while (waiting := self.queue.get()) is not None:
            before = session.state
            try:
                self._handle(waiting)
            except Exception as error:  # noqa: BLE001
                # A fault of ours. What comes next may not suffer from it.
                self._inner_faults.add(error)
                self._log_error(''.join(traceback.format_exception(error)))
                text = f'the node itself failed: {self._inner_faults.last}'
                self._tell(session.break_off(waiting.source, text))
            after = session.state
            if (after.status, after.faults.keys()) != (before.status, before.faults.keys()):
                self._tell_change()

    def _handle(self, waiting: Waiting) -> None:
        session, began = self._session, time.monotonic()
        session.count_dropped(waiting.dropped)
        done = session.state.counts[session.DONE]
        if waiting.source == _RESTART:
            waiting.content()
            return
        try:
            if isinstance(waiting.content, _TooLarge):
                raise ValueError(
                    f'it has {waiting.content.size} bytes, the limit is {waiting.content.limit}'
                )
            message = deserialise(waiting.content, self._inputs[waiting.source].msgtype)
        except Exception as error:  # noqa: BLE001
            # Bytes from outside meet generated code here, which does not say what it may raise.
            handled = session.refuse(waiting.source, error_line(error))
        else:
            handled = session.take(waiting.source, message)
        if session.state.counts[session.DONE] > done:
            now = time.monotonic()
            self._latencies.append(now - waiting.arrival)
            self._durations.append(now - began)
        self._tell(handled)
