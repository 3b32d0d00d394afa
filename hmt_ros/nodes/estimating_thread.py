"""The estimating threads: they pass messages to the sessions of a process.

Each session has a bounded queue of messages, in the order of their arrival. A session reads all
waiting messages before it estimates again, so that a late node continues with the newest image
whose other inputs have all arrived. Only older images are dropped.

The sessions that contribute to a pose share one thread and take turns, in the order in which they
use each other's results. Sessions that can wait for the pose have a second thread, which handles a
message when the first thread is idle, or once the message has waited for `MAX_WAIT`. The messages
of a session stay in order, so that its results do not depend on the turns.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple, NoReturn

from hmt_ros.inference.arrays import Image
from hmt_ros.nodes.subscribed_topic import SubscribedTopic, opens_with_header
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.seen_images import SeenImages
from hmt_ros.sessions.session import Session, kind_of
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import stamp_in
from msg_tools.messages.images import decode_image

# Maximum time that a message of the second thread waits for the first thread to be idle, s.
MAX_WAIT = 0.1
# Number of recently decoded images that the sessions of a process share.
MAX_SHARED_IMAGES = 4
_RESTART = 'restart'
# Maximum number of dropped images that are reported individually; older drops are only counted.
_MAX_REPORTED_DROPS = 100
# Maximum number of images whose arrival times are remembered, to measure the latency.
_MAX_ARRIVAL_TIMES = 1000


class Waiting(NamedTuple):
    """A waiting message or request.

    Attributes:
        source: source of the message, or kind of the request.
        content: function that reads the message, or raises any Exception if it is unreadable; for
            a request, function that executes it.
        arrival: time of arrival by a monotonic clock, s.
        stamp_ns: stamp in the header of the message, ns; 0 without a header.
    """

    source: str
    content: Callable[[], Any]
    arrival: float
    stamp_ns: int = 0


def received(data: bytes, of: SubscribedTopic) -> Waiting:
    """Return the queue entry of a new message, which is read at most once for all sessions."""
    read: Callable[[], Any] = cache(partial(deserialise, data, of.msgtype))
    if len(data) > of.largest:
        # Does not keep the oversized message in memory.
        read = partial(_refuse, f'it has {len(data)} bytes, the limit is {of.largest}')
    stamp = stamp_in(data) if opens_with_header(of.msgtype) else 0
    return Waiting(of.source, read, time.monotonic(), stamp)


def _refuse(why: str) -> NoReturn:
    raise ValueError(why)


class Duration(NamedTuple):
    """Computing times of an estimate.

    Attributes:
        latency: time from the arrival of the image or other message to the last result, s.
        whole: time from reading the message to publishing the last result, s.
        publishing: part of `whole` spent on serialising and publishing, s.
    """

    latency: float
    whole: float
    publishing: float


class Arrived(NamedTuple):
    """Messages that were taken out of a queue.

    Attributes:
        waiting: messages in the order of arrival.
        dropped: number of images dropped since the last call.
        stamps_ns: stamps of the newest dropped images.
    """

    waiting: tuple[Waiting, ...]
    dropped: int = 0
    stamps_ns: tuple[int, ...] = ()


class InputQueue:
    """First-in-first-out queue between threads.

    Args:
        limits: maximum number of waiting messages by source or kind of source; sources without an
            entry are unlimited.
        counted: kind of source whose dropped messages are counted.
        changed: condition that is notified on each arrival; its lock guards the queue.
    """

    def __init__(
        self, limits: Mapping[str, int], counted: str, changed: threading.Condition | None = None
    ) -> None:
        self._limits = dict(limits)
        self._counted = counted
        self._waiting: deque[Waiting] = deque()
        self._sizes: Counter[str] = Counter()
        self._dropped = 0
        self._dropped_stamps: deque[int] = deque(maxlen=_MAX_REPORTED_DROPS)
        self._closed = False
        self._changed = changed or threading.Condition()

    def limit(self, source: str, most: int) -> None:
        """Sets the maximum number of waiting messages of a source, or of each source of a kind."""
        with self._changed:
            self._limits[source] = most

    def put(self, waiting: Waiting) -> None:
        """Adds a message or request; drops the oldest of its source if too many are waiting."""
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
            self._changed.notify_all()

    def take(self, most: int | None = None) -> Arrived:
        """Removes and returns all messages, or only the first `most` messages."""
        with self._changed:
            count = len(self._waiting) if most is None else min(most, len(self._waiting))
            taken = tuple(self._waiting.popleft() for _ in range(count))
            self._sizes.subtract(one.source for one in taken)
            result = Arrived(taken, self._dropped, tuple(self._dropped_stamps))
            self._dropped = 0
            self._dropped_stamps.clear()
            return result

    def close(self) -> Arrived:
        """Closes the queue to new messages; returns the waiting messages."""
        with self._changed:
            self._closed = True
            return self.take()

    @property
    def since(self) -> float:
        """Arrival time of the oldest waiting message, s; infinity if none waits."""
        with self._changed:
            return self._waiting[0].arrival if self._waiting else math.inf

    def __len__(self) -> int:
        with self._changed:
            return len(self._waiting)


class EstimatingThread:
    """A thread that runs several estimators in turn.

    Other threads may call the public methods.

    Args:
        changed: condition shared by all estimating threads of the process and their queues.
        after: thread of higher priority; None: no such thread.
    """

    def __init__(self, changed: threading.Condition, after: EstimatingThread | None = None) -> None:
        self.changed, self._after = changed, after
        self._served: list[Estimator] = []
        # The estimator whose turn it is.
        self._busy: Estimator | None = None
        self._thread: threading.Thread | None = None

    def serve(self, estimator: Estimator) -> None:
        """Adds an estimator, which gets turns from now on."""
        with self.changed:
            self._served.append(estimator)
            self._served.sort(key=lambda one: one.place)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name='estimate', daemon=True)
                self._thread.start()

    def leave(self, estimator: Estimator, timeout: float | None) -> bool:
        """Removes an estimator; returns whether its present turn ends within `timeout` s."""
        with self.changed:
            if estimator in self._served:
                self._served.remove(estimator)
            self.changed.notify_all()
            return self.changed.wait_for(lambda: self._busy is not estimator, timeout)

    def _work(self) -> None:
        last = -1
        while (estimator := self._next(last)) is not None:
            last = estimator.place
            estimator.handle(estimator.queue.take(None if self._after is None else 1))

    def _next(self, last: int) -> Estimator | None:
        """Waits until an estimator has work, and returns it; None if there are no estimators.

        Args:
            last: place of the estimator that had the last turn; the next place has priority.
        """
        with self.changed:
            self._busy = None
            self.changed.notify_all()
            while self._served:
                ready = [one for one in self._served if len(one.queue) and self._may_begin(one)]
                if ready:
                    self._busy = next((one for one in ready if one.place > last), ready[0])
                    return self._busy
                self.changed.wait(None if self._after is None else MAX_WAIT / 2)
            self._thread = None
            return None

    def _may_begin(self, estimator: Estimator) -> bool:
        if self._after is None or time.monotonic() - estimator.queue.since > MAX_WAIT:
            return True
        return self._after._busy is None and not any(len(x.queue) for x in self._after._served)


class EstimatingThreads:
    """The estimating threads of a process.

    Attributes:
        poses: thread of the sessions that contribute to the pose.
        later: thread of the sessions that can wait for the pose.
        seen_images: images that the filter keeps for the smoother.
    """

    def __init__(self) -> None:
        changed = threading.Condition()
        self.poses = EstimatingThread(changed)
        self.later = EstimatingThread(changed, after=self.poses)
        self.seen_images = SeenImages()
        self._pictures: deque[tuple[Any, Image]] = deque(maxlen=MAX_SHARED_IMAGES)

    def decode(self, message: Any) -> Image:
        """The pixels of an image message, see `decode_image`; decoded once for all sessions."""
        for known, picture in tuple(self._pictures):
            if known is message:
                return picture
        picture = decode_image(message)
        self._pictures.append((message, picture))
        return picture


class Estimator:
    """Handles the messages of a session, and reports on each message.

    All methods except `handle` are thread-safe.

    Args:
        session: session to run; no other thread may use it until `stop` has returned True.
        thread: thread that runs the estimator.
        place: rank of the estimator in the order of turns.
        report: function that receives the report on each message.
        report_change: function that is called after a change of status or a new kind of fault.
        report_error: function that receives an unexpected error of the session, and returns a
            one-line description.

    Attributes:
        queue: waiting messages and requests.
    """

    def __init__(
        self,
        session: Session[Any, Any],
        thread: EstimatingThread,
        *,
        place: int,
        report: Callable[[Handled], None],
        report_change: Callable[[], None],
        report_error: Callable[[Exception], str],
    ) -> None:
        self._session, self._thread = session, thread
        self.place = place
        # Only the last of several waiting restart requests is executed.
        limits = {_RESTART: 1, session.COUNTED: session.most_waiting}
        self.queue = InputQueue(limits, session.COUNTED, thread.changed)
        session.interrupted = lambda: bool(len(self.queue))
        self._report_handled, self._tell_change, self._describe_error = (
            report,
            report_change,
            report_error,
        )
        self._durations: deque[Duration] = deque(maxlen=1000)
        self._arrivals: dict[int, float] = {}
        thread.serve(self)

    def listen(self, one: SubscribedTopic) -> None:
        """Sets the queue limit of a subscribed topic."""
        if kind_of(one.source) != self._session.COUNTED:
            self.queue.limit(one.source, one.waiting)

    def restart(self, action: Callable[[], None]) -> None:
        """Queues an action that restarts the session, after all waiting messages."""
        self.queue.put(Waiting(_RESTART, action, time.monotonic()))

    def take_limit(self) -> None:
        """Limits the number of waiting images or mixtures to the session's `most_waiting`."""
        self.queue.limit(self._session.COUNTED, self._session.most_waiting)

    def take_durations(self) -> list[Duration]:
        """Durations of the estimates since the last call."""
        return [self._durations.popleft() for _ in range(len(self._durations))]

    def stop(self, timeout: float | None = None) -> bool:
        """Stops after the present turn; drops waiting messages, but executes a waiting restart.

        Returns:
            Whether it stopped within `timeout` s.
        """
        left = self.queue.close()
        if not self._thread.leave(self, timeout):
            return False
        counted = sum(kind_of(waiting.source) == self._session.COUNTED for waiting in left.waiting)
        self._session.count_dropped(left.dropped + counted)
        for waiting in left.waiting:
            if waiting.source == _RESTART:
                waiting.content()
        return True

    def handle(self, arrived: Arrived) -> None:
        """Handles messages and reports dropped images; only the estimating thread calls this."""
        session = self._session
        session.count_dropped(arrived.dropped - len(arrived.stamps_ns))
        for stamp in arrived.stamps_ns:
            self._report_handled(session.drop(stamp))
        following = [waiting.source for waiting in arrived.waiting[1:]]
        for waiting, after in zip(arrived.waiting, [*following, _RESTART], strict=True):
            self._try_to_handle(waiting, more=after != _RESTART)

    def _try_to_handle(self, waiting: Waiting, *, more: bool) -> None:
        session = self._session
        before = session.state
        try:
            self._handle(waiting, more=more)
        except Exception as error:  # noqa: BLE001
            # An internal error must not affect later messages.
            text = f'the node itself failed: {self._describe_error(error)}'
            self._report_handled(session.break_off(waiting.source, text))
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
            if len(self._arrivals) > _MAX_ARRIVAL_TIMES:
                del self._arrivals[next(iter(self._arrivals))]
        try:
            message = waiting.content()
        except Exception as error:  # noqa: BLE001
            # Generated code reads external bytes here, and may raise any exception.
            handled = session.refuse(waiting.source, error_line(error), more=more)
        else:
            handled = session.take(waiting.source, message, more=more)
        if more_done := session.state.counts[session.DONE] - done:
            # Latency is measured from the image, which may have waited for this message.
            # Forecasts are excluded, because their stamps are in the future.
            stamps = (stamp for topic, stamp in handled.published if 'forecast' not in topic)
            newest = max(stamps, default=0)
            arrival = self._arrivals.get(newest, waiting.arrival)
            now = time.monotonic()
            published = (session.publishing - publishing) / more_done
            self._durations.append(Duration(now - arrival, (now - began) / more_done, published))
        self._report_handled(handled)
