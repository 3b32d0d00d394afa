"""keypoints_adapter_node: messages of other detectors in, keypoints of one person out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import CAMERA_INFO_TOPIC, SubscribedTopic
from hmt_ros.sessions.keypoints_adapter_parameters import SOURCES, KeypointsAdapterParameters
from hmt_ros.sessions.keypoints_adapter_session import DETECTIONS, KeypointsAdapterSession


class KeypointsAdapterNode(SessionNode[KeypointsAdapterSession, KeypointsAdapterParameters]):
    """The node; its parameters are the fields of `KeypointsAdapterParameters`."""

    NAME = 'keypoints_adapter_node'
    SUBJECT = 'adapter'
    SESSION = KeypointsAdapterSession
    DEFAULTS = KeypointsAdapterParameters()

    def _messages_of_others(self, settings: KeypointsAdapterParameters) -> Mapping[str, str]:
        return {SOURCES[settings.source]: f'source {settings.source}'}

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        return ()

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield CAMERA_INFO_TOPIC
        yield SubscribedTopic(DETECTIONS, DETECTIONS, SOURCES[self._settings.source])


def main(args: list[str] | None = None) -> int:
    """Runs the node until a signal stops it; returns 0, or 1 if it could not start."""
    return run(KeypointsAdapterNode, args)


if __name__ == '__main__':
    sys.exit(main())
