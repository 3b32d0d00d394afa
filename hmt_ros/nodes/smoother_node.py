"""smoother_node: likelihood mixtures in, smoothed poses and trajectories out; a lifecycle node.

Around a `SmootherSession`. Nothing tells a node that a stream has ended: when it is deactivated it
publishes the poses that are still open, and tells of it on `~/handled` under the name 'finish'.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from typing import Any

from hmt_msgs.msg import PoseMixture, TrajectoryMixture
from hmt_msgs.srv import SmoothWindow
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import SubscribedTopic
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.smoothed_messages import TOPICS
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import (
    MIXTURE,
    SmootherSession,
    SmootherState,
    known_body,
)
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_ns

NAME = 'smoother_node'
_MIXTURES = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
# How long the executor waits for a window that is being smoothed before it looks after the others.
_TURN = 0.01  # s


class SmootherNode(SessionNode):
    """The node; parameters are those of `SmootherParameters`."""

    TOPICS = TOPICS
    CLASSES = {  # noqa: RUF012
        'hmt_msgs/msg/PoseMixture': PoseMixture,
        'hmt_msgs/msg/TrajectoryMixture': TrajectoryMixture,
        'sensor_msgs/msg/JointState': JointState,
        'visualization_msgs/msg/MarkerArray': MarkerArray,
    }
    COUNTED = MIXTURE
    COUNTED_NAME = 'mixtures'
    DONE = 'smoothed'

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, SmootherParameters(), 'smoothing', **options)

    def _new_session(
        self, publish: Callable[[Output], None], wanted: Callable[[str], bool]
    ) -> SmootherSession:
        return SmootherSession(self._settings, publish, wanted)

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield SmoothWindow, '~/smooth_window', self._on_smooth_window

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        kind = 'hmt_msgs/msg/PoseMixture'
        yield SubscribedTopic(MIXTURE, 'likelihood_mixture', PoseMixture, kind, _MIXTURES)

    def _check_changed(self, settings: SmootherParameters, changed: Mapping[str, Any]) -> None:
        if changed.get('body_model'):
            known_body(settings.body_model)

    def _finish(self, session: SmootherSession) -> None:
        self._tell(session.finish())

    async def _on_smooth_window(
        self, request: SmoothWindow.Request, response: SmoothWindow.Response
    ) -> SmoothWindow.Response:
        session = self._session
        if session is None:
            response.success, response.message = False, 'the node is not configured'
            return response
        # It may take seconds, in which mixtures arrive.
        found = _Elsewhere(
            lambda: serialise(
                session.smooth_span(time_ns(request.from_time), time_ns(request.to_time))
            )
        )
        try:
            data = await found
        except ValueError as error:
            response.success, response.message = False, error_line(error)
            return response
        response.success = True
        response.trajectories = deserialize_message(data, TrajectoryMixture)
        return response

    def _counts(self, state: SmootherState) -> Counter[str]:
        return state.mixtures

    def _summary(self, state: SmootherState) -> str:
        return f'{state.trajectories} trajectories of {state.window} poses'

    def _state_values(self, state: SmootherState) -> list[tuple[str, str]]:
        return [
            ('poses in the window', str(state.window)),
            ('trajectories', str(state.trajectories)),
            ('entropy of the weights, nats', f'{state.entropy:.3f}'),
            ('gaps', str(state.gaps)),
            ('longest gap, s', f'{state.longest_gap:.3f}'),
        ]


class _Elsewhere:
    """The value of a function that runs in a thread of its own; to be awaited in a callback."""

    def __init__(self, function: Callable[[], bytes]) -> None:
        self._value = b''
        self._error: Exception | None = None
        self._done = threading.Event()

        def work() -> None:
            try:
                self._value = function()
            except Exception as error:  # noqa: BLE001
                # Raised where it is awaited.
                self._error = error
            self._done.set()

        threading.Thread(target=work, name='smooth_window', daemon=True).start()

    def __await__(self) -> Generator[None, None, bytes]:
        while not self._done.wait(_TURN):
            yield
        if self._error is not None:
            raise self._error
        return self._value


def main(args: list[str] | None = None) -> int:
    """Runs the node until it is told to stop; 0, or 1 where it could not start."""
    return run(NAME, SmootherNode, args)


if __name__ == '__main__':
    sys.exit(main())
