"""Diagnostics of a node: rates of messages, and events of the middleware.

Without these events, a publisher with an incompatible quality of service would go unnoticed.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.qos import qos_policy_name_from_kind

from hmt_ros.nodes.estimating_thread import Duration
from hmt_ros.nodes.silent_topics import SilentTopics
from hmt_ros.sessions.session import SessionState

_LOST_MESSAGES_KEY = 'messages lost'


class Rates:
    """Message rates during the last diagnostics period.

    Args:
        name: plural name of the counted messages, such as 'images'.
        done: key of the count of used messages, such as 'tracked'.

    Attributes:
        name: plural name of the counted messages.
        change: increase of each count in the last period.
        computing: statement about the computing time per message, for the diagnostics.
    """

    def __init__(self, name: str, done: str) -> None:
        self.name, self._done = name, done
        self.computing = 'computing takes too long'
        self._counts: Counter[str] = Counter()
        self.change: Counter[str] = Counter()
        self._durations: list[Duration] = []
        self._waiting, self._seconds, self._began = 0, 1.0, time.monotonic()

    def next_period(self, counts: Counter[str], durations: list[Duration], waiting: int) -> None:
        """Ends a diagnostics period and begins the next.

        Args:
            counts: totals since the start: 'received', 'dropped', 'lost', 'faults', and the used
                messages under the key `done`.
        """
        now = time.monotonic()
        self._seconds, self._began = max(now - self._began, 1e-3), now
        # Counts restart at 0 when the node is configured again; a Counter drops negative changes.
        self.change, self._counts = counts - self._counts, counts
        self._waiting, self._durations = waiting, durations
        if durations:
            mean = self._means().whole
            self.computing = f'computing takes {mean:.0f} ms for one of the {self.name}'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        latency, whole, publishing = self._means()
        largest = max((one.latency for one in self._durations), default=math.nan)
        return [
            (f'{self.name} received a second', f'{self._rate("received"):.1f}'),
            (f'{self.name} {self._done} a second', f'{self._rate(self._done):.1f}'),
            ('latency, mean, ms', f'{latency:.1f}'),
            ('latency, largest, ms', f'{1e3 * largest:.1f}'),
            ('estimating, mean, ms', f'{whole - publishing:.1f}'),
            ('publishing, mean, ms', f'{publishing:.1f}'),
            ('messages waiting', str(self._waiting)),
        ]

    def line(self) -> str:
        """The rates as a line for the console."""
        dropped = self.change['dropped']
        return (
            f'{self._rate("received"):.1f} {self.name} a second, '
            f'{self._rate(self._done):.1f} {self._done}'
            f'{f", latency {self._means().latency:.0f} ms" if self._durations else ""}'
            f'{f", {dropped} dropped" if dropped else ""}'
        )

    def _rate(self, what: str) -> float:
        return self.change[what] / self._seconds

    def _means(self) -> Duration:
        """Mean durations in the period, ms."""
        known = self._durations or [Duration(math.nan, math.nan, math.nan)]
        return Duration(*(1e3 * sum(each) / len(known) for each in zip(*known, strict=True)))


def trouble_of_period(state: SessionState, rates: Rates, silent: SilentTopics) -> str:
    """Description of the last period's problem and its cause; '' without a problem."""
    name, why = rates.name, '; '.join(silent.texts.values())
    if rates.change['dropped']:
        held_up = f'waits for {state.held_up}' if state.held_up else rates.computing
        return f'{why or held_up}; late: {rates.change["dropped"]} {name} dropped in a second'
    if rates.change['faults']:
        return state.last_fault
    if rates.change['lost']:
        return f'{rates.change["lost"]} messages lost on their way in a second'
    if silent.silence:
        return f'no {name} for {silent.silence:.0f} s; {why}'.removesuffix('; ')
    if state.wants:
        return f'waits for {state.wants}; {why}'.removesuffix('; ')
    return why


class MiddlewareEvents:
    """Counts lost messages and incompatible publishers and subscriptions; warns once per kind.

    Only the executor's thread may call the callbacks and `forget`; other methods are thread-safe.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._counts: Counter[str] = Counter()
        # Name of the QoS policy that caused the last incompatibility, by topic.
        self._policies: dict[str, str] = {}

    def of_subscription(self, topic: str) -> SubscriptionEventCallbacks:
        """Event callbacks for a subscription to a topic, which is given by its full name."""

        def lost(event: Any) -> None:
            count = event.total_count_change
            text = f'{topic}: {count} messages were lost on their way'
            self._count(f'{_LOST_MESSAGES_KEY} of {topic}', count, text)

        callbacks = self._misfits(
            topic,
            'publishers of',
            ('a publisher offers', 'asked for', 'a publisher has'),
            'none of its messages will arrive',
        )
        return SubscriptionEventCallbacks(**callbacks, message_lost=lost)

    def of_publisher(self, topic: str) -> PublisherEventCallbacks:
        """Event callbacks for a publisher of a topic, which is given by its full name."""
        callbacks = self._misfits(
            topic,
            'subscriptions to',
            ('a subscription asks for', 'offered', 'a subscription has'),
            'it will get no messages',
        )
        return PublisherEventCallbacks(**callbacks)

    def _misfits(
        self, topic: str, partners: str, words: tuple[str, str, str], effect: str
    ) -> dict[str, Callable[[Any], None]]:
        """Callbacks for the events that report an incompatible QoS policy or message type."""
        wants, than, has = words

        def incompatible(event: Any) -> None:
            policy = self._policies[f'{partners} {topic}'] = _policy(event)
            self._count(
                f'{partners} {topic} with another {policy}',
                event.total_count_change,
                f'{topic}: {wants} another {policy} than is {than}, {effect}; '
                f'see "ros2 topic info --verbose {topic}"',
            )

        def other_type(event: Any) -> None:
            what = f'{partners} {topic} with another type'
            text = f'{topic}: {has} another type, {effect}'
            self._count(what, event.total_count_change, text)

        return {'incompatible_qos': incompatible, 'incompatible_type': other_type}

    def deaf_topic(self, subscriptions: Iterable[Any]) -> str:
        """Warning about a topic whose publishers all have an incompatible QoS policy, or ''."""
        # Another thread may close the subscriptions at the same time.
        with suppress(InvalidHandle):
            for subscription in list(subscriptions):
                topic = subscription.topic_name
                policy = self._policies.get(f'publishers of {topic}')
                if policy and not subscription.get_publisher_count():
                    return f'{topic}: publishers offer another {policy} than is asked for'
        return ''

    @property
    def lost(self) -> int:
        """Number of messages lost so far, over all topics."""
        counts = dict(self._counts)
        return sum(count for what, count in counts.items() if what.startswith(_LOST_MESSAGES_KEY))

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        counts = sorted(dict(self._counts).items())
        return [
            (_LOST_MESSAGES_KEY, str(self.lost)),
            *((what, str(count)) for what, count in counts),
        ]

    def forget(self) -> None:
        """Forgets incompatible publishers; new subscriptions detect any that still exist."""
        self._policies.clear()

    def _count(self, what: str, count: int, text: str) -> None:
        if what not in self._counts:
            self._warn(f'{text} (more of this kind are counted in /diagnostics)')
        self._counts[what] += count


def _policy(event: Any) -> str:
    """Name of the incompatible QoS policy."""
    try:
        return str(qos_policy_name_from_kind(event.last_policy_kind)).lower()
    except ValueError:
        return f'policy {event.last_policy_kind}'
