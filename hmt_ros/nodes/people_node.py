"""people_node: images and detections of several people in, mixtures over the poses of each out.

The topics of a person open when the person is first seen, and close some seconds after the person
has left.
"""

from __future__ import annotations

import sys
import threading
from typing import Any

from hmt_msgs.srv import Reset
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.subscribed_topic import published_with
from hmt_ros.nodes.tracking_node import TrackingNode
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.people_session import PeopleSession, published_topic
from hmt_ros.sessions.track import person_of
from hmt_ros.sessions.track_start import TrackStart, prepare_start
from hmt_ros.sessions.tracking_parameters import PeopleParameters

# Number of diagnostics periods from the end of a track until the person's topics close, so that the
# last messages still arrive.
CLOSING_PERIODS = 5


class PeopleNode(TrackingNode):
    """The node; its parameters are the fields of `PeopleParameters`."""

    NAME = 'people_node'
    SUBJECT = 'people'
    SESSION = PeopleSession
    DEFAULTS = PeopleParameters()

    def __init__(self, *args: Any, **options: Any) -> None:
        # The estimating thread opens and uses topics, the executor's thread closes them.
        self._opening = threading.RLock()
        self._left: dict[str, int] = {}
        super().__init__(*args, **options)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribes and stops the estimator; closes the topics of all people."""
        result = super().on_deactivate(state)
        self._close_topics({name for topic in self._outputs if (name := person_of(topic))})
        return result

    def _start_asked_for(self, request: Reset.Request) -> TrackStart:
        if len(request.initial.components) or request.box.width:
            raise ValueError('a mixture or a box is for one person: wanted an empty request')
        return prepare_start(self._settings)

    # Called by the estimating thread.

    def _publish(self, output: Output) -> None:
        with self._opening:
            self._open(output.topic)
            super()._publish(output)

    def _is_wanted(self, topic: str) -> bool:
        with self._opening:
            self._open(topic)
            return super()._is_wanted(topic)

    def _open(self, topic: str) -> None:
        """Opens a topic of a person if it is not open; the caller must hold the lock."""
        if topic not in self._outputs:
            publisher = self._new_publisher(topic, *published_with(published_topic(topic)))
            publisher.on_activate(None)
            # A copy, because another thread may iterate over the old dictionary.
            self._outputs = {**self._outputs, topic: publisher}

    # Called by the executor's thread.

    def _diagnose_period(self) -> None:
        super()._diagnose_period()
        followed = set() if self._session is None else set(self._session.state.followed)
        open_now = {name for topic in self._outputs if (name := person_of(topic))}
        self._left = {name: self._left.get(name, 0) + 1 for name in open_now - followed}
        self._close_topics(
            {name for name, periods in self._left.items() if periods >= CLOSING_PERIODS}
        )

    def _close_topics(self, people: set[str]) -> None:
        """Closes the topics of people who have left."""
        with self._opening:
            closed = {topic: x for topic, x in self._outputs.items() if person_of(topic) in people}
            self._outputs = {
                topic: publisher
                for topic, publisher in self._outputs.items()
                if topic not in closed
            }
            for publisher in closed.values():
                self.destroy_lifecycle_publisher(publisher)


def main(args: list[str] | None = None) -> int:
    """See `run`."""
    return run(PeopleNode, args)


if __name__ == '__main__':
    sys.exit(main())
