"""Clients of nodes; fixtures of the sessions are used here, too."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest

from hmt_ros.sessions.declared_parameters import EFFECTS, declared_parameters
from hmt_ros.sessions.handled import handled_of
from hmt_ros.sessions.parameter_file import read_parameter_file
from msg_tools.messages.cdr import serialise
from test.sessions.conftest import (  # noqa: F401
    background_file,
    body,
    likelihoods,
    outputs,
    small_camera,
    somebody,
    stub_predictor,
    stub_tracker,
    subject_file,
)

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 60.0  # s
DISCOVERY = 5.0  # time after which a client without a service is created again, s


class World:
    """A node and a second node that talks to it, in their own context.

    Args:
        stderr: captured stderr of the test.
        kind: class of the node.
        name: name of the node.
        inputs: class of the messages by topic.
        values: values of parameters.
    """

    def __init__(self, stderr, kind, name, inputs, **values):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from hmt_msgs.msg import Handled
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.parameter import Parameter
        from rclpy.qos import DurabilityPolicy, QoSProfile

        self.name = name
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        for topic in inputs:
            values[f'qos_overrides./{topic}.subscription.reliability'] = 'reliable'
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        self.node = kind(context=self.context, parameter_overrides=overrides)
        self.other = rclpy.create_node('other', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.executor.add_node(self.other)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.publishers = {
            topic: self.other.create_publisher(
                message, topic, latched if topic in ('body', 'tf_static') else 100
            )
            for topic, message in inputs.items()
        }
        self.handled, self.diagnostics = [], []
        self.stderr, self.logged = stderr, ''
        self.listen(Handled, f'{self.name}/handled', self.handled, read=handled_of)
        self.listen(DiagnosticArray, '/diagnostics', self.diagnostics)

    def listen(self, kind, topic, into, qos=100, read=None):
        def receive(message):
            into.append(message if read is None else read(message))

        return self.other.create_subscription(kind, topic, receive, qos)

    def hear(self, kinds):
        """Subscribes to topics; returns lists of messages once the node knows the subscriptions."""
        found = {topic: [] for topic in kinds}
        for topic, kind in kinds.items():
            self.listen(kind, topic, found[topic])
        self.spin_until(lambda: all(map(self.is_heard, kinds)), 'a subscription')
        return found

    def is_heard(self, topic):
        """Whether the node knows a subscriber of its topic."""
        name = self.node.resolve_topic_name(topic)
        return any(
            one.topic_name == name and one.get_subscription_count() for one in self.node.publishers
        )

    @property
    def session(self):
        """The session of the node; None while it is not configured."""
        return self.node._session

    @property
    def estimator(self):
        """The object that passes messages to the session; None while the node is inactive."""
        return self.node._estimator

    def receive(self, source, data):
        """Passes bytes to the node, as the middleware does."""
        from hmt_ros.nodes.estimating_thread import received

        wanted = {one.source: (name, one) for name, one in self.node._heard.items()}
        name, one = wanted[source]
        self.node._enqueue(name, received(data, one))

    def limit(self, source):
        """Queue length of a source."""
        return self.estimator.queue._limits[source]

    def own_periods(self):
        """Stops the timer of the diagnostics; returns a function that ends a period."""
        (timer,) = self.node.timers
        timer.cancel()
        return timer.callback

    def event(self, topic, kind, **content):
        """Simulates a middleware event of a subscription or a publisher."""
        (told,) = (
            handler.callback
            for one in (*self.node.subscriptions, *self.node.publishers)
            if one.topic_name == topic
            for handler in one.event_handlers
            if handler.event_type.name.endswith(kind)
        )
        told(SimpleNamespace(**content))

    def spin_until(self, done, what='it'):
        end = time.monotonic() + PATIENCE
        while not done():
            if time.monotonic() > end:
                said = '\n'.join(self.warnings())
                pytest.fail(f'waited in vain for {what}; the node has warned:\n{said}')
            self.executor.spin_once(timeout_sec=0.05)

    def start(self):
        self.node.start()
        return self.connect()

    def connect(self):
        """Waits until both sides know all topics of each other."""
        self.spin_until(
            lambda: (
                all(p.get_subscription_count() for p in self.publishers.values())
                and self.other.count_publishers(f'{self.name}/handled') == 1
                and self.node.count_subscribers(f'{self.name}/handled') == 1
                and self.is_heard(f'{self.name}/handled')
            )
        )
        return self

    def send(self, source, message, topic=None):
        """Publishes a message on its source's topic or another; returns the result."""
        count = len(self.handled)
        self.publishers[topic or source].publish(serialise(message))
        # A latched message may be handled in between.
        self.spin_until(
            lambda: any(handled.source == source for handled in self.handled[count:]),
            f'an answer to {source}',
        )
        return next(handled for handled in self.handled[count:] if handled.source == source)

    @staticmethod
    def of_ros(message):
        """Converts a message of rosbags to one of ROS."""
        from rclpy.serialization import deserialize_message

        package, _, name = message.__msgtype__.split('/')
        kind = getattr(import_module(f'{package}.msg'), name)
        return deserialize_message(serialise(message), kind)

    def client(self, kind, service):
        """A connected client; created again if discovery misses a new one."""
        end = time.monotonic() + PATIENCE
        while True:
            client = self.other.create_client(kind, f'{self.name}/{service}')
            again = time.monotonic() + DISCOVERY
            while time.monotonic() < again:
                if client.service_is_ready():
                    return client
                self.executor.spin_once(timeout_sec=0.05)
            self.other.destroy_client(client)
            assert time.monotonic() < end, f'waited in vain for {service}'

    def call(self, kind, service, **fields):
        client = self.client(kind, service)
        future = client.call_async(kind.Request(**fields))
        self.spin_until(future.done, f'an answer of {service}')
        self.other.destroy_client(client)
        return future.result()

    def change_state(self, label):
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        number = getattr(Transition, f'TRANSITION_{label.upper()}')
        return self.call(ChangeState, 'change_state', transition=Transition(id=number)).success

    @property
    def state(self):
        from lifecycle_msgs.srv import GetState

        return self.call(GetState, 'get_state').current_state.label

    def set(self, **values):
        """Sets parameters; returns the reasons for refusals. Waits long, as files may be read."""
        from rcl_interfaces.srv import SetParametersAtomically
        from rclpy.parameter import Parameter

        parameters = [
            Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        end = time.monotonic() + 60.0
        while True:
            result = self.call(
                SetParametersAtomically, 'set_parameters_atomically', parameters=parameters
            ).result
            if 'ask again later' not in result.reason or time.monotonic() > end:
                return result.successful, result.reason

    def assert_described(self, defaults, *others):
        """Checks that the parameters and their descriptions are those of the files.

        `others` are nodes whose parameters this one has, too.
        """
        folder = ROOT / 'hmt_ros' / 'config'
        listed = [read_parameter_file(folder / f'{x}.yaml', x) for x in (self.name, *others)]
        declared = {p.name: p for p in declared_parameters(defaults)}
        assert {name for one in listed for name in one} == declared.keys()
        for name, parameter in declared.items():
            description = self.node.describe_parameter(name).description
            assert description == f'{parameter.description} {EFFECTS[parameter.effect]}'
        return declared

    def assert_refused(self, *cases):
        """Checks that every case, values and a part of the reason, is refused."""
        for values, reason in cases:
            good, why = self.set(**values)
            assert not good
            assert reason in why, why

    def warnings(self):
        """Texts that the node has logged as warnings or worse."""
        return self._texts('WARN', 'ERROR', 'FATAL')

    def errors(self):
        """Texts that the node has logged as errors."""
        return self._texts('ERROR')

    def _texts(self, *levels):
        """Texts that the node has logged with some levels.

        They are read from stderr, because ended contexts in this process may disable /rosout of a
        node with the same name.
        """
        self.logged += self.stderr.readouterr().err
        head = re.compile(rf'^\[(\w+)\] \[[0-9.]+\] \[{self.name}\]: ', re.MULTILINE)
        lines = head.split(self.logged)
        entries = zip(lines[1::2], lines[2::2], strict=True)
        return [text.strip() for level, text in entries if level in levels]

    def diagnosis(self):
        """Ends a period of diagnostics; returns level, message and values."""
        from rclpy.time import Time

        now = self.node.get_clock().now()
        self.node._timer.callback()
        self.spin_until(
            lambda: self.diagnostics and Time.from_msg(self.diagnostics[-1].header.stamp) >= now,
            'diagnostics',
        )
        (status,) = self.diagnostics[-1].status
        return status.level[0], status.message, {v.key: v.value for v in status.values}

    def close(self):
        import rclpy

        self.node.stop()
        self.executor.shutdown()
        self.node.destroy_node()
        self.other.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def world_of(capfd, monkeypatch):
    """Creates and ends worlds; their nodes do not report silence before `patience`."""
    worlds = []

    def make(*arguments, **values):
        from hmt_ros.nodes import silent_topics

        monkeypatch.setattr(silent_topics, 'SILENCE_TIME', 1e6)
        worlds.append(World(capfd, *arguments, **values))
        worlds[-1].patience = lambda s: monkeypatch.setattr(silent_topics, 'SILENCE_TIME', s)
        return worlds[-1]

    yield make
    for one in worlds:
        one.close()


def only_line(code, output):
    """The error line of a node that has not started."""
    assert code == 1
    (line,) = output.splitlines()
    return line


@pytest.fixture
def ended(capfd, monkeypatch):
    """Runs nodes that end by themselves in this process; returns code, output and errors."""
    numbers = signal.SIGINT, signal.SIGTERM
    handlers, threads = [signal.getsignal(number) for number in numbers], cv2.getNumThreads()
    # The change would be permanent.
    monkeypatch.setattr('hmt_ros.nodes.run_node._use_one_heap', lambda: None)

    def run(name, *arguments):
        main = import_module(f'hmt_ros.nodes.{name}').main
        capfd.readouterr()
        # A node that does not end is interrupted, and its code is 0.
        guard = threading.Timer(PATIENCE, os.kill, [os.getpid(), signal.SIGINT])
        guard.start()
        try:
            code = main(list(arguments))
        except SystemExit as of_command_line:
            code = of_command_line.code
        finally:
            guard.cancel()
            for number, handler in zip(numbers, handlers, strict=True):
                signal.signal(number, handler)
            cv2.setNumThreads(threads)
        said = capfd.readouterr()
        return code, said.out, said.err

    return run


class Executable:
    """A node in its own process.

    Args:
        name: name of the node.
        arguments: arguments after --ros-args.
    """

    def __init__(self, name, *arguments):
        self.process = subprocess.Popen(
            [sys.executable, '-m', f'hmt_ros.nodes.{name}', '--ros-args', *arguments],
            cwd=ROOT,
            env=dict(os.environ),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def stop_at(self, text, number=signal.SIGINT):
        """Sends signals after the node prints a text; returns all lines of a node that ends well.

        A second one is sent during shutdown, because a terminal and "ros2 launch" send one each.
        """
        lines = []

        def insist():
            while self.process.poll() is None:
                self.process.send_signal(number)
                time.sleep(0.02)

        insisting = threading.Thread(target=insist)
        for line in self.process.stdout:
            lines.append(line)
            if text in line:
                insisting.start()
        assert self.process.wait(PATIENCE) == 0
        insisting.join()
        return lines


@pytest.fixture
def executable():
    """Starts executables, and ends them."""
    started = []

    def start(*arguments):
        started.append(Executable(*arguments))
        return started[-1]

    yield start
    for one in started:
        one.process.kill()
        one.process.communicate()
