"""The bodies of the mixtures in a bag, and the ground.

A mixture with segment lengths defines its own body. A mixture of another publisher may lack
lengths; its body is then from the Body topic in the same namespace, or else from the only Body
topic of the bag.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from hmt_ros.body import Body, load_body, named_body
from msg_tools import BagMessage, BagReader
from msg_tools.messages.bodies import body_of, resized
from msg_tools.messages.ground import GROUND, GroundState, ground_of
from msg_tools.messages.message_error import MessageError, lengths_of
from msg_tools.messages.pose_mixtures import PoseMixture
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture

BODY = 'hmt_msgs/msg/Body'


def topic_beside(bag: BagReader, msgtype: str, topic: str) -> str | None:
    """Topic of a type in the namespace of a given topic, or else the only topic of this type."""
    names = [x.name for x in bag.topics_of(msgtype)]
    chosen = [name for name in names if _namespace(name) == _namespace(topic)] or names
    return chosen[0] if len(chosen) == 1 else None


class RecordedBodies:
    """The bodies of the mixtures in a bag.

    Args:
        model: name or file of the body model, which replaces the name in the bag; None uses the
            name in the bag.
    """

    def __init__(self, model: str | None) -> None:
        self._model = model
        self._described: dict[str, Body] = {}
        self._newest: dict[str, tuple[Any, Body]] = {}

    def messages(
        self, bag: BagReader, topics: Iterable[str], progress: Callable[[int], object]
    ) -> Iterator[BagMessage]:
        """Yields the messages on mixture topics, and stores the bodies from Body messages.

        Args:
            progress: called with the number of messages that were read.

        Raises:
            ValueError: an invalid Body message, or the bag is damaged.
        """
        bodies = [x.name for x in bag.topics_of(BODY)]
        for stored in bag.messages([*bodies, *topics]):
            progress(1)
            if stored.msgtype == BODY:
                self._learn(stored)
            else:
                yield stored

    def _learn(self, stored: BagMessage) -> None:
        """Stores the body from a Body message, unless its model is unknown."""
        message = stored.message
        try:
            body = resized(self._model_of(str(message.name)), lengths_of(message, 'body'))
        except FileNotFoundError:
            if self._model is not None:
                raise
            return
        except MessageError as error:
            raise ValueError(f'topic {stored.topic}: {error}') from error
        self._described[_namespace(stored.topic)] = body

    def of(self, topic: str, content: PoseMixture | TrajectoryMixture) -> Body | None:
        """Body of a mixture on a topic, None if unknown; the same object until the body changes."""
        if not content.segment_lengths:
            body = self._described.get(_namespace(topic))
            if body is None and len(self._described) == 1:
                body = next(iter(self._described.values()))
            return body if body is not None and body.dof_names == content.dof_names else None
        about = content.body_model, content.dof_names, content.segment_lengths
        if topic not in self._newest or self._newest[topic][0] != about:
            try:
                model = self._model_of(content.body_model)
                body = body_of(content, model, any_name=self._model is not None)
            except (FileNotFoundError, MessageError):
                return None
            self._newest[topic] = about, body
        return self._newest[topic][1]

    def _model_of(self, name: str) -> Body:
        """The user's model, or else the shipped model; names in bags are never file names."""
        return named_body(name) if self._model is None else load_body(self._model)


def read_grounds(path: Path, topic: str, frame_id: str) -> dict[int, GroundState]:
    """Reads the ground in a bag, by stamp in ns; empty if the bag has no such topic.

    Args:
        topic: topic of the mixtures; the topic of the ground is in the same namespace, or else the
            bag's only ground topic.
        frame_id: frame of the mixtures; a ground in a different frame is left out.

    Raises:
        ValueError: an invalid message.
    """
    with BagReader(path) as bag:
        chosen = topic_beside(bag, GROUND, topic)
        if chosen is None:
            return {}
        found = {}
        for stored in bag.messages([chosen]):
            content = stored.content(ground_of)
            if content.frame_id == frame_id:
                found[content.stamp_ns] = content
    return found


def _namespace(topic: str) -> str:
    return topic.lstrip('/').rpartition('/')[0]
