"""filter_node: images in, mixtures over poses out; a lifecycle node around a `FilterSession`."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from hmt_msgs.msg import Body, Keypoints2D, PoseMixture
from hmt_msgs.srv import Reset
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import (
    RELIABLE,
    SubscribedTopic,
    camera_info_topic,
    image_topic,
)
from hmt_ros.sessions.camera_input import IMAGE
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.filter_session import (
    KEYPOINTS,
    PREDICTION,
    FilterSession,
    SessionState,
)
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.track_messages import TOPICS
from hmt_ros.sessions.track_start import prepare_start
from msg_tools.files.error_line import error_line

NAME = 'filter_node'
_FILES = ('subject_file', 'background_file', 'body_model')


class FilterNode(SessionNode):
    """The node; parameters are those of `FilterParameters`."""

    TOPICS = TOPICS
    CLASSES = {  # noqa: RUF012
        'hmt_msgs/msg/Body': Body,
        'hmt_msgs/msg/PoseMixture': PoseMixture,
        'std_msgs/msg/String': String,
        'sensor_msgs/msg/JointState': JointState,
        'sensor_msgs/msg/CompressedImage': CompressedImage,
        'visualization_msgs/msg/MarkerArray': MarkerArray,
        'tf2_msgs/msg/TFMessage': TFMessage,
    }
    COUNTED = IMAGE
    COUNTED_NAME = 'images'
    DONE = 'tracked'

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, FilterParameters(), 'track', **options)

    def _new_session(
        self, publish: Callable[[Output], None], wanted: Callable[[str], bool]
    ) -> FilterSession:
        return FilterSession(self._settings, publish, wanted)

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield Reset, '~/reset', self._on_reset

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield camera_info_topic()
        kind = 'hmt_msgs/msg/Keypoints2D'
        yield SubscribedTopic(KEYPOINTS, 'keypoints', Keypoints2D, kind, qos_profile_sensor_data)
        kind = 'hmt_msgs/msg/PoseMixture'
        yield SubscribedTopic(PREDICTION, 'pose_prediction', PoseMixture, kind, RELIABLE)
        yield image_topic(self._settings.image_transport)

    def _check_changed(self, settings: FilterParameters, changed: Mapping[str, Any]) -> None:
        if any(name in changed for name in _FILES):
            prepare_start(settings)

    def _on_reset(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        session, thread = self._session, self._thread
        if session is None or thread is None:
            response.success, response.message = False, 'the node is not active'
            return response
        try:
            start = prepare_start(self._settings, request.initial, session.state.body)
        except ValueError as error:
            response.success, response.message = False, error_line(error)
            return response
        thread.restart(start)
        response.success = True
        if start.initial is None and self._settings.use_predictions:
            response.message = 'the next pose_prediction starts a new track'
        elif start.initial is None:
            response.message = 'the track is dropped; nothing starts a new one without subject_file'
        else:
            response.message = 'the next image starts a new track'
        return response

    def _counts(self, state: SessionState) -> Counter[str]:
        return state.images

    def _summary(self, state: SessionState) -> str:
        return f'{state.modes} modes'

    def _judgement(self, state: SessionState) -> tuple[bytes, str]:
        if state.status == 'lost':
            return DiagnosticStatus.WARN, f'lost: misfit {state.misfit:.2f}'
        return super()._judgement(state)

    def _state_values(self, state: SessionState) -> list[tuple[str, str]]:
        return [
            ('modes', str(state.modes)),
            ('entropy of the weights, nats', f'{state.entropy:.3f}'),
            ('misfit', f'{state.misfit:.3f}'),
            ('evaluations of the likelihood', str(state.evaluations)),
        ]


def main(args: list[str] | None = None) -> int:
    """Runs the node until it is told to stop; 0, or 1 where it could not start."""
    return run(NAME, FilterNode, args)


if __name__ == '__main__':
    sys.exit(main())
