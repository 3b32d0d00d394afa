"""bme_node: images in, mixtures over poses out; a lifecycle node around a `BmeSession`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hmt_msgs.srv import PredictPose

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import (
    CAMERA_INFO_TOPIC,
    RELIABLE_QOS,
    SubscribedTopic,
    image_topic,
    input_topics,
    types_of_others,
)
from hmt_ros.sessions.bme_parameters import FROM_KEYPOINTS, BmeParameters
from hmt_ros.sessions.bme_session import TRACK, BmeSession


class BmeNode(SessionNode[BmeSession, BmeParameters]):
    """The node; its parameters are the fields of `BmeParameters`."""

    NAME = 'bme_node'
    SUBJECT = 'prediction'
    SESSION = BmeSession
    DEFAULTS = BmeParameters()

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield PredictPose, '~/predict_pose', self._on_predict_pose

    def _messages_of_others(self, settings: BmeParameters) -> Mapping[str, str]:
        return types_of_others(BmeSession.inputs_of(settings), settings.source)

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield CAMERA_INFO_TOPIC
        if self._settings.tracked_interval > 0:
            yield SubscribedTopic(TRACK, TRACK, 'hmt_msgs/msg/PoseMixture', RELIABLE_QOS)
        assert self._session is not None
        yield from input_topics(self._session.rows)
        if self._settings.predict_from != FROM_KEYPOINTS:
            yield image_topic(self._settings.image_transport)

    def _on_predict_pose(self, request: PredictPose.Request, response: PredictPose.Response) -> Any:
        image = request.image if len(request.image.data) else request.compressed_image

        def predict(session: BmeSession) -> Any:
            if not len(image.data):
                raise ValueError('the request has no image: fill image or compressed_image')
            return session.predict_once(image)

        return self._answer(response, 'mixture', predict)


def main(args: list[str] | None = None) -> int:
    """See `run`."""
    return run(BmeNode, args)


if __name__ == '__main__':
    sys.exit(main())
