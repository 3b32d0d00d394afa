"""The real filter node in a process of its own, fed over DDS in lock step.

Every message is published as it is in the bag; the next one follows when the node has told on
`~/handled` what became of it and all that it published has arrived. Nothing is lost and nothing
overtakes, so what comes out does not depend on how fast the machine is. The node runs in a ROS
domain that nobody else uses, on this machine only.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import hmt_ros
from hmt_ros.nodes.declared_parameters import values_of
from hmt_ros.nodes.filter_parameters import FilterParameters
from hmt_ros.nodes.filter_session import CAMERA_INFO, IMAGE, KEYPOINTS, Handled
from hmt_ros.nodes.parameter_file import yaml_scalar
from hmt_ros.nodes.track_messages import TOPICS
from msg_tools.cdr import canonical, deserialise, serialise

# Generous: they end a replay that hangs. A node that ends is noticed at once.
START_SECONDS = 120.0
MESSAGE_SECONDS = 600.0  # the first image may have to wait until kernels are compiled
STOP_SECONDS = 20.0

_NODE = 'filter_node'


class LiveFilterError(ValueError):
    """The node did not start, or does not answer; one line."""


class LiveFilter:
    """A running filter node; a context manager.

    Args:
        parameters: of the node.
        write: takes topic, stamp and bytes of all that the node publishes, in its order.

    Raises:
        LiveFilterError: there is no ROS, or the node does not start.
    """

    def __init__(
        self, parameters: FilterParameters, write: Callable[[str, int, bytes], None]
    ) -> None:
        self._parameters = parameters
        self._write = write
        self._arrived: dict[str, deque[bytes]] = {topic: deque() for topic in TOPICS}
        self._answers: deque[bytes] = deque()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> LiveFilter:
        with ExitStack() as opened:
            self._folder = Path(opened.enter_context(TemporaryDirectory(prefix='hmt_ros.')))
            domain = opened.enter_context(_reserved_domain())
            self._open_topics(domain, opened)
            opened.callback(self._stop_node)
            self._process = self._start_node(domain)
            self._wait_until_active()
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._opened:
            code = self._stop_node()
            if kind is None and code != 0:
                raise LiveFilterError(
                    f'the filter node ended with code {code}: {self._last_words()}'
                )

    def take(self, source: str, message: Any) -> Handled:
        """Publishes a message and waits for all that it leads to.

        Raises:
            LiveFilterError: the node has ended, or does not answer.
        """
        self._publishers[source].publish(serialise(message))
        handled = _handled(self._next(self._answers, MESSAGE_SECONDS, f'an answer to a {source}'))
        for topic, stamp in handled.published:
            data = self._next(self._arrived[topic], START_SECONDS, f'{topic} of {stamp} ns')
            # On its way a message may get bytes behind its end, up to a multiple of four.
            self._write(topic, stamp, canonical(data, TOPICS[topic].msgtype))
        return handled

    def _next(self, queue: deque[bytes], seconds: float, what: str) -> bytes:
        self._wait(lambda: bool(queue), seconds, what)
        return queue.popleft()

    def _start_node(self, domain: int) -> subprocess.Popen[bytes]:
        values = {name: yaml_scalar(value) for name, value in values_of(self._parameters).items()}
        image = '/image/compressed' if self._compressed else '/image'
        for topic in (image, '/camera_info', '/keypoints'):
            # Sensors may lose data, a replay may not.
            values[f'qos_overrides.{topic}.subscription.reliability'] = 'reliable'
        lines = [f'    {name}: {text}' for name, text in values.items()]
        file = self._folder / 'parameters.yaml'
        file.write_text('\n'.join(['/**:', '  ros__parameters:', *lines, '']), encoding='utf-8')
        sources = str(Path(hmt_ros.__file__).resolve().parents[1])
        environment = {
            **os.environ,
            **_environment(domain),
            'PYTHONPATH': os.pathsep.join([sources, *filter(None, [os.environ.get('PYTHONPATH')])]),
            'ROS_LOG_DIR': str(self._folder),
        }
        command = [sys.executable, '-m', 'hmt_ros.nodes.filter_node']
        with (self._folder / 'output').open('wb') as output:
            return subprocess.Popen(
                [*command, '--ros-args', '--params-file', str(file)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                # The interrupt key is for this process; it stops the node itself.
                start_new_session=True,
            )

    @property
    def _compressed(self) -> bool:
        return self._parameters.image_transport == 'compressed'

    def _open_topics(self, domain: int, opened: ExitStack) -> None:
        try:
            import rclpy
            from diagnostic_msgs.msg import DiagnosticStatus
            from hmt_msgs.msg import Body, Keypoints2D, PoseMixture
            from lifecycle_msgs.srv import GetState
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
            from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
            from tf2_msgs.msg import TFMessage
            from visualization_msgs.msg import MarkerArray
        except ImportError as error:
            raise LiveFilterError(
                f'--live needs a sourced ROS 2 workspace ({error}): source install/setup.bash'
            ) from error
        classes: dict[str, Any] = {
            'hmt_msgs/msg/Body': Body,
            'hmt_msgs/msg/PoseMixture': PoseMixture,
            'sensor_msgs/msg/JointState': JointState,
            'sensor_msgs/msg/CompressedImage': CompressedImage,
            'visualization_msgs/msg/MarkerArray': MarkerArray,
            'tf2_msgs/msg/TFMessage': TFMessage,
        }
        context = rclpy.Context()
        with _changed_environment(_environment(domain)):
            rclpy.init(context=context, domain_id=domain)
        opened.callback(rclpy.try_shutdown, context=context)
        node = rclpy.create_node('replay', context=context)
        opened.callback(node.destroy_node)
        self._executor = SingleThreadedExecutor(context=context)
        opened.callback(self._executor.shutdown)
        self._executor.add_node(node)
        reliable = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        image = (CompressedImage, 'image/compressed') if self._compressed else (Image, 'image')
        self._publishers = {
            CAMERA_INFO: node.create_publisher(CameraInfo, 'camera_info', reliable),
            KEYPOINTS: node.create_publisher(Keypoints2D, 'keypoints', reliable),
            IMAGE: node.create_publisher(*image, reliable),
        }
        for topic, published in TOPICS.items():
            node.create_subscription(
                classes[published.msgtype],
                topic,
                _into(self._arrived[topic]),
                latched if published.latched else reliable,
                raw=True,
            )
        node.create_subscription(
            DiagnosticStatus, f'{_NODE}/handled', _into(self._answers), reliable, raw=True
        )
        # The last of all: discovery tells the node of the topics above before it tells of this.
        self._state = node.create_client(GetState, f'{_NODE}/get_state')
        self._state_request = GetState.Request()

    def _wait_until_active(self) -> None:
        """Returns when the node is active and both sides know all topics of each other."""
        self._wait(self._state.service_is_ready, START_SECONDS, 'the node')
        label = ''
        end = time.monotonic() + START_SECONDS
        while label != 'active':
            if time.monotonic() > end:
                raise LiveFilterError(f'the filter node is {label}: {self._last_words()}')
            future = self._state.call_async(self._state_request)
            self._wait(future.done, START_SECONDS, 'the state of the node')
            label = future.result().current_state.label
        publishers = self._publishers.values()
        self._wait(
            lambda: all(publisher.get_subscription_count() for publisher in publishers),
            START_SECONDS,
            'the subscriptions of the node',
        )

    def _wait(self, done: Callable[[], bool], seconds: float, what: str) -> None:
        end = time.monotonic() + seconds
        while not done():
            self._executor.spin_once(timeout_sec=0.1)
            assert self._process is not None
            code = self._process.poll()
            if code is not None and not done():
                raise LiveFilterError(
                    f'the filter node ended with code {code}: {self._last_words()}'
                )
            if time.monotonic() > end:
                raise LiveFilterError(
                    f'the filter node is silent: waited {seconds:.0f} s for {what}; '
                    f'{self._last_words()}'
                )

    def _last_words(self) -> str:
        """The last line that the node has written."""
        text = (self._folder / 'output').read_text('utf-8', 'replace')
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return lines[-1] if lines else 'it has said nothing'

    def _stop_node(self) -> int | None:
        """Ends the node as the interrupt key would; its exit code."""
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


def _into(queue: deque[bytes]) -> Callable[[bytes], None]:
    """A callback; rclpy wants one whose signature it can read."""

    def receive(data: bytes) -> None:
        queue.append(data)

    return receive


def _handled(data: bytes) -> Handled:
    """What a message on ~/handled says."""
    message = deserialise(data, 'diagnostic_msgs/msg/DiagnosticStatus')
    pairs = [(str(value.key), str(value.value)) for value in message.values]
    return Handled(
        source=str(message.name),
        stamp_ns=int(dict(pairs)['stamp']),
        faults=tuple(text for key, text in pairs if key == 'fault'),
        warnings=tuple(text for key, text in pairs if key == 'warning'),
        published=tuple((key, int(text)) for key, text in pairs if key in TOPICS),
    )


@contextmanager
def _reserved_domain() -> Iterator[int]:
    """Number of a ROS domain that no other replay or test run on this machine uses.

    A domain is taken while port 32768 + domain is bound, as ament's domain_coordinator does it.
    """
    for offset in range(100):
        domain = 1 + (os.getpid() + offset) % 100
        with socket.socket() as reservation:
            try:
                reservation.bind(('', 32768 + domain))
            except OSError:
                continue
            yield domain
            return
    raise LiveFilterError('all ROS domains from 1 to 100 are in use')


def _environment(domain: int) -> dict[str, str]:
    return {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


@contextmanager
def _changed_environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
