"""bme_node: images in, mixtures over poses out; a lifecycle node around a `BmeSession`."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hmt_msgs.msg import PoseMixture
from hmt_msgs.srv import PredictPose
from rclpy.serialization import deserialize_message

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import SubscribedTopic, camera_info_topic, image_topic
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.bme_session import TOPICS, BmeSession, BmeState
from hmt_ros.sessions.camera_input import IMAGE
from hmt_ros.sessions.handled import Output
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import serialise

NAME = 'bme_node'
_CHECKED = ('model_file', 'background_file', 'stature')


class BmeNode(SessionNode):
    """The node; parameters are those of `BmeParameters`."""

    TOPICS = TOPICS
    CLASSES = {'hmt_msgs/msg/PoseMixture': PoseMixture}  # noqa: RUF012
    COUNTED = IMAGE
    COUNTED_NAME = 'images'
    DONE = 'predicted'

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, BmeParameters(), 'prediction', **options)

    def _new_session(
        self, publish: Callable[[Output], None], wanted: Callable[[str], bool]
    ) -> BmeSession:
        return BmeSession(self._settings, publish, wanted)

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield PredictPose, '~/predict_pose', self._on_predict_pose

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield camera_info_topic()
        yield image_topic(self._settings.image_transport)

    def _check_changed(self, settings: BmeParameters, changed: Mapping[str, Any]) -> None:
        if any(name in changed for name in _CHECKED):
            BmeSession(settings, lambda output: None)

    def _on_predict_pose(
        self, request: PredictPose.Request, response: PredictPose.Response
    ) -> PredictPose.Response:
        session = self._session
        if session is None:
            response.success, response.message = False, 'the node is not configured'
            return response
        image = request.image if len(request.image.data) else request.compressed_image
        try:
            if not len(image.data):
                raise ValueError('the request has no image: fill image or compressed_image')
            data = serialise(session.predict_once(image))
        except (ValueError, ArithmeticError) as error:
            response.success, response.message = False, error_line(error)
            return response
        response.success = True
        response.mixture = deserialize_message(data, PoseMixture)
        return response

    def _counts(self, state: BmeState) -> Counter[str]:
        return state.images

    def _summary(self, state: BmeState) -> str:
        return f'{state.modes} modes'

    def _state_values(self, state: BmeState) -> list[tuple[str, str]]:
        return [
            ('images without a person', str(state.images['empty'])),
            ('modes', str(state.modes)),
            ('entropy of the weights, nats', f'{state.entropy:.3f}'),
            ('height of the silhouette, px', str(state.height)),
            ('support', f'{state.support:.3f}'),
        ]


def main(args: list[str] | None = None) -> int:
    """Runs the node until it is told to stop; 0, or 1 where it could not start."""
    return run(NAME, BmeNode, args)


if __name__ == '__main__':
    sys.exit(main())
