"""Runs real nodes in separate processes and sends them messages over DDS in lock step.

Each message is published unchanged. The next message is published after the node has reported on
`~/handled` how it handled the message, and after all its results have arrived. No message is lost
or reordered, so the result does not depend on the speed of the machine. The nodes run in the DDS
domain of their player; no other process uses this domain.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import hmt_ros
from hmt_ros.app.replay.player import LiveNodeError, Player, environment
from hmt_ros.nodes.own_messages import OwnMessages
from hmt_ros.sessions.declared_parameters import values_of
from hmt_ros.sessions.handled import HANDLED, Handled, handled_of
from hmt_ros.sessions.parameter_file import yaml_scalar
from hmt_ros.sessions.session import SUBSCRIBERS_KEY, PublishedTopic
from hmt_ros.sessions.transform_buffer import TF_STATIC
from msg_tools.messages.cdr import canonical, deserialise, serialise

# Time limits, s. Only a replay that hangs reaches them; a node that exits is noticed at once.
START_SECONDS = 600.0
MESSAGE_SECONDS = 120.0
STOP_SECONDS = 20.0
STALE_SECONDS = 3600.0
# Sources with transient local QoS, so that late subscribers also get their messages.
LATCHED_SOURCES = (TF_STATIC,)


class NodeProcess:
    """A process in which nodes run.

    Args:
        player: the participant that the nodes communicate with.
        words: arguments of the command line, before the ROS arguments.
    """

    def __init__(
        self, player: Player, opened: ExitStack, name: str, module: str, words: Sequence[str] = ()
    ) -> None:
        self._player, self._name = player, name
        self._module, self._words = module, words
        self._options: list[str] = []
        self._process: subprocess.Popen[bytes] | None = None
        opened.callback(self.stop)

    def add(self, *options: str) -> None:
        """Adds ROS options to the command line; call it before `start`."""
        self._options += options

    def start(self) -> None:
        """Starts the process."""
        sources = str(Path(hmt_ros.__file__).resolve().parents[1])
        command = [sys.executable, '-m', self._module, *self._words, '--ros-args', *self._options]
        # No status lines, so that the last line of the output explains a failure.
        command += ['--log-level', 'warn']
        with self._file.open('wb') as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={
                    **os.environ,
                    **environment(self._player.domain),
                    'PYTHONPATH': os.pathsep.join(
                        [sources, *filter(None, [os.environ.get('PYTHONPATH')])]
                    ),
                    'ROS_LOG_DIR': str(self._player.folder),
                    # The nodes exit if the replay is killed, see
                    # `hmt_ros.nodes.run_node.OWNER_VARIABLE`.
                    'HMT_ROS_OWNER': str(os.getpid()),
                },
                # The interrupt key must reach only this process, which then stops the node.
                start_new_session=True,
            )

    @property
    def popen(self) -> subprocess.Popen[bytes]:
        """The process, which must have started."""
        assert self._process is not None
        return self._process

    def stop(self) -> int | None:
        """Ends the process as the interrupt key does, and returns its exit code."""
        process = self._process
        if process is None:
            return None
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            return process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    def output(self) -> str:
        """All console output of the process."""
        return self._file.read_text('utf-8', 'replace')

    @property
    def _file(self) -> Path:
        return self._player.folder / f'{self._name}.output'


class LiveNode:
    """A running node.

    Args:
        player: the participant that publishes for the node and subscribes to it.
        inputs: topic and type of the messages for the node, by source.
        sensors: topics with sensor data QoS, which may lose messages; the QoS is overridden to
            reliable.
        module: module that runs the node; empty selects `hmt_ros.nodes.<name>`.
        within: process that several nodes share and the caller starts; None starts a new process.
        write: called with topic, stamp and bytes of each message of the node, in order.

    Raises:
        LiveNodeError: the node does not start.
    """

    def __init__(
        self,
        player: Player,
        opened: ExitStack,
        name: str,
        parameters: Any,
        *,
        inputs: Mapping[str, tuple[str, str]],
        topics: Mapping[str, PublishedTopic],
        sensors: tuple[str, ...] = (),
        module: str = '',
        within: NodeProcess | None = None,
        write: Callable[[str, int, bytes], None],
    ) -> None:
        self.name = name
        self._player, self._topics, self._write = player, topics, write
        self._arrived: dict[str, deque[bytes]] = {topic: deque() for topic in topics}
        self._answers: deque[bytes] = deque()
        self._open_topics(inputs)
        self._process = within or NodeProcess(
            player, opened, name, module or f'hmt_ros.nodes.{name}'
        )
        self._process.add(*self._options(parameters, sensors))
        if within is None:
            self._process.start()

    def publish(self, source: str, message: Any) -> None:
        """Publishes a message for the node."""
        self.publish_bytes(source, serialise(message))

    def publish_bytes(self, source: str, data: bytes) -> None:
        """Publishes bytes for the node; they need not be a valid message."""
        if source in self._shared:
            self._own.sent(data)
        self._publishers[source].publish(data)

    @property
    def has_answered(self) -> bool:
        """Whether an answer has arrived, so that `answer` need not wait for it."""
        return bool(self._answers)

    def answer(self, source: str, seconds: float | None = None) -> Handled:
        """Waits until the node has handled its next message, and writes the results.

        Args:
            seconds: maximum time to wait; None selects `MESSAGE_SECONDS`.

        Raises:
            LiveNodeError: the node has ended, or does not answer.
        """
        patience = MESSAGE_SECONDS if seconds is None else seconds
        answer = self._next(self._answers, patience, f'an answer to a {source}')
        handled = handled_of(deserialise(answer, HANDLED))
        for topic, stamp in handled.published:
            if topic not in self._arrived:
                continue  # topic of a single person, created and closed during the run
            data = self._next(self._arrived[topic], patience, f'{topic} of {stamp} ns')
            # DDS may pad a message to a multiple of four bytes.
            self._write(topic, stamp, canonical(data, self._topics[topic].msgtype))
        return handled

    def deactivate(self) -> None:
        """Deactivates the node, which then finishes its work.

        Raises:
            LiveNodeError: the node can not be deactivated.
        """
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        transition = Transition(id=Transition.TRANSITION_DEACTIVATE)
        if not self.call(ChangeState, 'change_state', transition=transition).success:
            raise LiveNodeError(
                f'the {self.title} can not be deactivated: {self._last_output_line()}'
            )

    def call(self, kind: Any, service: str, **fields: Any) -> Any:
        """Calls a service of the node, 'change_state' for example, and returns the answer.

        Raises:
            LiveNodeError: the service does not answer.
        """
        client = self._player.node.create_client(kind, f'/{self.name}/{service}')
        try:
            self._wait(client.service_is_ready, START_SECONDS, f'its service {service}')
            future = client.call_async(kind.Request(**fields))
            self._wait(future.done, MESSAGE_SECONDS, f'an answer of {service}')
            return future.result()
        finally:
            self._player.node.destroy_client(client)

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process of the node."""
        return self._process.popen

    def output(self) -> str:
        """All console output of the process of the node."""
        return self._process.output()

    @property
    def title(self) -> str:
        """Name of the node for error messages."""
        return self.name.replace('_', ' ')

    def wait_until_active(self) -> None:
        """Returns when the node is active and subscribes to all its inputs.

        Raises:
            LiveNodeError: the node does not become active.
        """
        self._wait(self._state.service_is_ready, START_SECONDS, 'the node')
        label = ''
        end = time.monotonic() + START_SECONDS
        while label != 'active':
            if time.monotonic() > end:
                raise LiveNodeError(f'the {self.title} is {label}: {self._last_output_line()}')
            future = self._state.call_async(self._state_request)
            self._wait(future.done, START_SECONDS, 'the state of the node')
            label = future.result().current_state.label
        # The player is an additional subscriber of shared topics.
        publishers = self._publishers.items()
        self._wait(
            lambda: all(
                publisher.get_subscription_count() > (source in self._shared)
                for source, publisher in publishers
            ),
            START_SECONDS,
            'the subscriptions of the node',
        )

    def wait_until_heard(self, sources: tuple[str, ...], count: int) -> None:
        """Waits until `count` nodes, including this one, subscribe to the given sources.

        Raises:
            LiveNodeError: the nodes do not subscribe in time.
        """
        publishers = [self._publishers[source] for source in sources]
        self._wait(
            lambda: all(one.get_subscription_count() >= count for one in publishers),
            START_SECONDS,
            f'subscribers of {", ".join(sources)}',
        )

    def wait_for_subscribers(self, topics: tuple[str, ...], count: int) -> None:
        """Waits until each topic has `count` connected subscribers, including this player.

        The number is from the diagnostics of the node, because the ROS graph may list subscribers
        that are not connected yet.

        Raises:
            LiveNodeError: the subscribers are not connected in time.
        """

        def connected() -> bool:
            values = self._player.diagnostics.get(self.name, {})
            return all(int(values.get(f'{SUBSCRIBERS_KEY}{x}', '0')) >= count for x in topics)

        self._wait(connected, START_SECONDS, f'subscribers of {", ".join(topics)}')

    def stop(self) -> int | None:
        """Ends the node as the interrupt key does, and returns its exit code."""
        return self._process.stop()

    def stop_well(self) -> None:
        """Ends the node, and checks that its exit code is 0.

        Raises:
            LiveNodeError: the exit code of the node is not 0.
        """
        code = self.stop()
        if code != 0:
            raise LiveNodeError(
                f'the {self.title} ended with code {code}: {self._last_output_line()}'
            )

    def _options(self, parameters: Any, sensors: tuple[str, ...]) -> list[str]:
        """ROS options with the parameters of the node and the names of its topics."""
        values = {name: yaml_scalar(value) for name, value in values_of(parameters).items()}
        if 'stale_time' in values:
            # In lock step the processing time of an image has no limit.
            values['stale_time'] = yaml_scalar(STALE_SECONDS)
        for topic in sensors:
            values[f'qos_overrides.{topic}.subscription.reliability'] = 'reliable'
        lines = [f'    {name}: {text}' for name, text in values.items()]
        file = self._player.folder / f'{self.name}.yaml'
        head = [f'/**/{self.name}:', '  ros__parameters:']
        file.write_text('\n'.join([*head, *lines, '']), encoding='utf-8')
        options = ['--params-file', str(file)]
        for topic in self._topics:
            if topic.startswith('/'):
                options += ['-r', f'{self.name}:{topic}:={self._topic(topic)}']
        return options

    def _topic(self, name: str) -> str:
        """Absolute topic name; absolute topics of the node get the node's name as prefix."""
        if not name.startswith('/'):
            return f'/{name}'
        return f'/{self.name}{name}' if name in self._topics else name

    def _open_topics(self, inputs: Mapping[str, tuple[str, str]]) -> None:
        from lifecycle_msgs.srv import GetState

        player, node = self._player, self._player.node
        self._publishers = {
            source: node.create_publisher(
                player.classes[msgtype],
                self._topic(topic),
                player.latched if source in LATCHED_SOURCES else player.reliable,
            )
            for source, (topic, msgtype) in inputs.items()
        }
        # Sources on topics that the node also publishes, and the player's messages on these topics.
        self._shared = {source for source, (topic, _) in inputs.items() if topic in self._topics}
        self._own = OwnMessages()
        shared = {inputs[source][0] for source in self._shared}
        for topic, published in self._topics.items():
            node.create_subscription(
                player.classes[published.msgtype],
                self._topic(topic),
                _into(self._arrived[topic], self._own if topic in shared else None),
                player.latched if published.latched else player.reliable,
                raw=True,
            )
        node.create_subscription(
            player.classes[HANDLED],
            f'/{self.name}/handled',
            _into(self._answers),
            player.reliable,
            raw=True,
        )
        # Created last, so that the topics above are discovered before this client.
        self._state = node.create_client(GetState, f'/{self.name}/get_state')
        self._state_request = GetState.Request()

    def _next(self, queue: deque[bytes], seconds: float, what: str) -> bytes:
        self._wait(lambda: bool(queue), seconds, what)
        return queue.popleft()

    def _wait(self, done: Callable[[], bool], seconds: float, what: str) -> None:
        end = time.monotonic() + seconds
        while not done():
            self._player.executor.spin_once(timeout_sec=0.1)
            code = self.process.poll()
            if code is not None and not done():
                raise LiveNodeError(
                    f'the {self.title} ended with code {code}: {self._last_output_line()}'
                )
            if time.monotonic() > end:
                raise LiveNodeError(
                    f'the {self.title} is silent: waited {seconds:.0f} s for {what}; '
                    f'{self._last_output_line()}'
                )

    def _last_output_line(self) -> str:
        """The last line of the output of the node."""
        lines = [line.strip() for line in self.output().splitlines() if line.strip()]
        return lines[-1] if lines else 'it has written nothing'


def _into(queue: deque[bytes], own: OwnMessages | None = None) -> Callable[[bytes], None]:
    """Returns a callback that queues messages except the player's; rclpy inspects its signature."""

    def receive(data: bytes) -> None:
        if own is None or not own.is_own(data):
            queue.append(data)

    return receive
