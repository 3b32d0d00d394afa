"""What stands behind the topics of a node: messages in, messages out, without ROS."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.sessions.handled import Handled, HandlingLog, Output
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import serialise


def everything(_topic: str) -> bool:
    """Every topic is wanted."""
    return True


class Session(ABC):
    """What a node or a replay gives its messages to, one after the other.

    Args:
        parameters: of the node.
        publish: takes what is to be published, as soon as it is there.
        wanted: whether a topic needs to be published.

    Attributes:
        parameters: a new value takes effect when `declared_parameters` says.
        start: what the present estimate started from; None: there is but one way to start.
        state: for diagnostics, replaced with every message.
    """

    start: Any = None
    state: Any

    def __init__(
        self,
        parameters: Any,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        self.parameters = parameters
        self._publish_output = publish
        self._wanted = wanted
        self._messages = RosbagsMessages()
        self._log = HandlingLog()

    @abstractmethod
    def take(self, source: str, message: Any) -> Handled:
        """Handles a message."""

    @abstractmethod
    def restart(self, start: Any = None) -> None:
        """Starts the estimate anew."""

    @abstractmethod
    def _present_state(self) -> Any:
        """What is going on."""

    def refuse(self, source: str, text: str) -> Handled:
        """Counts a message that could not even be read."""
        self._log.begin()
        self._log.fault('message', f'message of {source} can not be read: {text}')
        self.state = self._present_state()
        return self._log.handled(source, 0)

    def break_off(self, source: str, text: str) -> Handled:
        """What became of a message over which the session itself has failed; it starts anew."""
        self._log.fault('node itself', text)
        self.restart(self.start)
        # A trace is in the log already.
        return replace(self._log.handled(source, 0), warnings=())

    def count_dropped(self, messages: int) -> None:
        """Counts messages that were dropped before they came here, because the node was late."""
        if messages:
            self._log.count_dropped(messages)
            self.state = self._present_state()

    def _publish(self, topic: str, stamp: int, message: Any) -> None:
        self._log.published(topic, stamp)
        self._publish_output(Output(topic, stamp, serialise(message)))


def entropy(weights: NDArray[np.float64]) -> float:
    """Entropy of the weights of a mixture, nats; NaN where there are none."""
    positive = weights[weights > 0]
    return abs(float(-(positive * np.log(positive)).sum())) if len(positive) else math.nan
