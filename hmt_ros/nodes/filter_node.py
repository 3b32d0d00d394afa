"""filter_node: images in, mixtures over poses out; a lifecycle node around a `FilterSession`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from hmt_msgs.srv import Reset

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import (
    CAMERA_INFO_TOPIC,
    DEPTH_TOPIC,
    MASK_TOPICS,
    RELIABLE,
    TRANSFORM_TOPICS,
    SubscribedTopic,
    image_topic,
)
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.filter_session import KEYPOINTS, KEYPOINTS_3D, PREDICTION, FilterSession
from hmt_ros.sessions.track_start import prepare_start
from msg_tools.files.error_line import error_line
from msg_tools.messages import keypoints


class FilterNode(SessionNode[FilterSession, FilterParameters]):
    """The node; its parameters are the fields of `FilterParameters`."""

    NAME = 'filter_node'
    SUBJECT = 'track'
    SESSION = FilterSession
    DEFAULTS = FilterParameters()

    def _in_namespace(self, defaults: FilterParameters) -> FilterParameters:
        """Persons in namespaces have frames of their own."""
        namespace = self.get_namespace().strip('/')
        return replace(defaults, frame_prefix=f'{namespace}/') if namespace else defaults

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        yield Reset, '~/reset', self._on_reset

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield CAMERA_INFO_TOPIC
        yield SubscribedTopic(KEYPOINTS, KEYPOINTS, keypoints.KEYPOINTS_2D)
        yield SubscribedTopic(KEYPOINTS_3D, KEYPOINTS_3D, keypoints.KEYPOINTS_3D)
        yield SubscribedTopic(PREDICTION, 'pose_prediction', 'hmt_msgs/msg/PoseMixture', RELIABLE)
        yield from MASK_TOPICS
        yield DEPTH_TOPIC
        if self._session is not None and self._session.frames.wanted:
            yield from TRANSFORM_TOPICS
        yield image_topic(self._settings.image_transport)

    def _on_reset(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        session, thread = self._session, self._thread
        if session is None or thread is None:
            response.success, response.message = False, 'the node is not active'
            return response
        try:
            start = prepare_start(
                session.parameters, request.initial, session.state.body, request.box
            )
        except ValueError as error:
            response.success, response.message = False, error_line(error)
            self.get_logger().warn(f'~/reset is refused: {response.message}')
            return response
        thread.restart(lambda: session.restart(start))
        response.success = True
        sources = start.parameters.sources
        if start.box is not None or start.initial is not None:
            response.message = 'the next image starts a new track'
        elif sources:
            response.message = f'the next image with {" or ".join(sources)} starts a new track'
        else:
            response.message = (
                'the track is dropped; nothing starts a new one without subject_file, '
                'use_keypoints, use_mask or use_predictions'
            )
        self.get_logger().info(f'~/reset: {response.message}')
        return response


def main(args: list[str] | None = None) -> int:
    """Runs the node until a signal stops it; returns 0, or 1 if it could not start."""
    return run(FilterNode, args)


if __name__ == '__main__':
    sys.exit(main())
