"""What the middleware tells of topics: messages that were lost, partners that do not fit.

Of each kind the first is told in a warning, all are counted for the diagnostics. A publisher whose
quality of service does not fit is otherwise silence without a cause.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import qos_policy_name_from_kind


class MiddlewareEvents:
    """Counts events of the topics of a node, and warns.

    Args:
        warn: takes a text for a person.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._counts: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()
        self._policies: dict[str, str] = {}
        # Diagnostics are also made by the thread that estimates.
        self._lock = threading.Lock()

    def of_subscription(self, topic: str) -> SubscriptionEventCallbacks:
        """Callbacks for a subscription.

        Args:
            topic: its full name.
        """

        def incompatible(event: Any) -> None:
            policy = _policy(event)
            with self._lock:
                self._policies[topic] = policy
            self._count(
                f'publishers of {topic} with another {policy}',
                event.total_count_change,
                f'{topic}: a publisher offers another {policy} than is asked for, none of its '
                f'messages will arrive; see "ros2 topic info --verbose {topic}"',
            )

        def other_type(event: Any) -> None:
            self._count(
                f'publishers of {topic} with another type',
                event.total_count_change,
                f'{topic}: a publisher has another type, none of its messages will arrive',
            )

        def lost(event: Any) -> None:
            count = event.total_count_change
            with self._lock:
                self._lost[topic] += count
            self._count(
                f'messages lost of {topic}',
                count,
                f'{topic}: {count} messages were lost on their way',
            )

        return SubscriptionEventCallbacks(
            incompatible_qos=incompatible, incompatible_type=other_type, message_lost=lost
        )

    def of_publisher(self, topic: str) -> PublisherEventCallbacks:
        """Callbacks for a publisher.

        Args:
            topic: its full name.
        """

        def incompatible(event: Any) -> None:
            policy = _policy(event)
            self._count(
                f'subscriptions to {topic} with another {policy}',
                event.total_count_change,
                f'{topic}: a subscription asks for another {policy} than is offered, it will get '
                f'no messages; see "ros2 topic info --verbose {topic}"',
            )

        def other_type(event: Any) -> None:
            self._count(
                f'subscriptions to {topic} with another type',
                event.total_count_change,
                f'{topic}: a subscription has another type, it will get no messages',
            )

        return PublisherEventCallbacks(incompatible_qos=incompatible, incompatible_type=other_type)

    def refused_policy(self, topic: str) -> str:
        """The policy in which the last publisher that did not fit differs; '' where all fit."""
        with self._lock:
            return self._policies.get(topic, '')

    @property
    def lost(self) -> int:
        """Messages lost so far, of all topics."""
        with self._lock:
            return self._lost.total()

    def values(self) -> list[tuple[str, str]]:
        """For diagnostics."""
        with self._lock:
            counts = [(what, str(count)) for what, count in sorted(self._counts.items())]
        return [('messages lost', str(self.lost)), *counts]

    def forget(self) -> None:
        """Publishers that did not fit are gone, or will be found again: topics are closed."""
        with self._lock:
            self._policies.clear()

    def _count(self, what: str, count: int, text: str) -> None:
        with self._lock:
            first = what not in self._counts
            self._counts[what] += count
        if first:
            self._warn(f'{text} (more of the kind are counted in /diagnostics)')


def _policy(event: Any) -> str:
    """The policy that does not fit, as one says it."""
    try:
        return str(qos_policy_name_from_kind(event.last_policy_kind)).lower()
    except ValueError:
        return f'policy {event.last_policy_kind}'
