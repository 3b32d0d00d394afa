"""Base class of the nodes that track one person or several people.

A watchdog with a monotonic clock publishes a warning for robots after a time `stale_time` without
outputs for a new image.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hmt_msgs.srv import Reset
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import (
    CAMERA_INFO_TOPIC,
    TRANSFORM_TOPICS,
    SubscribedTopic,
    image_topic,
    input_topics,
    types_of_others,
)
from hmt_ros.sessions.track_start import TrackStart
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession

# Period of the watchdog, s.
_WATCHDOG_PERIOD = 0.05


class TrackingNode(SessionNode[Any, Any]):
    """A node around a session that tracks people; see `SessionNode`."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._inactive = threading.Event()
        self._watchdog: threading.Thread | None = None

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribes to the inputs; starts the estimator and the watchdog."""
        result = super().on_activate(state)
        self._inactive = threading.Event()
        # A thread, because a timer would wait while the executor is busy.
        self._watchdog = threading.Thread(
            target=self._watch, args=(self._session, self._inactive), name='watchdog', daemon=True
        )
        self._watchdog.start()
        return result

    def stop(self, timeout: float | None = None) -> bool:
        """Stops the watchdog and the estimator; see `SessionNode`."""
        self._inactive.set()
        if self._watchdog is not None:
            self._watchdog.join()
            self._watchdog = None
        return super().stop(timeout)

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield Reset, '~/reset', self._on_reset

    def _messages_of_others(self, settings: FilterParameters) -> Mapping[str, str]:
        return types_of_others(self.SESSION.inputs_of(settings), settings.source)

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield CAMERA_INFO_TOPIC
        assert self._session is not None
        yield from input_topics(self._session.rows)
        if self._session.frames.wanted:
            yield from TRANSFORM_TOPICS
        yield image_topic(self._settings.image_transport)

    @abstractmethod
    def _start_asked_for(self, request: Reset.Request) -> TrackStart:
        """Data from which the new tracks start, as requested.

        Raises:
            ValueError: the request can not be used.
        """

    def _on_reset(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        session, estimator = self._session, self._estimator
        if session is None or estimator is None:
            raise ValueError('the node is not active')
        start = self._start_asked_for(request)
        estimator.restart(lambda: session.restart(start))
        wants = start.wants(start.parameters.sources)
        response.success, response.message = True, f'a new track waits for {wants}'
        self.get_logger().info(f'~/reset: {response.message}')
        return response

    # Called by the watchdog thread.

    def _watch(self, session: TrackingSession, inactive: threading.Event) -> None:
        """Publishes warnings for robots while there are no outputs for new images."""
        count, answered = session.answered, time.monotonic()
        while not inactive.wait(_WATCHDOG_PERIOD):
            now = time.monotonic()
            if session.answered != count:
                count, answered = session.answered, now
            if now - answered >= self._settings.stale_time:
                for output in session.stale(now - answered, count):
                    self._publish(output)
