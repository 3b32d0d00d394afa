"""BME, filter and smoother take the messages of a bag, offline or as real nodes.

The BME takes each image before the filter, which takes the `pose_prediction` of the BME; the
smoother takes the `likelihood_mixture` of the filter, and the BME its `pose_mixture` if it is to
predict less often while the person is tracked; then the next message follows. At the end of
the bag they finish, in the same order: no message announces the end, so nodes are deactivated.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from typing import Any, Protocol

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
from hmt_ros.sessions.session import FINISH
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.sessions.transform_buffer import TRANSFORMS, TRANSFORMS_TYPE

PERSON = 'person_node'
# Topics of the filter that the smoother takes, as sources of the same names.
HANDED_ON = (MIXTURE,)

Write = Callable[[str, int, bytes], None]


class PlayedTrack(AbstractContextManager['PlayedTrack'], Protocol):
    """Takes the messages of a bag one after the other; a context manager."""

    def take(self, source: str, message: Any) -> Handled:
        """Hands a message over and returns when all its results are written."""

    def finish(self) -> Handled:
        """Returns when the results that waited for more messages are written."""


class OfflineTrack(PlayedTrack):
    """Without ROS.

    Args:
        write: takes topic, stamp and bytes of each published message.

    Raises:
        ValueError: the parameters name a file that can not be used.
    """

    def __init__(self, parameters: NodeParameters, write: Write) -> None:
        self._write = write
        self._predicted: list[Output] = []
        self._handed: list[Output] = []
        self._bme = self._smoother = None
        if parameters.bme is not None:
            self._bme = BmeSession(parameters.bme, self._predict, bme_session.TOPICS.__contains__)
        self._seen, self._heard = _seen_by_bme(parameters), _heard_by_bme(parameters)
        kind = session_of(parameters.filter)
        self._filter = kind(parameters.filter, self._filtered, _is_recorded)
        if parameters.smoother is not None:
            self._smoother = SmootherSession(parameters.smoother, lambda output: write(*output))

    def __exit__(self, *_: object) -> None:
        """See `PlayedTrack`; nothing is open."""

    def take(self, source: str, message: Any) -> Handled:
        """See `PlayedTrack`."""
        result = None
        if self._bme is not None and source in self._seen:
            result = self._hand_to_filter(self._bme.take(source, message))
        return self._hand_on(_together(result, self._filter.take(source, message)))

    def finish(self) -> Handled:
        """See `PlayedTrack`."""
        result = None
        if self._bme is not None:
            result = self._hand_to_filter(self._bme.finish())
        result = self._hand_on(_together(result, self._filter.finish()))
        return result if self._smoother is None else _together(result, self._smoother.finish())

    def _hand_to_filter(self, result: Handled) -> Handled:
        """Hands the predictions to the filter."""
        predicted, self._predicted = self._predicted, []
        for output in predicted:
            result = _together(result, self._filter.take(PREDICTION, output.message))
        return result

    def _hand_on(self, result: Handled) -> Handled:
        """Hands the messages of the filter to smoother and BME."""
        handed, self._handed = self._handed, []
        for output in handed:
            topic, message = output.topic, output.message
            if self._smoother is not None and topic in HANDED_ON:
                result = _together(result, self._smoother.take(topic, message))
            if self._bme is not None and topic in self._heard:
                result = _together(result, self._hand_to_filter(self._bme.take(topic, message)))
        return result

    def _predict(self, output: Output) -> None:
        self._write(*output)
        self._predicted.append(output)

    def _filtered(self, output: Output) -> None:
        self._write(*output)
        if output.topic in HANDED_ON or output.topic in self._heard:
            self._handed.append(output)


class LiveTrack(PlayedTrack):
    """The real nodes, over DDS in lock step.

    Args:
        together: whether the nodes run in one process.

    Raises:
        LiveNodeError: there is no ROS, or a node does not start, answer or end.
    """

    def __init__(self, parameters: NodeParameters, write: Write, *, together: bool = False) -> None:
        self._parameters, self._write, self._together = parameters, write, together
        self._seen, self._heard = _seen_by_bme(parameters), _heard_by_bme(parameters)
        self._bme: LiveNode | None = None
        self._smoother: LiveNode | None = None

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
            # Topics of the namespace that both share: none of their messages must be lost.
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
                # Nodes of one process listen once.
                self._filter.wait_until_heard(self._seen, 1 if self._together else 2)
                self._filter.wait_for_subscribers(self._heard, 2)
            if self._smoother is not None:
                self._smoother.wait_until_active()
                self._filter.wait_for_subscribers(HANDED_ON, 2)
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
        result = None
        if self._bme is not None and source in self._seen:
            result = self._answers_to_predictions(self._bme.answer(source))
        return self._answers_to_mixtures(_together(result, self._filter.answer(source)))

    def finish(self) -> Handled:
        """See `PlayedTrack`."""
        result = None
        if self._bme is not None:
            self._bme.deactivate()
            result = self._answers_to_predictions(self._bme.answer(FINISH))
        self._filter.deactivate()
        result = _together(result, self._filter.answer(FINISH))
        if self._smoother is None:
            return result
        for topic, _ in result.published:
            if topic in HANDED_ON:
                result = _together(result, self._smoother.answer(topic))
        self._smoother.deactivate()
        return _together(result, self._smoother.answer(FINISH))

    def _answers_to_predictions(self, result: Handled) -> Handled:
        """The filter gets the prediction as well, before or after its image."""
        for topic, _ in result.published:
            result = _together(result, self._filter.answer(topic))
        return result

    def _answers_to_mixtures(self, result: Handled) -> Handled:
        for topic, _ in result.published:
            if self._smoother is not None and topic in HANDED_ON:
                result = _together(result, self._smoother.answer(topic))
            if self._bme is not None and topic in self._heard:
                predicted = self._answers_to_predictions(self._bme.answer(topic))
                result = _together(result, predicted)
        return result


def _is_recorded(topic: str) -> bool:
    """Whether bags have a topic of a session that tracks."""
    return topic.rpartition('/')[2] not in track_messages.TOPICS_OF_NODE.keys() - (
        track_messages.TOPICS.keys()
    )


def _seen_by_bme(parameters: NodeParameters) -> tuple[str, ...]:
    """Sources in the bag that the BME takes."""
    if parameters.bme is None:
        return ()
    images = () if parameters.bme.predict_from == FROM_KEYPOINTS else (IMAGE,)
    given = (source for row in BmeSession.inputs_of(parameters.bme) for source in row.types)
    return (CAMERA_INFO, *images, *given)


def _heard_by_bme(parameters: NodeParameters) -> tuple[str, ...]:
    """Topics of the filter that the BME takes, as sources of the same names."""
    hears = parameters.bme is not None and parameters.bme.tracked_interval > 0
    return (TRACK,) if hears else ()


def _together(one: Handled | None, other: Handled) -> Handled:
    """The handling of a message and of one that it led to, in one record."""
    if one is None:
        return other
    return Handled(
        one.source,
        one.stamp_ns,
        one.faults + other.faults,
        one.warnings + other.warnings,
        one.published + other.published,
    )
