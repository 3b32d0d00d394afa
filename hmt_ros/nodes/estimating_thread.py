"""The thread that estimates: gives a session its messages, in the order in which they came."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from hmt_ros.nodes.input_queue import InputQueue, Waiting
from hmt_ros.nodes.subscribed_topic import SubscribedTopic
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.session import Session
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import deserialise

# Small messages that wait while an estimate is made.
SMALL_QUEUE = 100

_RESTART = 'restart'


class InnerFaults:
    """Faults of the node itself, since it was started.

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
    """From the bytes of messages to what became of them.

    All methods may be called by any thread.

    Args:
        session: is used by this thread alone, until `stop` has returned True.
        inputs: where messages come from.
        counted: the source whose messages are counted, and dropped when the estimate is late.
        queue_size: most of these that wait.
        done: how many of these were used so far.
        tell: is told what became of each message.
        tell_change: is called when the state of the session has become another.
        inner_faults: counts what the session should not have raised.
        log_error: takes such a fault as a text.

    Attributes:
        queue: what waits.
    """

    def __init__(
        self,
        session: Session,
        inputs: Iterable[SubscribedTopic],
        counted: str,
        queue_size: int,
        *,
        done: Callable[[], int],
        tell: Callable[[Handled], None],
        tell_change: Callable[[], None],
        inner_faults: InnerFaults,
        log_error: Callable[[str], None],
    ) -> None:
        self._session = session
        self._inputs: Mapping[str, SubscribedTopic] = {one.source: one for one in inputs}
        self._counted = counted
        limits = dict.fromkeys(self._inputs, SMALL_QUEUE)
        # Of several requests to start anew the last counts.
        limits[_RESTART] = 1
        limits[counted] = queue_size
        self.queue = InputQueue(limits, counted=counted)
        self._done, self._tell, self._tell_change = done, tell, tell_change
        self._inner_faults, self._log_error = inner_faults, log_error
        self._latencies: deque[float] = deque(maxlen=1000)
        self._thread = threading.Thread(target=self._work, name='estimate', daemon=True)
        self._thread.start()

    def put(self, source: str, data: bytes, arrival: float) -> None:
        """Adds a message."""
        largest = self._inputs[source].largest
        content = data if len(data) <= largest else _TooLarge(len(data), largest)
        self.queue.put(source, content, arrival)

    def restart(self, start: Any) -> None:
        """Has the session start anew once what has come before is handled."""
        self.queue.put(_RESTART, start, time.monotonic())

    def limit(self, queue_size: int) -> None:
        """Changes how many of the counted messages may wait."""
        self.queue.limit(self._counted, queue_size)

    def take_latencies(self) -> list[float]:
        """From the arrival of messages that were used to their estimate, s; each is told once."""
        return [self._latencies.popleft() for _ in range(len(self._latencies))]

    def stop(self, timeout: float | None = None) -> bool:
        """Ends after the present message. What waits is dropped, but for a request to start anew.

        Returns:
            Whether the thread has ended within `timeout` s.
        """
        left = self.queue.close()
        self._thread.join(timeout)
        if self._thread.is_alive():
            return False
        for waiting in left:
            self._session.count_dropped(waiting.dropped + (waiting.source == self._counted))
            if waiting.source == _RESTART:
                self._session.restart(waiting.content)
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
        session = self._session
        session.count_dropped(waiting.dropped)
        done = self._done()
        if waiting.source == _RESTART:
            session.restart(waiting.content)
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
        if self._done() > done:
            self._latencies.append(time.monotonic() - waiting.arrival)
        self._tell(handled)
