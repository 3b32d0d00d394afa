"""people_adapter_node: mixtures in, people as other packages know them out.

It publishes what is installed: people_msgs/People, vision_msgs/Detection3DArray, or both.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any

from rclpy.qos import QoSProfile, ReliabilityPolicy

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import SubscribedTopic, read_installed_messages
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.people_adapter_parameters import PeopleAdapterParameters
from hmt_ros.sessions.people_adapter_session import MIXTURE, TOPICS, PeopleAdapterSession
from hmt_ros.sessions.session import everything
from msg_tools.messages.pose_mixtures import POSE_MIXTURE

_MIXTURES = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
_PACKAGES = {topic: published.msgtype.partition('/')[0] for topic, published in TOPICS.items()}
_INSTALLED = {
    topic: published for topic, published in TOPICS.items() if find_spec(_PACKAGES[topic])
}


class InstalledPeopleAdapterSession(PeopleAdapterSession):
    """An adapter of the messages that are installed; see `PeopleAdapterSession`.

    Raises:
        ValueError: none is installed.
    """

    TOPICS = _INSTALLED

    def __init__(
        self,
        parameters: PeopleAdapterParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        if not self.TOPICS:
            raise ValueError(
                f'people_adapter_node needs one of the packages {" and ".join(_PACKAGES.values())}'
                ', but none is installed: install one, or build and source its workspace'
            )
        for published in self.TOPICS.values():
            read_installed_messages(published.msgtype, 'people_adapter_node')
        super().__init__(parameters, publish, wanted)


class PeopleAdapterNode(SessionNode[PeopleAdapterSession, PeopleAdapterParameters]):
    """The node; its parameters are the fields of `PeopleAdapterParameters`."""

    NAME = 'people_adapter_node'
    SUBJECT = 'people'
    SESSION = InstalledPeopleAdapterSession
    DEFAULTS = PeopleAdapterParameters()

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        return ()

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        if not self._settings.named:
            yield SubscribedTopic(MIXTURE, MIXTURE, POSE_MIXTURE, _MIXTURES)
        for namespace in self._settings.named:
            topic = f'{namespace.rstrip("/")}/{MIXTURE}'
            yield SubscribedTopic(topic, topic, POSE_MIXTURE, _MIXTURES)


def main(args: list[str] | None = None) -> int:
    """Runs the node until a signal stops it; returns 0, or 1 if it could not start."""
    return run(PeopleAdapterNode, args)


if __name__ == '__main__':
    sys.exit(main())
