"""Base class of sessions, with the logic of a node: messages in, messages out, without ROS.

A node and an offline replay pass their messages to a session; the same messages in the same order
give the same bytes. Messages that trigger estimates are used in the order of their stamps
(`stamp_order`): a message that is older than the previous one, or far ahead of it, waits until
other messages confirm its time. If an older time is confirmed, the estimate restarts. Messages that
can not be used are skipped. The first fault of each kind is logged; all are counted.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Image
from hmt_ros.sessions.declared_parameters import NodeParameters
from hmt_ros.sessions.handled import Handled, HandlingLog, Output
from hmt_ros.sessions.seen_images import SeenImages
from hmt_ros.sessions.stamp_order import Stamped, StampOrder, Turn
from msg_tools import MessageError, RosbagsMessages
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.images import decode_image

# Prefix of the diagnostics keys for the numbers of subscribers.
SUBSCRIBERS_KEY = 'subscribers of '
FINISH = 'finish'  # source of the report of `finish`, at the end of the stream
TIME_JUMP = 'time jumps back'  # kind of fault
_MAX_STREAMS = 1000  # maximum number of sources whose order is remembered
_LATEST_NS = 2**31 * SECOND_NS  # first stamp beyond the range of a message, ns


class PublishedTopic(NamedTuple):
    """A topic of a node; bags use the same name and type.

    Attributes:
        msgtype: message type, for example 'hmt_msgs/msg/PoseMixture'.
        latched: whether late subscribers get the last message.
    """

    msgtype: str
    latched: bool = False


class NeededInput(NamedTuple):
    """An input without which a session can not continue.

    Attributes:
        sources: sources of the input; one of them is enough.
        with_each: whether every message that triggers an estimate needs this input.
    """

    sources: tuple[str, ...]
    with_each: bool = False


@dataclass(frozen=True)
class SessionState(ABC):
    """State of a session, for diagnostics.

    Attributes:
        status: one of the words in the docstring of the session's state class.
        wants: input that the session waits for; '' if it waits for none.
        entropy: entropy of the weights of the present mixture, nats; NaN without a mixture.
        counts: numbers of messages that trigger estimates, by outcome: 'received', 'skipped',
            'dropped', and keys of the session.
        faults: number of faults by kind.
        last_fault: message about the newest fault; '' before the first fault.
        held_up: input that the last dropped message waited for; '' if the node was only late.
        frame_id: frame of the newest message that triggered an estimate; '' without a frame.
        time_jump: message about the last backward jump of the clock; '' before the first jump.
    """

    status: str
    wants: str
    entropy: float = math.nan
    counts: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    last_fault: str = ''
    held_up: str = ''
    frame_id: str = ''
    time_jump: str = ''

    @abstractmethod
    def summary(self) -> str:
        """The present estimate in a few words."""

    def trouble(self) -> str:
        """Return why the estimate can not be trusted; '' if it can."""
        return ''

    @abstractmethod
    def values(self) -> list[tuple[str, str]]:
        """Return the keys and values of diagnostics that are specific to the kind of session."""


def kind_of(source: str) -> str:
    """Return the common name of similar sources: 'mixture' for 'mixture of /humans/bodies/p1'."""
    return source.partition(' of ')[0]


def everything(_topic: str) -> bool:
    """Return True: every topic is wanted."""
    return True


def never() -> bool:
    """Return False: no message arrives during an estimate."""
    return False


Parameters = TypeVar('Parameters', bound=NodeParameters)
State = TypeVar('State', bound=SessionState)


class Session(ABC, Generic[Parameters, State]):
    """Handles the messages of a node or a replay, one after the other.

    Methods that are not documented as thread-safe must be called by one thread. Other threads may
    read `state` and `parameters`, and replace `parameters`.

    Args:
        parameters: parameters of the node.
        publish: function that is called with each output as soon as it is made.
        wanted: function that returns whether a topic needs to be published.

    Raises:
        ValueError: a value of the parameters can not be used.

    Attributes:
        TOPICS: the topics that are published.
        COUNTED: source of the messages that trigger estimates, or the kind of several sources, see
            `kind_of`.
        UNIT: word for one message of `COUNTED`, such as 'image'.
        DONE: key of `SessionState.counts` for the messages that were used.
        ESTIMATE: name of the estimate that restarts when time jumps back.
        CHECKED: parameters whose values only a new session can check, for example names of files.
        parameters: present parameters; `declared_parameters` says when a new value takes effect.
        interrupted: function, set by a node, that returns whether messages have arrived during an
            estimate.
        state: present state; replaced with every message.
        topic_names: full topic names by source, for error messages; empty without topics.
        decode_image: function that decodes the image of a message; nodes of a process share it.
        publishing: time spent on serialising and publishing messages, s; for diagnostics.
    """

    TOPICS: ClassVar[Mapping[str, PublishedTopic]]
    COUNTED: ClassVar[str]
    UNIT: ClassVar[str]
    DONE: ClassVar[str]
    ESTIMATE: ClassVar[str]
    CHECKED: ClassVar[tuple[str, ...]] = ()

    state: State

    def __init__(
        self,
        parameters: Parameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        self.parameters = parameters
        self.interrupted: Callable[[], bool] = never
        self._publish_output = publish
        self._wanted = wanted
        self._messages = RosbagsMessages()
        self._log = HandlingLog()
        self._frame_id = ''
        self._time_jump = ''
        # Order of the messages that trigger estimates, by source.
        self._orders: dict[str, StampOrder] = {}
        self.topic_names: Mapping[str, str] = {}
        self.decode_image: Callable[[Any], Image] = decode_image
        self.publishing = 0.0
        self._set_up()

    def _set_up(self) -> None:
        """Creates the attributes of a subclass; raises ValueError if parameters are unusable."""

    def share(self, images: SeenImages) -> None:
        """Sets the image store of the process; called before the first message."""

    @property
    def most_waiting(self) -> int:
        """Maximum number of messages that wait for an estimate."""
        return self.parameters.queue_size

    def take(self, source: str, message: Any, *, more: bool = False) -> Handled:
        """Handles a message.

        Args:
            source: name of the source, as defined in the module of the session.
            message: message of `rosbags` or of ROS.
            more: whether another message is waiting; estimates are then postponed if possible.
        """
        try:
            stamp = self._stamp_of(source, message)
        except MessageError as error:
            return self.refuse(source, str(error), more=more)
        if not 0 <= stamp < _LATEST_NS:
            text = f'stamp is {stamp} ns, wanted one from 1970 to 2038'
            return self.refuse(source, text, min(stamp, 0), more=more)
        self._log.begin()
        if self._is_counted(source):
            self._log.counts['received'] += 1
            self._frame_id = frame_id_of(message)
            self._use(source, self._turn_of(source, Stamped(stamp, message)))
        else:
            self._take(source, message, stamp)
        if not more:
            self._estimate_from_inputs()
        return self._handled(source, stamp)

    def needed_inputs(self) -> list[NeededInput]:
        """Inputs that are needed at present. Thread-safe."""
        return [NeededInput((self.COUNTED,))]

    def restart(self) -> None:
        """Drops the estimate; a new one starts with the messages that follow."""
        self.state = self._present_state()

    def finish(self) -> Handled:
        """Uses the waiting messages, as no more messages will arrive."""
        self._log.begin()
        for source, order in self._orders.items():
            self._use(source, order.end())
        return self._handled(FINISH, self._end())

    def _end(self) -> int:
        """Uses the waiting messages; returns the stamp of the newest message, ns, or 0."""
        return 0

    def refuse(self, source: str, text: str, stamp: int = 0, *, more: bool = False) -> Handled:
        """Counts a message that can not be read; for `more` see `take`."""
        self._log.begin()
        self._log.fault('message', f'message of {source} can not be read: {text}')
        if not more:
            self._estimate_from_inputs()
        return self._handled(source, stamp)

    def drop(self, stamp_ns: int) -> Handled:
        """Reports a message that was dropped before it reached the session."""
        self._log.begin()
        self._log.counts['received'] += 1
        self._drop(stamp_ns)
        return self._handled(self.COUNTED, stamp_ns)

    def break_off(self, source: str, text: str) -> Handled:
        """Counts an error of the session itself, and restarts the estimate."""
        self._log.fault('node itself', text)
        self.restart()
        # The node has already logged the error.
        return replace(self._log.handled(source, 0), warnings=())

    def count_dropped(self, messages: int) -> None:
        """Counts messages that a late node dropped before they reached the session."""
        if messages:
            self._log.count_dropped(messages)
            self.state = self._present_state()

    @abstractmethod
    def _take(self, source: str, message: Any, stamp: int) -> None:
        """Handles a message; `take` returns the report."""

    def _estimate_from_inputs(self) -> None:
        """Estimates from the messages that `_take` has stored."""

    def _drop(self, stamp_ns: int) -> None:
        """Reports a message that is dropped because the session is late."""
        text = f'{self.UNIT} of {stamp_ns} ns is dropped: newer ones came before its turn'
        self._log.drop(text)

    @abstractmethod
    def _present_state(self) -> State:
        """Return the present state."""

    def _is_counted(self, source: str) -> bool:
        """Whether the messages of a source trigger estimates."""
        return kind_of(source) == self.COUNTED

    def _stamp_of(self, source: str, message: Any) -> int:
        """Return the stamp of a message, ns."""
        return time_ns(message.header.stamp)

    def _handled(self, source: str, stamp: int) -> Handled:
        self.state = self._present_state()
        return self._log.handled(source, stamp)

    def _totals(self, weights: NDArray[np.float64] | None = None) -> dict[str, Any]:
        """Return the counts of all messages and the entropy of weights, for `SessionState`."""
        log = self._log
        return {
            'entropy': math.nan if weights is None else entropy(weights),
            'counts': Counter(log.counts),
            'faults': Counter(log.faults),
            'last_fault': log.last_fault,
            'held_up': log.held_up,
            'frame_id': self._frame_id,
            'time_jump': self._time_jump,
        }

    def _on_topic(self, source: str) -> str:
        """Return the name of a source with its topic, for error messages."""
        topic = self.topic_names.get(source)
        return f'{source} on {topic}' if topic else source

    def _turn_of(self, source: str, one: Stamped) -> Turn:
        """Add a message to the order; return the messages to use; restart if time jumps back."""
        order = self._orders.setdefault(source, StampOrder())
        if len(self._orders) > _MAX_STREAMS:
            del self._orders[next(iter(self._orders))]
        newest = order.newest
        turn = order.put(one, expected=self.parameters.reset_on_time_jump)
        text = f'{self.UNIT} of {one.stamp} ns comes after one of {newest} ns'
        if turn.back:
            # The order of other sources is forgotten, too.
            self._orders = {source: order}
            self._time_jump = (
                f'the clock went back by {turn.back / SECOND_NS:.3g} s: {text}, and '
                f'{len(turn.use)} agree; {self.ESTIMATE} starts again'
            )
            self._log.note(TIME_JUMP, self._time_jump, warn=True)
            self._jump_back(turn.use[0].stamp, turn.use[-1].stamp)
        elif turn.late and newest is not None and one.stamp < newest:
            hint = f'with reset_on_time_jump {self.ESTIMATE} would start again'
            self._log.skip(TIME_JUMP, f'{text}: skipped; {hint}')
        elif turn.late:
            self._log.skip('time stands still', f'{text}, wanted stamps that increase')
        return turn

    def _use(self, source: str, turn: Turn) -> None:
        """Uses the messages of a source that are next in order."""
        for stray, _ in turn.stray:
            text = f'{self.UNIT} of {stray} ns is left out: its stamp is far from those of others'
            self._log.counts['skipped'] += 1
            # This is not a fault of the present message.
            self._log.note('stray stamp', text)
        for one in turn.use:
            skipped = self._log.counts['skipped']
            self._take(source, one.message, one.stamp)
            if self._log.counts['skipped'] == skipped:
                self._orders[source].newest = one.stamp

    def _jump_back(self, first: int, last: int) -> None:
        """Restarts the estimate after time has jumped back.

        Args:
            first, last: first and last stamp, ns, of the messages after the jump, which are used
                next.
        """
        self.restart()

    def _publish(self, topic: str, stamp: int, message: Any) -> None:
        began = time.perf_counter()
        self._log.published(topic, stamp)
        self._publish_output(Output(topic, stamp, message))
        self.publishing += time.perf_counter() - began


def frame_id_of(message: Any) -> str:
    """Return the frame that a message names; '' without a frame."""
    header = getattr(message, 'header', None)
    return '' if header is None else str(header.frame_id)


def entropy(weights: NDArray[np.float64]) -> float:
    """Return the entropy of the weights of a mixture, nats; NaN without weights."""
    some = weights[weights > 0.0]
    return float(-(some * elementary.log(some)).sum()) if len(weights) else math.nan
