"""Explains silent topics: no publisher, the wrong message type, or a similar topic name.

All methods but `arrived` run in the executor's thread, once per period of the diagnostics. They
query the ROS graph only for topics on which nothing arrives.
"""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from rclpy.node import Node

from hmt_ros.nodes.subscribed_topic import SubscribedTopic
from hmt_ros.sessions.handled import HANDLED
from hmt_ros.sessions.session import NeededInput, kind_of

# Time without a message after which a topic is reported as silent, and interval of warnings, s.
SILENCE_TIME, WARNING_INTERVAL = 3.0, 30.0
# Maximum number of suggested topics.
_MAX_SUGGESTIONS = 3
_IMAGE, _COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
# Value of `image_transport` and subscribed topic, by image type.
_TRANSPORTS = {_IMAGE: ('raw', 'image'), _COMPRESSED: ('compressed', 'image/compressed')}


class Publication(NamedTuple):
    """A publication of another node on a topic.

    Attributes:
        topic: full name of the topic.
        msgtype: message type, for example 'sensor_msgs/msg/Image'.
        by: full name of the publishing node.
    """

    topic: str
    msgtype: str
    by: str


class SilentTopics:
    """Watches the topics that a node subscribes to.

    Attributes:
        texts: explanation for each silent topic, as found by the last `check`.
    """

    def __init__(self, node: Node, warn: Callable[[str], None]) -> None:
        self._node, self._warn = node, warn
        self.listen(())

    @property
    def silence(self) -> float:
        """Time since the last message that triggered an estimate, s; 0 up to `SILENCE_TIME`."""
        last = self._arrivals.get(self._pace)
        since = 0.0 if last is None else time.monotonic() - last
        return since if since > SILENCE_TIME else 0.0

    def listen(self, inputs: Iterable[SubscribedTopic], pace: str = '') -> None:
        """Watches new subscriptions instead of the previous ones; an empty list stops the watch.

        Args:
            pace: source of the messages that trigger estimates.
        """
        self._pace = pace
        self._inputs = {one.source: one for one in inputs}
        self.texts: Mapping[str, str] = {}
        self._arrivals: dict[str, float] = {}
        self._warned: dict[str, tuple[str, float]] = {}
        self._began = time.monotonic()

    def arrived(self, source: str, now: float) -> None:
        """Records the arrival of a message."""
        self._arrivals[source] = self._arrivals[kind_of(source)] = now

    def check(self, needed: Iterable[NeededInput]) -> None:
        """Finds silent topics among the needed inputs, and warns about them."""
        now = time.monotonic()
        newest = self._arrivals.get(self._pace, self._began)
        silent = [one for one in needed if self._is_silent(one, newest if one.with_each else now)]
        texts = {}
        for one in silent:
            wanted = [self._inputs[source] for source in one.sources if source in self._inputs]
            names = [self._node.resolve_topic_name(each.topic) for each in wanted]
            if wanted:
                texts[' or '.join(names)] = why_silent(wanted, names, self._like(wanted, names))
        self.texts = texts
        for topics, text in texts.items():
            before, at = self._warned.get(topics, ('', 0.0))
            if text != before or now - at >= WARNING_INTERVAL:
                self._warned[topics] = text, now
                self._warn(text)
        self._warned = {topics: self._warned[topics] for topics in texts}

    def _is_silent(self, needed: NeededInput, now: float) -> bool:
        last = max(self._arrivals.get(source, self._began) for source in needed.sources)
        return now - last >= SILENCE_TIME

    def _like(self, wanted: list[SubscribedTopic], names: list[str]) -> list[Publication]:
        """Publications of other nodes on the topics `names`, or with a type that suits `wanted`.

        Silhouettes and overlays published by this package are left out, because they are not
        camera images.
        """
        own = self._node.get_fully_qualified_name()
        topics = dict(self._node.get_topic_names_and_types())
        ours = {topic.removesuffix('/handled') for topic in topics if HANDLED in topics[topic]}
        images = any(_is_image(one) for one in wanted)
        types = {one.msgtype for one in wanted} | (_TRANSPORTS.keys() if images else set())
        found = []
        for topic, kinds in topics.items():
            if topic not in names and not types & set(kinds):
                continue
            for info in self._node.get_publishers_info_by_topic(topic):
                by = f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                if by != own and (topic in names or not (images and by in ours)):
                    found.append(Publication(topic, info.topic_type, by))
        return found


def why_silent(
    wanted: list[SubscribedTopic], names: list[str], published: list[Publication]
) -> str:
    """Explanation of why a topic and its alternatives are silent, with a remedy."""
    topics = ' or '.join(
        f'{name} ({_short(one.msgtype)})' for one, name in zip(wanted, names, strict=True)
    )
    here = [each for each in published if each.topic in names]
    types = {one.msgtype for one in wanted}
    fitting = sorted({each.by for each in here if each.msgtype in types})
    if fitting:
        why = f'{" and ".join(fitting)} publishes it, but no message has come'
        return (
            f'nothing on {topics}; {why}: it may wait for something itself, see its diagnostics '
            f'and "ros2 topic info --verbose {names[0]}"'
        )
    others = sorted({f'{each.by} publishes it as {_short(each.msgtype)}' for each in here})
    why = ' and '.join(others) or f'nobody publishes {"it" if len(names) == 1 else "either"}'
    hints = [_instead(one, name, published) for one, name in zip(wanted, names, strict=True)]
    return '; '.join([f'nothing on {topics}', why, *dict.fromkeys(filter(None, hints))])


def _instead(wanted: SubscribedTopic, name: str, published: list[Publication]) -> str:
    """Suggestion of other topics, the most similar names first; '' without candidates."""
    kinds = _TRANSPORTS if _is_image(wanted) else {wanted.msgtype: ('', wanted.topic)}
    # Topics of the wanted type precede topics of the other image transport.
    for kind in sorted(kinds, key=lambda each: each != wanted.msgtype):
        transport, topic = kinds[kind]
        there = sorted({x.topic for x in published if x.msgtype == kind})
        nearest = difflib.get_close_matches(name, there, _MAX_SUGGESTIONS, 0.0)
        if nearest:
            verb = 'is' if len(nearest) == 1 else 'are'
            named = ', '.join(f'{each} ({_short(kind)})' for each in nearest)
            choice = f'set image_transport to {transport} and ' if kind != wanted.msgtype else ''
            return f'there {verb} {named}: {choice}remap with -r {topic}:={nearest[0]}'
    return ''


def _is_image(wanted: SubscribedTopic) -> bool:
    return (wanted.msgtype, wanted.topic) in {(x, topic) for x, (_, topic) in _TRANSPORTS.items()}


def _short(msgtype: str) -> str:
    """Short name of a message type, as users write it."""
    return msgtype.replace('/msg/', '/')
