"""smoother_node: likelihood mixtures in, smoothed poses and trajectories out; around a session.

A node can not detect the end of a stream. When it is deactivated, it publishes the remaining poses
and a report on `~/handled` with the source 'finish'.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import Any

from hmt_msgs.srv import SmoothWindow

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import SubscribedTopic, mixture_topic
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from msg_tools.messages.headers import time_ns


class SmootherNode(SessionNode[SmootherSession, SmootherParameters]):
    """The node; its parameters are the fields of `SmootherParameters`."""

    NAME = 'smoother_node'
    SUBJECT = 'smoothing'
    SESSION = SmootherSession
    DEFAULTS = SmootherParameters()
    CAN_WAIT = True

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield SmoothWindow, '~/smooth_window', self._on_smooth_window

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield mixture_topic(MIXTURE, 'likelihood_mixture')

    def _on_smooth_window(
        self, request: SmoothWindow.Request, response: SmoothWindow.Response
    ) -> Any:
        # Mixtures that arrive meanwhile wait in the middleware or in the queue.
        def smooth(session: SmootherSession) -> Any:
            span = time_ns(request.from_time), time_ns(request.to_time)
            return session.smooth_span(*span, self.get_logger().info)

        return self._answer(response, 'trajectories', smooth)


def main(args: list[str] | None = None) -> int:
    """See `run`."""
    return run(SmootherNode, args)


if __name__ == '__main__':
    sys.exit(main())
