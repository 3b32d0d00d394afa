"""Filter and smoother that take the messages of a bag, offline or as real nodes.

The filter takes a message; what it publishes on `body` and `likelihood_mixture` the smoother takes,
in the same order; then the next message follows. At the end of the bag the smoother is told that
there is no more: the node, to which no message says so, is deactivated.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Protocol

from hmt_ros.app.live_node import LiveNode, Player
from hmt_ros.nodes import smoothed_messages, track_messages
from hmt_ros.nodes.camera_input import CAMERA_INFO, IMAGE
from hmt_ros.nodes.filter_parameters import FilterParameters
from hmt_ros.nodes.filter_session import KEYPOINTS, FilterSession
from hmt_ros.nodes.handled import Handled, Output
from hmt_ros.nodes.smoother_parameters import SmootherParameters
from hmt_ros.nodes.smoother_session import BODY, FINISH, MIXTURE, SmootherSession
from msg_tools.cdr import deserialise

FILTER, SMOOTHER = 'filter_node', 'smoother_node'
# What the smoother takes of the filter: topics, which it calls by the same names.
HANDED_ON = (BODY, MIXTURE)

Write = Callable[[str, int, bytes], None]


class PlayedTrack(Protocol):
    """Takes the messages of a bag, one after the other; a context manager."""

    def __enter__(self) -> PlayedTrack:
        """Starts."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Ends."""

    def take(self, source: str, message: Any) -> Handled:
        """Hands a message over and returns when all that it leads to is written."""

    def finish(self) -> Handled:
        """Returns when all is written that waited for more messages."""


class OfflineTrack:
    """Without ROS.

    Args:
        parameters: of the filter.
        smoothing: of the smoother; None: none.
        write: takes topic, stamp and bytes of all that is published.
    """

    def __init__(
        self, parameters: FilterParameters, smoothing: SmootherParameters | None, write: Write
    ) -> None:
        self._write = write
        self._handed: list[Output] = []
        self._filter = FilterSession(parameters, self._filtered)
        self._smoother = None
        if smoothing is not None:
            self._smoother = SmootherSession(smoothing, lambda output: write(*output))

    def __enter__(self) -> OfflineTrack:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        pass

    def take(self, source: str, message: Any) -> Handled:
        """See `PlayedTrack`."""
        result = self._filter.take(source, message)
        handed, self._handed = self._handed, []
        if self._smoother is not None:
            for topic, _, data in handed:
                read = deserialise(data, track_messages.TOPICS[topic].msgtype)
                result = _together(result, self._smoother.take(topic, read))
        return result

    def finish(self) -> Handled:
        """See `PlayedTrack`."""
        if self._smoother is None:
            return Handled(FINISH, 0, (), (), ())
        return self._smoother.finish()

    def _filtered(self, output: Output) -> None:
        self._write(*output)
        if output.topic in HANDED_ON:
            self._handed.append(output)


class LiveTrack:
    """The real nodes, over DDS in lock step.

    Args:
        parameters: of the filter.
        smoothing: of the smoother; None: it is not started.
        write: takes topic, stamp and bytes of all that is published, in the order of the nodes.

    Raises:
        LiveNodeError: there is no ROS, or a node does not start, answer or end.
    """

    def __init__(
        self, parameters: FilterParameters, smoothing: SmootherParameters | None, write: Write
    ) -> None:
        self._parameters, self._smoothing, self._write = parameters, smoothing, write
        self._smoother: LiveNode | None = None

    def __enter__(self) -> LiveTrack:
        with ExitStack() as opened:
            player = Player(opened)
            kind = 'Image'
            topic = 'image'
            if self._parameters.image_transport == 'compressed':
                kind, topic = 'CompressedImage', 'image/compressed'
            self._filter = LiveNode(
                player,
                opened,
                FILTER,
                self._parameters,
                inputs={
                    CAMERA_INFO: ('camera_info', 'sensor_msgs/msg/CameraInfo'),
                    KEYPOINTS: ('keypoints', 'hmt_msgs/msg/Keypoints2D'),
                    IMAGE: (topic, f'sensor_msgs/msg/{kind}'),
                },
                topics=track_messages.TOPICS,
                sensors=(f'/{topic}', '/camera_info', '/keypoints'),
                write=self._write,
            )
            if self._smoothing is not None:
                self._smoother = LiveNode(
                    player,
                    opened,
                    SMOOTHER,
                    self._smoothing,
                    inputs={},
                    topics=smoothed_messages.TOPICS,
                    write=self._write,
                )
            self._filter.wait_until_active()
            if self._smoother is not None:
                self._smoother.wait_until_active()
                self._filter.wait_for_subscribers(HANDED_ON, 2)
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._opened:
            if kind is None:
                self._filter.stop_well()
                if self._smoother is not None:
                    self._smoother.stop_well()

    def take(self, source: str, message: Any) -> Handled:
        """See `PlayedTrack`.

        Raises:
            LiveNodeError: a node has ended, or does not answer.
        """
        self._filter.publish(source, message)
        result = self._filter.answer(source)
        if self._smoother is not None:
            handed = [topic for topic, _ in result.published if topic in HANDED_ON]
            for topic in handed:
                result = _together(result, self._smoother.answer(topic))
        return result

    def finish(self) -> Handled:
        """See `PlayedTrack`."""
        if self._smoother is None:
            return Handled(FINISH, 0, (), (), ())
        self._smoother.deactivate()
        return self._smoother.answer(FINISH)


def _together(one: Handled, other: Handled) -> Handled:
    """What became of a message, and of one that it led to."""
    return Handled(
        one.source,
        one.stamp_ns,
        one.faults + other.faults,
        one.warnings + other.warnings,
        one.published + other.published,
    )
