"""hri_node: mixtures of people in, the topics and frames of REP 155 out; around a session.

The topics of a body exist as long as the body. Four times a second the node subscribes to mixtures
in new namespaces, and unsubscribes from topics without a publisher.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import (
    CAMERA_INFO_TOPIC,
    SubscribedTopic,
    image_topic,
    message_class,
    mixture_topic,
    published_with,
)
from hmt_ros.sessions.handled import Handled, Output
from hmt_ros.sessions.hri_parameters import HriParameters
from hmt_ros.sessions.hri_session import (
    BODIES,
    HriSession,
    mixture_source,
    published_topic,
)
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.humans import IDS
from msg_tools.messages.pose_mixtures import POSE_MIXTURE

_URDF = 'urdf'
# Maximum number of subscribed topics, and period of the search for people, s.
_MAX_TOPICS = 64
_SEARCH_PERIOD = 0.25


class HriNode(SessionNode[HriSession, HriParameters]):
    """The node; its parameters are the fields of `HriParameters`.

    For each body the node declares a parameter `human_description_<id>` with the URDF (REP 155).
    """

    NAME = 'hri_node'
    SUBJECT = 'bodies'
    SESSION = HriSession
    DEFAULTS = HriParameters()

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # Publishers for the bodies, by topic. Only the estimating thread uses them.
        self._of_bodies: dict[str, Any] = {}
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._search = self.create_timer(_SEARCH_PERIOD, self._find_people, clock=steady)

    def _messages_of_others(self, settings: HriParameters) -> Mapping[str, str]:
        return {IDS: 'hri_node'}

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        p = self._settings
        yield CAMERA_INFO_TOPIC
        if p.publish_cropped:
            yield image_topic(p.image_transport)
        for namespace in p.named or self._found():
            yield self._mixtures_in(namespace)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribes to the inputs and searches for people."""
        result = super().on_activate(state)
        self._find_people()
        return result

    # Subscriptions to people.

    def _mixtures_in(self, namespace: str) -> SubscribedTopic:
        topic = f'{namespace.rstrip("/")}/{self._settings.mixture_topic}'
        return mixture_topic(mixture_source(namespace), topic)

    def _found(self) -> list[str]:
        """Namespaces below /humans/bodies with published mixtures."""
        end = f'/{self._settings.mixture_topic}'
        return sorted(
            topic.removesuffix(end)
            for topic, kinds in self.get_topic_names_and_types()
            if topic.startswith(f'{BODIES}/') and topic.endswith(end) and POSE_MIXTURE in kinds
        )

    def _find_people(self) -> None:
        if self._estimator is None or self._settings.named or not self._heard:
            return
        end = f'/{self._settings.mixture_topic}'
        for name, subscription in list(self._connected.items()):
            if name.endswith(end) and not subscription.get_publisher_count():
                self._hand_over(name)
        for namespace in self._found():
            one = self._mixtures_in(namespace)
            if self._local_name(one.topic) in self._heard:
                continue
            if len(self._heard) >= _MAX_TOPICS:
                self.get_logger().warn(
                    f'the limit of {_MAX_TOPICS} subscribed topics is reached: mixtures in '
                    f'{namespace} are ignored; name those to use in the parameter namespaces',
                    once=True,
                )
                return
            self._subscribe(one)
            self.get_logger().info(f'mixtures from {one.topic}')

    # Publishers of bodies; called by the estimating thread.

    def _publisher_of(self, topic: str) -> Any:
        if topic in self._outputs:
            return self._outputs[topic]
        if topic not in self._of_bodies:
            msgtype, qos = published_with(published_topic(topic))
            self._of_bodies[topic] = self.create_publisher(
                message_class(msgtype),
                topic,
                qos,
                # No event handlers, because the executor's thread would call them.
                event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            )
        return self._of_bodies[topic]

    def _publish(self, output: Output) -> None:
        self._publisher_of(output.topic).publish(output.data)
        identity, _, name = output.topic.removeprefix(f'{BODIES}/').partition('/')
        if name == _URDF:
            text = str(deserialise(output.data, 'std_msgs/msg/String').data)
            parameter = f'human_description_{identity}'
            if self.has_parameter(parameter):
                self.set_parameters([Parameter(parameter, value=text)])
            else:
                self.declare_parameter(parameter, text)

    def _is_wanted(self, topic: str) -> bool:
        return bool(self._publisher_of(topic).get_subscription_count())

    def _report_handled(self, handled: Handled) -> None:
        super()._report_handled(handled)
        session = self._session
        self._forget_bodies(set() if session is None else session.identities)

    def _forget_bodies(self, kept: set[str]) -> None:
        """Deletes the topics and parameters of bodies that have ended."""
        for topic in list(self._of_bodies):
            identity, _, name = topic.removeprefix(f'{BODIES}/').partition('/')
            if identity in kept:
                continue
            self.destroy_publisher(self._of_bodies.pop(topic))
            if name == _URDF:
                self.undeclare_parameter(f'human_description_{identity}')

    def _close(self) -> None:
        super()._close()
        self._forget_bodies(set())


def main(args: list[str] | None = None) -> int:
    """See `run`."""
    return run(HriNode, args)


if __name__ == '__main__':
    sys.exit(main())
