"""people_adapter_node: mixtures in, people as other packages know them out.

It publishes the installed types: people_msgs/People, vision_msgs/Detection3DArray, or both.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from importlib.util import find_spec

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import SubscribedTopic, mixture_topic
from hmt_ros.sessions.people_adapter_parameters import PeopleAdapterParameters
from hmt_ros.sessions.people_adapter_session import MIXTURE, TOPICS, PeopleAdapterSession

_PACKAGES = {topic: published.msgtype.partition('/')[0] for topic, published in TOPICS.items()}
_INSTALLED = {
    topic: published for topic, published in TOPICS.items() if find_spec(_PACKAGES[topic])
}


class InstalledPeopleAdapterSession(PeopleAdapterSession):
    """An adapter that publishes the messages that are installed; see `PeopleAdapterSession`."""

    TOPICS = _INSTALLED


class PeopleAdapterNode(SessionNode[PeopleAdapterSession, PeopleAdapterParameters]):
    """The node; its parameters are the fields of `PeopleAdapterParameters`."""

    NAME = 'people_adapter_node'
    SUBJECT = 'people'
    SESSION = InstalledPeopleAdapterSession
    DEFAULTS = PeopleAdapterParameters()

    def _messages_of_others(self, settings: PeopleAdapterParameters) -> Mapping[str, str]:
        if not self.SESSION.TOPICS:
            raise ValueError(
                f'people_adapter_node needs one of the packages {" and ".join(_PACKAGES.values())}'
                ', but none is installed: install one, or build and source its workspace'
            )
        return {one.msgtype: 'people_adapter_node' for one in self.SESSION.TOPICS.values()}

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        if not self._settings.named:
            yield mixture_topic(MIXTURE, MIXTURE)
        for namespace in self._settings.named:
            topic = f'{namespace.rstrip("/")}/{MIXTURE}'
            yield mixture_topic(topic, topic)


def main(args: list[str] | None = None) -> int:
    """See `run`."""
    return run(PeopleAdapterNode, args)


if __name__ == '__main__':
    sys.exit(main())
