"""BME, filter and smoother process the messages of a bag, offline or as real nodes.

The BME gets each image before the filter, which also gets the `pose_prediction` of the BME. The
smoother gets the `likelihood_mixture` of the filter; the BME gets the filter's `pose_mixture` if it
predicts less often while the person is tracked. Then the next message is processed. At the end of
the bag the nodes finish in the same order. No message announces the end; real nodes are deactivated
instead.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict, deque
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from typing import Any

from hmt_ros.app.replay.inputs import CAMERA_INFO_TYPE
from hmt_ros.app.replay.live_node import LiveNode, NodeProcess
from hmt_ros.app.replay.options import BME, FILTER, SMOOTHER, NodeParameters
from hmt_ros.app.replay.player import Player
from hmt_ros.sessions import bme_session, smoothed_messages, track_messages
from hmt_ros.sessions.bme_parameters import FROM_KEYPOINTS
from hmt_ros.sessions.bme_session import TRACK, BmeSession
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.handled import Handled, Output
from hmt_ros.sessions.image_inputs import COMPRESSED_TYPE, IMAGE_TYPE, PREDICTION
from hmt_ros.sessions.people_session import session_of
from hmt_ros.sessions.seen_images import SeenImages
from hmt_ros.sessions.session import FINISH
from hmt_ros.sessions.smoother_parameters import AT_END
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.sessions.transform_buffer import TRANSFORMS, TRANSFORMS_TYPE

PERSON = 'person_node'

Write = Callable[[str, int, bytes], None]


class PlayedTrack(AbstractContextManager['PlayedTrack'], ABC):
    """Processes the messages of a bag one by one; a context manager.

    Args:
        write: called with topic, stamp and bytes of each published message.
    """

    def __init__(self, parameters: NodeParameters, write: Write) -> None:
        self._write = write
        self._bme: Any = None
        self._filter: Any = None
        self._smoother: Any = None
        # Sources in the bag that are passed to the BME.
        self._seen: tuple[str, ...] = ()
        # Filter topics passed to the BME, and to the smoother, as sources of the same names.
        self._heard: tuple[str, ...] = ()
        self._smoothed = () if parameters.smoother is None else (MIXTURE,)
        if (bme := parameters.bme) is not None:
            images = () if bme.predict_from == FROM_KEYPOINTS else (IMAGE,)
            given = (source for row in BmeSession.inputs_of(bme) for source in row.types)
            self._seen = (CAMERA_INFO, *images, *given)
            self._heard = (TRACK,) if bme.tracked_interval > 0 else ()

    @abstractmethod
    def _handled(self, node: Any, source: str, message: Any = None) -> Handled:
        """Passes a message to a node; None passes the oldest queued message of the source."""

    @abstractmethod
    def _finished(self, node: Any) -> Handled:
        """Makes a node handle its waiting messages at the end of the bag."""

    def take(self, source: str, message: Any) -> Handled:
        """Passes a message to the nodes and returns when all results are written."""
        result = None
        if source in self._seen:
            result = self._predicted(self._handled(self._bme, source, message))
        return self._forwarded(_together(result, self._handled(self._filter, source, message)))

    def finish(self) -> Handled:
        """Finishes all nodes and returns when their remaining results are written."""
        result = None
        if self._bme is not None:
            result = self._predicted(self._finished(self._bme))
            self._heard = ()
        result = self._forwarded(_together(result, self._finished(self._filter)))
        if self._smoother is not None:
            result = _together(result, self._finished(self._smoother))
        return result

    def _predicted(self, result: Handled) -> Handled:
        """Passes the predictions to the filter."""
        for topic, _ in result.published:
            result = _together(result, self._handled(self._filter, topic))
        return result

    def _forwarded(self, result: Handled) -> Handled:
        """Passes the messages of the filter to smoother and BME."""
        for topic, _ in result.published:
            if topic in self._smoothed:
                result = _together(result, self._handled(self._smoother, topic))
            if topic in self._heard:
                predicted = self._predicted(self._handled(self._bme, topic))
                result = _together(result, self._forwarded(predicted))
        return result


class OfflineTrack(PlayedTrack):
    """A track without ROS.

    Raises:
        ValueError: the parameters name a file that can not be used.
    """

    def __init__(self, parameters: NodeParameters, write: Write) -> None:
        super().__init__(parameters, write)
        # Queued messages from one node to another, by topic.
        self._messages: defaultdict[str, deque[Any]] = defaultdict(deque)
        if parameters.bme is not None:
            self._bme = BmeSession(parameters.bme, self._publish, bme_session.TOPICS.__contains__)
        kind = session_of(parameters.filter)
        self._filter = kind(parameters.filter, self._publish, _is_recorded)
        if parameters.smoother is not None:
            self._smoother = SmootherSession(parameters.smoother, self._publish)
            if parameters.smoother.refine_on_images == AT_END:
                images = SeenImages()
                self._filter.share(images)
                self._smoother.share(images)

    def __exit__(self, *_: object) -> None:
        """See `PlayedTrack`; there is nothing to close."""

    def _publish(self, output: Output) -> None:
        self._write(*output)
        if output.topic in (PREDICTION, *self._smoothed, *self._heard):
            self._messages[output.topic].append(output.message)

    def _handled(self, node: Any, source: str, message: Any = None) -> Handled:
        """See `PlayedTrack`."""
        return node.take(source, self._messages[source].popleft() if message is None else message)

    def _finished(self, node: Any) -> Handled:
        """See `PlayedTrack`."""
        return node.finish()


class LiveTrack(PlayedTrack):
    """A track with the real nodes, over DDS in lock step.

    Args:
        together: whether the nodes run in one process.

    Raises:
        LiveNodeError: ROS is not available, or a node does not start, answer or end.
    """

    def __init__(self, parameters: NodeParameters, write: Write, *, together: bool = False) -> None:
        super().__init__(parameters, write)
        self._parameters, self._together = parameters, together

    def __enter__(self) -> LiveTrack:
        with ExitStack() as opened:
            player = Player(opened)
            compressed = self._parameters.filter.image_transport == 'compressed'
            topic = 'image/compressed' if compressed else 'image'
            image = topic, COMPRESSED_TYPE if compressed else IMAGE_TYPE
            given = {
                source: (source, msgtype)
                for row in TrackingSession.inputs_of(self._parameters.filter)
                for source, msgtype in row.types.items()
                if source != PREDICTION
            }
            inputs = {CAMERA_INFO: ('camera_info', CAMERA_INFO_TYPE), **given, IMAGE: image}
            if self._parameters.filter.uses_transforms:
                inputs |= {each: (f'/{each}', TRANSFORMS_TYPE) for each in TRANSFORMS}
            process = None
            if self._together:
                every = zip((FILTER, SMOOTHER, BME), self._parameters, strict=True)
                names = [name for name, own in every if own is not None]
                process = NodeProcess(player, opened, PERSON, f'hmt_ros.nodes.{PERSON}', names)
            live = partial(LiveNode, player, opened, within=process, write=self._write)
            # Topics that filter and BME share; all their messages must arrive.
            sensors = (f'/{topic}', '/camera_info', *(f'/{source}' for source in given))
            if self._parameters.bme is not None:
                self._bme = live(
                    BME, self._parameters.bme, inputs={}, topics=bme_session.TOPICS, sensors=sensors
                )
            self._filter = live(
                FILTER,
                self._parameters.filter,
                inputs=inputs,
                topics=track_messages.TOPICS,
                sensors=sensors,
            )
            if self._parameters.smoother is not None:
                self._smoother = live(
                    SMOOTHER, self._parameters.smoother, inputs={}, topics=smoothed_messages.TOPICS
                )
            if process is not None:
                process.start()
            self._filter.wait_until_active()
            if self._bme is not None:
                self._bme.wait_until_active()
                self._bme.wait_for_subscribers((PREDICTION,), 2)
                # Nodes in one process share one subscription.
                self._filter.wait_until_heard(self._seen, 1 if self._together else 2)
                self._filter.wait_for_subscribers(self._heard, 2)
            if self._smoother is not None:
                self._smoother.wait_until_active()
                self._filter.wait_for_subscribers(self._smoothed, 2)
            self._opened = opened.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._opened:
            if kind is None:
                for node in (self._bme, self._filter, self._smoother):
                    if node is not None:
                        node.stop_well()

    def take(self, source: str, message: Any) -> Handled:
        """See `PlayedTrack`.

        Raises:
            LiveNodeError: a node has ended, or does not answer.
        """
        self._filter.publish(source, message)
        return super().take(source, message)

    def _handled(self, node: LiveNode, source: str, message: Any = None) -> Handled:
        """See `PlayedTrack`; the node receives the messages over DDS."""
        return node.answer(source)

    def _finished(self, node: LiveNode) -> Handled:
        """See `PlayedTrack`."""
        node.deactivate()
        return node.answer(FINISH)


def _is_recorded(topic: str) -> bool:
    """Whether a topic of a tracking session is recorded in bags."""
    return topic.rpartition('/')[2] not in track_messages.TOPICS_OF_NODE.keys() - (
        track_messages.TOPICS.keys()
    )


def _together(one: Handled | None, other: Handled) -> Handled:
    """Merges the results for a message and for a further message that it has caused."""
    if one is None:
        return other
    return Handled(
        one.source,
        one.stamp_ns,
        one.faults + other.faults,
        one.warnings + other.warnings,
        one.published + other.published,
    )
