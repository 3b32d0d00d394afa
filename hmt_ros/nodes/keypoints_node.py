"""keypoints_node: images in, keypoints of a detector out; a node around a `KeypointsSession`."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import SubscribedTopic, image_topic
from hmt_ros.sessions.image_inputs import DETECTIONS, KEYPOINTS, KEYPOINTS_3D, MASK
from hmt_ros.sessions.keypoints_session import KeypointsParameters, KeypointsSession


class KeypointsNode(SessionNode[KeypointsSession, KeypointsParameters]):
    """The node; its parameters are the fields of `KeypointsParameters`."""

    NAME = 'keypoints_node'
    SUBJECT = 'detection'
    SESSION = KeypointsSession
    DEFAULTS = KeypointsParameters()

    def _offered_topics(self) -> Iterable[str]:
        p = self._settings
        if p.people:
            return (DETECTIONS,)
        return (KEYPOINTS, KEYPOINTS_3D, MASK) if p.publish_mask else (KEYPOINTS, KEYPOINTS_3D)

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield image_topic(self._settings.image_transport)


def main(args: list[str] | None = None) -> int:
    """Runs the node until a signal stops it; returns 0, or 1 if it could not start."""
    return run(KeypointsNode, args)


if __name__ == '__main__':
    sys.exit(main())
