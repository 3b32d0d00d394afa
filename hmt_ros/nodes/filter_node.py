"""filter_node: images in, mixtures over poses out; a lifecycle node around a `TrackingSession`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from hmt_msgs.srv import ForecastPose, Reset

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.tracking_node import TrackingNode
from hmt_ros.sessions.track_start import TrackStart, prepare_start
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools.messages.headers import time_ns


class FilterNode(TrackingNode):
    """The node; its parameters are the fields of `FilterParameters`."""

    NAME = 'filter_node'
    SUBJECT = 'track'
    SESSION = TrackingSession
    DEFAULTS = FilterParameters()

    def _in_namespace(self, defaults: FilterParameters) -> FilterParameters:
        """Prefixes frames with the namespace, so that each person has separate frames."""
        namespace = self.get_namespace().strip('/')
        return replace(defaults, frame_prefix=f'{namespace}/') if namespace else defaults

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield from super()._offered_services()
        yield ForecastPose, '~/forecast_pose', self._on_forecast_pose

    def _start_asked_for(self, request: Reset.Request) -> TrackStart:
        assert self._session is not None
        present = self._session.state.body
        return prepare_start(self._settings, request.initial, present, request.box)

    def _on_forecast_pose(
        self, request: ForecastPose.Request, response: ForecastPose.Response
    ) -> Any:
        return self._answer(
            response, 'mixture', lambda session: session.forecast(time_ns(request.stamp))
        )


def main(args: list[str] | None = None) -> int:
    """See `run`."""
    return run(FilterNode, args)


if __name__ == '__main__':
    sys.exit(main())
