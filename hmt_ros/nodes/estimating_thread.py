"""The thread that estimates: it gives a session its messages in the order of their arrival.

Messages wait in a bounded queue. After each estimate the session takes in all that has come
meanwhile before it estimates again, so that a node that is late goes on with the newest image for
which all other inputs are there. Older images are dropped; nothing else is.
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
from hmt_ros.sessions.session import Session, kind_of
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import stamp_in

_RESTART = 'restart'
# Number of dropped images, the newest, that are reported one by one; the others are only counted.
_ANSWERED = 100
# Arrivals of messages that are remembered until their estimates.
_REMEMBERED = 1000


class Waiting(NamedTuple):
    """A message or a request that waits.

    Attributes:
        source: its origin.
        content: the message, or the action.
        arrival: when it came, in seconds of a clock that does not jump.
        stamp_ns: of its header; 0 where it has none.
    """

    source: str
    content: Any
    arrival: float
    stamp_ns: int = 0


class Duration(NamedTuple):
    """Times that an estimate took.

    Attributes:
        whole: from the bytes of its message to the last one that it led to, s.
        publishing: part of it for making messages into bytes and publishing them, s.
    """

    whole: float
    publishing: float


class Arrived(NamedTuple):
    """Messages that have come since the last time.

    Attributes:
        waiting: in the order of arrival.
        dropped: number of images that were dropped.
        stamps_ns: of the newest of these.
    """

    waiting: tuple[Waiting, ...]
    dropped: int = 0
    stamps_ns: tuple[int, ...] = ()


class InputQueue:
    """First in, first out, between two threads.

    Args:
        limits: most that may wait, by source or by kind of source; others have no limit.
        counted: the kind of source whose dropped members are counted.
    """

    def __init__(self, limits: Mapping[str, int], counted: str) -> None:
        self._limits = dict(limits)
        self._counted = counted
        self._waiting: deque[Waiting] = deque()
        self._sizes: Counter[str] = Counter()
        self._dropped = 0
        self._dropped_stamps: deque[int] = deque(maxlen=_ANSWERED)
        self._closed = False
        self._changed = threading.Condition()

    def limit(self, source: str, most: int) -> None:
        """Changes how many of a source, or of each of a kind, may wait."""
        with self._changed:
            self._limits[source] = most

    def put(self, waiting: Waiting) -> None:
        """Adds something; drops the oldest of its source where there are too many."""
        source = waiting.source
        with self._changed:
            if self._closed:
                return
            self._waiting.append(waiting)
            self._sizes[source] += 1
            kind = kind_of(source)
            most = self._limits.get(source, self._limits.get(kind, self._sizes[source]))
            while self._sizes[source] > most:
                index = next(i for i, item in enumerate(self._waiting) if item.source == source)
                if kind == self._counted:
                    self._dropped += 1
                    self._dropped_stamps.append(self._waiting[index].stamp_ns)
                del self._waiting[index]
                self._sizes[source] -= 1
            self._changed.notify()

    def get(self) -> Arrived | None:
        """Waits for something and takes all out that is there; None: the queue is closed."""
        with self._changed:
            while not self._waiting and not self._closed:
                self._changed.wait()
            return None if self._closed else self._take_out()

    def close(self) -> Arrived:
        """Ends every `get`; returns the waiting messages."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            return self._take_out()

    def _take_out(self) -> Arrived:
        result = Arrived(tuple(self._waiting), self._dropped, tuple(self._dropped_stamps))
        self._waiting.clear()
        self._sizes.clear()
        self._dropped = 0
        self._dropped_stamps.clear()
        return result

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
        tell: takes the report on each message.
        tell_change: called when status or kinds of faults of the session have changed.
        inner_faults: counts errors that the session should not have raised.
        log_error: takes the traceback of such an error.
        read: the message of a type in bytes.

    Attributes:
        queue: messages and requests that wait.
    """

    def __init__(
        self,
        session: Session[Any, Any],
        inputs: Iterable[SubscribedTopic],
        *,
        tell: Callable[[Handled], None],
        tell_change: Callable[[], None],
        inner_faults: InnerFaults,
        log_error: Callable[[str], None],
        read: Callable[[bytes, str], Any] = deserialise,
    ) -> None:
        self._session, self._read = session, read
        session.interrupted = self._is_interrupted
        self._inputs: dict[str, SubscribedTopic] = {}
        self._stamped: set[str] = set()
        # The last of several requests to start anew counts.
        limits = {_RESTART: 1, session.COUNTED: session.most_waiting}
        self.queue = InputQueue(limits, counted=session.COUNTED)
        for one in inputs:
            self.listen(one)
        self._tell, self._tell_change = tell, tell_change
        self._inner_faults, self._log_error = inner_faults, log_error
        self._latencies: deque[float] = deque(maxlen=1000)
        self._durations: deque[Duration] = deque(maxlen=1000)
        self._arrivals: dict[int, float] = {}
        self._thread = threading.Thread(target=self._work, name='estimate', daemon=True)
        self._thread.start()

    def listen(self, one: SubscribedTopic) -> None:
        """Adds a topic that messages come from."""
        if kind_of(one.source) != self._session.COUNTED:
            self.queue.limit(one.source, one.waiting)
        self._inputs[one.source] = one
        if one.opens_with_header:
            self._stamped.add(one.source)

    def put(self, source: str, data: bytes, arrival: float) -> None:
        """Adds a message."""
        largest = self._inputs[source].largest
        content = data if len(data) <= largest else _TooLarge(len(data), largest)
        stamp = stamp_in(data) if source in self._stamped else 0
        self.queue.put(Waiting(source, content, arrival, stamp))

    def restart(self, action: Callable[[], None]) -> None:
        """Restarts the session by an action, after the messages that have come before."""
        self.queue.put(Waiting(_RESTART, action, time.monotonic()))

    def take_limit(self) -> None:
        """Takes from the session how many images or mixtures may wait."""
        self.queue.limit(self._session.COUNTED, self._session.most_waiting)

    def take_latencies(self) -> list[float]:
        """Times from the arrival of messages to their estimates, s, since the last call."""
        return [self._latencies.popleft() for _ in range(len(self._latencies))]

    def take_durations(self) -> list[Duration]:
        """Times that estimates took by themselves since the last call."""
        return [self._durations.popleft() for _ in range(len(self._durations))]

    def stop(self, timeout: float | None = None) -> bool:
        """Ends the thread after the present message; drops waiting ones, except a restart.

        Returns:
            Whether the thread has ended within `timeout` s.
        """
        left = self.queue.close()
        self._thread.join(timeout)
        if self._thread.is_alive():
            return False
        counted = sum(kind_of(waiting.source) == self._session.COUNTED for waiting in left.waiting)
        self._session.count_dropped(left.dropped + counted)
        for waiting in left.waiting:
            if waiting.source == _RESTART:
                waiting.content()
        return True

    def _is_interrupted(self) -> bool:
        return bool(len(self.queue))

    def _work(self) -> None:
        session = self._session
        while (arrived := self.queue.get()) is not None:
            session.count_dropped(arrived.dropped - len(arrived.stamps_ns))
            for stamp in arrived.stamps_ns:
                self._tell(session.drop(stamp))
            following = [waiting.source for waiting in arrived.waiting[1:]]
            for waiting, after in zip(arrived.waiting, [*following, _RESTART], strict=True):
                self._try_to_handle(waiting, more=after != _RESTART)

    def _try_to_handle(self, waiting: Waiting, *, more: bool) -> None:
        session = self._session
        before = session.state
        try:
            self._handle(waiting, more=more)
        except Exception as error:  # noqa: BLE001
            # A fault of ours: later messages must not suffer from it.
            self._inner_faults.add(error)
            self._log_error(''.join(traceback.format_exception(error)))
            text = f'the node itself failed: {self._inner_faults.last}'
            self._tell(session.break_off(waiting.source, text))
        after = session.state
        if (after.status, after.faults.keys()) != (before.status, before.faults.keys()):
            self._tell_change()

    def _handle(self, waiting: Waiting, *, more: bool) -> None:
        session, began = self._session, time.monotonic()
        if waiting.source == _RESTART:
            waiting.content()
            return
        done, publishing = session.state.counts[session.DONE], session.publishing
        if kind_of(waiting.source) == session.COUNTED:
            self._arrivals[waiting.stamp_ns] = waiting.arrival
            if len(self._arrivals) > _REMEMBERED:
                del self._arrivals[next(iter(self._arrivals))]
        try:
            if isinstance(waiting.content, _TooLarge):
                raise ValueError(
                    f'it has {waiting.content.size} bytes, the limit is {waiting.content.limit}'
                )
            message = self._read(waiting.content, self._inputs[waiting.source].msgtype)
        except Exception as error:  # noqa: BLE001
            # Bytes from outside meet generated code here, which does not say what it may raise.
            handled = session.refuse(waiting.source, error_line(error), more=more)
        else:
            handled = session.take(waiting.source, message, more=more)
        if more_done := session.state.counts[session.DONE] - done:
            # An image may have waited for this message, which came later.
            # Forecasts are of times to come.
            stamps = (stamp for topic, stamp in handled.published if 'forecast' not in topic)
            newest = max(stamps, default=0)
            arrival = self._arrivals.get(newest, waiting.arrival)
            now = time.monotonic()
            self._latencies.append(now - arrival)
            published = (session.publishing - publishing) / more_done
            self._durations.append(Duration((now - began) / more_done, published))
        self._tell(handled)
