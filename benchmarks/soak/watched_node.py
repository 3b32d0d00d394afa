"""A node in its own process that the soak test feeds, calls and monitors over DDS."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any

from benchmarks.soak.scenes import PERSON, Scene
from hmt_ros.app.replay.live_node import LiveNode, NodeProcess
from hmt_ros.app.replay.player import LiveNodeError, Player
from hmt_ros.nodes.subscribed_topic import message_class
from hmt_ros.sessions.handled import Handled

OURS = '/hmt_ros/'
# Maximum time to answer one message, s.
PATIENCE = 30.0
# Maximum time for the start of a node, and maximum overtime of a case, s.
_START, _OVERTIME = 300.0, 90.0
# Maximum wait for the answer to a message that may have been sent too early, s.
SHORT = 2.0
# Queue size of this process for each topic. While it is late it publishes without listening, so
# answers beyond these would be lost here, although the node has sent them.
_QUEUE = 1000
# Number of consecutive good answers that confirm a session, above that for a clock change.
_AGREEING = 4
# Number of messages before memory is compared, so that buffers have grown.
_WARM = 8


class Silent(Exception):
    """No answer was received in time."""


class _Limited:
    """An executor that raises an error when the time is over; all waits of a case spin it."""

    def __init__(self, executor: Any, end: float) -> None:
        self._executor = executor
        self.end = end

    def spin_once(self, timeout_sec: float) -> None:
        if time.monotonic() > self.end:
            raise LiveNodeError(
                'something is waited for in vain, until the time of the case is over'
            )
        self._executor.spin_once(timeout_sec=timeout_sec)


class Watched:
    """A running node, with its published messages and its log.

    Args:
        scene: scene of the node.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._opened = ExitStack()
        self._end = math.inf
        self.restart()

    def limit(self, seconds: float) -> None:
        """Begins a case, whose waits end after `seconds` and some overtime at the latest."""
        self._end = self.player.executor.end = time.monotonic() + seconds + _OVERTIME

    def restart(self) -> None:
        """Starts the node in a new domain, and ends the previous one."""
        self._opened.close()
        self.index = 0
        self._setting: Any = None
        scene = self.scene
        with ExitStack() as opened:
            self.player = Player(opened)
            start = time.monotonic() + _START
            self.player.executor = _Limited(self.player.executor, start)
            self.player.reliable.depth = _QUEUE
            for msgtype in (kind for _, kind in scene.inputs.values()):
                self.player.classes.setdefault(msgtype, message_class(msgtype))
            for published in scene.session.TOPICS.values():
                self.player.classes.setdefault(published.msgtype, message_class(published.msgtype))
            process = None
            if scene.together:
                module = f'hmt_ros.nodes.{PERSON}'
                process = NodeProcess(self.player, opened, PERSON, module, scene.together)
            self.node = LiveNode(
                self.player,
                opened,
                scene.node,
                replace(scene.parameters, reset_on_time_jump=True),
                inputs=scene.inputs,
                topics=scene.session.TOPICS,
                sensors=scene.sensors,
                within=process,
                write=_ignored,
            )
            if process is not None:
                process.start()
            self.node.wait_until_active()
            self.node.wait_for_subscribers(tuple(scene.session.TOPICS), 1)
            self.player.executor.end = self._end
            self._opened = opened.pop_all()

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def warm_up(self) -> None:
        """Sends messages until everything is loaded, so that memory can be compared."""
        for source, message in self.scene.prelude:
            self.send(source, message)
        for _ in range(_WARM):
            self.next()

    def send(self, source: str, message: Any) -> Handled:
        """Sends a message and waits for its answer."""
        self.node.publish(source, message)
        return self.node.answer(source, PATIENCE)

    def next(self) -> Handled:
        """Sends the next valid message and waits for its answer."""
        self.index += 1
        return self.send(self.scene.session.COUNTED, self.scene.message(self.index - 1))

    def begin_again(self) -> None:
        """Sends valid messages from the first one until several in a row are used.

        After the clock is set back, the first messages wait until later ones agree with them.
        """
        self.index = good = 0
        end = time.monotonic() + PATIENCE
        while good < _AGREEING:
            if time.monotonic() > end:
                raise LiveNodeError(f'the {self.node.title} uses no message any more')
            for source, message in self.scene.prelude:
                self.node.publish(source, message)
            self.node.publish(self.scene.session.COUNTED, self.scene.message(self.index))
            self.index += 1
            with suppress(Silent):
                while (handled := self.answer(SHORT)).source != self.scene.session.COUNTED:
                    pass
                good = 0 if handled.faults else good + 1
        self.settle()

    def answer(self, seconds: float) -> Handled:
        """The answer to a message.

        Raises:
            Silent: no answer arrived in time.
        """
        end = time.monotonic() + seconds
        while not self.node.has_answered:
            if time.monotonic() > end:
                raise Silent
            self.check_alive()
            self.player.executor.spin_once(timeout_sec=0.02)
        return self.node.answer('message', PATIENCE)

    def settle(self, seconds: float = 0.5) -> list[Handled]:
        """Collects answers until the node is silent for some time."""
        found = []
        with suppress(Silent):
            while True:
                found.append(self.answer(seconds))
        return found

    def check_alive(self) -> None:
        """Raises LiveNodeError if the process has ended."""
        code = self.node.process.poll()
        if code is not None:
            words = self.node.output().strip().splitlines()[-1:]
            raise LiveNodeError(f'{self.scene.node} ended with code {code}: {" ".join(words)}')

    def change(self, transition: int) -> bool:
        """Requests a transition; returns whether it was made."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        asked = Transition(id=transition)
        return bool(self.node.call(ChangeState, 'change_state', transition=asked).success)

    def state(self) -> int:
        """Number of the node's lifecycle state."""
        from lifecycle_msgs.srv import GetState

        return int(self.node.call(GetState, 'get_state').current_state.id)

    def set(self, **values: Any) -> tuple[bool, str]:
        """Sets parameters atomically; returns whether that succeeded, and the reason if not."""
        from rcl_interfaces.srv import SetParametersAtomically
        from rclpy.parameter import Parameter

        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        found = self.node.call(
            SetParametersAtomically, 'set_parameters_atomically', parameters=given
        ).result
        return bool(found.successful), str(found.reason)

    def begin_to_set(self, **values: Any) -> Any:
        """Sends a request to set parameters; returns a future."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        if self._setting is None:
            name = f'/{self.node.name}/set_parameters'
            self._setting = self.player.node.create_client(SetParameters, name)
            self.node.call(SetParameters, 'set_parameters', parameters=[])
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        return self._setting.call_async(SetParameters.Request(parameters=given))

    def get(self, names: list[str]) -> list[Any]:
        """Values of parameters."""
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python

        found = self.node.call(GetParameters, 'get_parameters', names=names).values
        return [parameter_value_to_python(value) for value in found]

    def values(self) -> dict[str, str]:
        """The values of the node's next diagnostics."""
        diagnostics = self.player.diagnostics
        diagnostics.pop(self.node.name, None)
        end = time.monotonic() + PATIENCE
        while self.node.name not in diagnostics:
            if time.monotonic() > end:
                raise LiveNodeError(f'{self.scene.node} tells no diagnostics')
            self.check_alive()
            self.player.executor.spin_once(timeout_sec=0.1)
        return diagnostics[self.node.name]

    def traces(self) -> list[str]:
        """Lines of the log that no user should see.

        The executor of rclpy logs failures of callbacks, such as its own one for /clock if the
        time is negative.
        """
        lines = [
            line
            for line in self.node.output().splitlines()
            if not line.strip().startswith('raise ')
        ]
        return [
            f'said {line.strip()[:120]}'
            for line in lines
            if 'Error' in line.partition(':')[0].split('.')[-1] and not line.startswith('[')
        ] or [
            f'said {line.strip()[:120]}'
            for line in lines
            if 'Traceback' in line or 'Warning:' in line or ('File "' in line and OURS in line)
        ]

    def spin(self, seconds: float) -> None:
        """Listens for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.player.executor.spin_once(timeout_sec=left)


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """Ignores the content; only the arrival counts."""
