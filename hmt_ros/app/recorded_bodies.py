"""The bodies that the mixtures in a bag are of, as the bag itself tells or as their joints do."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import Body, load_body, named_body
from msg_tools import BagMessage, BagReader
from msg_tools.messages.pose_mixtures import PoseMixture

BODY = 'hmt_msgs/msg/Body'
# Positions of joints in a message agree with the body's kinematics up to this, m.
SAME_PLACE = 1e-3


def body_topics(bag: BagReader) -> list[str]:
    """Topics of a bag on which bodies are described."""
    return [topic.name for topic in bag.topics.values() if topic.msgtype == BODY]


class RecordedBodies:
    """The bodies that a bag has described so far, by the namespace of their topic.

    Args:
        model: name or file of the body where the bag's own name for it is not known; None: the
            bag's.
    """

    def __init__(self, model: str | None) -> None:
        self._model = model
        self._known: dict[str, Body] = {}
        self._measured: dict[str, Body] = {}

    def learn(self, stored: BagMessage) -> None:
        """Takes a message about a body; a model that is not known leaves the body unknown."""
        message = stored.message
        lengths = dict(
            zip(map(str, message.segment_names), map(float, message.segment_lengths), strict=False)
        )
        try:
            body = self._body(str(message.name))
        except FileNotFoundError:
            if self._model is not None:
                raise
            return
        try:
            self._known[_namespace(stored.topic)] = body.with_segment_lengths(lengths)
        except KeyError as error:
            raise ValueError(f'topic {stored.topic}: {error.args[0]}') from error

    def _body(self, name: str) -> Body:
        """The body that was chosen, or that ships under a name; names in bags lead to no files."""
        return named_body(name) if self._model is None else load_body(self._model)

    def of(self, topic: str, dof_names: tuple[str, ...]) -> Body | None:
        """The body whose poses a topic carries, None: not known."""
        body = self._known.get(_namespace(topic))
        if body is None and len(self._known) == 1:
            body = next(iter(self._known.values()))
        return body if body is not None and body.dof_names == dof_names else None

    def of_pose(self, topic: str, content: PoseMixture) -> Body | None:
        """The body of a mixture: that of the bag, or one of the lengths that its joints tell."""
        known = self.of(topic, content.dof_names)
        for body in (known, self._measured.get(topic)):
            if body is not None and _is_there(body, content):
                return body
        try:
            body = self._body(content.body_model).with_joints_at(
                content.mixture.means, content.joint_names, content.joint_positions
            )
        except (FileNotFoundError, ValueError):
            return known
        if body.dof_names != content.dof_names:
            return known
        self._measured[topic] = body
        return body


def _is_there(body: Body, content: PoseMixture) -> bool:
    if content.joint_names != body.joint_names or content.dof_names != body.dof_names:
        return False
    computed = body.joint_positions(content.mixture.means)
    return bool(np.abs(computed - content.joint_positions).max() <= SAME_PLACE)


def _namespace(topic: str) -> str:
    return topic.lstrip('/').rpartition('/')[0]
