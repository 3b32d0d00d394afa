"""filter_node: images in, mixtures over poses out; a lifecycle node around a `FilterSession`.

The executor's thread only puts messages into a queue and answers services; one other thread
estimates. Messages pass as bytes in both directions: what a bag or a wire holds is read and written
by the same code as offline.

`~/handled` (diagnostic_msgs/DiagnosticStatus) tells of every message that was taken in what became
of it, after all that it led to has been published: `name` is its source, `message` why it was not
used, `values` its stamp, faults, warnings, and then the topics and stamps that were published. A
player that waits for it feeds the node in lock step.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from hmt_msgs.msg import Body, Keypoints2D, PoseMixture
from hmt_msgs.srv import Reset
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from hmt_ros.nodes.declared_parameters import (
    AT_LAUNCH,
    EFFECTS,
    DeclaredParameter,
    declared_parameters,
    with_values,
)
from hmt_ros.nodes.filter_parameters import FilterParameters
from hmt_ros.nodes.filter_session import (
    CAMERA_INFO,
    IMAGE,
    KEYPOINTS,
    FilterSession,
    Handled,
    Output,
    SessionState,
)
from hmt_ros.nodes.input_queue import InputQueue, Waiting
from hmt_ros.nodes.track_messages import TOPICS
from hmt_ros.nodes.track_start import prepare_start
from msg_tools.cdr import deserialise

_CLASSES = {
    'hmt_msgs/msg/Body': Body,
    'hmt_msgs/msg/PoseMixture': PoseMixture,
    'sensor_msgs/msg/JointState': JointState,
    'sensor_msgs/msg/CompressedImage': CompressedImage,
    'visualization_msgs/msg/MarkerArray': MarkerArray,
    'tf2_msgs/msg/TFMessage': TFMessage,
}
_RESTART = 'restart'
# Small messages that wait while an image is estimated.
_SMALL_QUEUE = 100
_RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
_LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
_FILES = ('subject_file', 'background_file', 'body_model')
# What a last estimate may take at the end, s; kernels that are being compiled are not waited for.
_LAST_ESTIMATE = 5.0


class FilterNode(LifecycleNode):
    """The node; parameters are those of `FilterParameters`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('filter_node', **options)
        defaults = FilterParameters()
        declared = declared_parameters(defaults)
        self.declare_parameters('', [(p.name, p.default, _descriptor(p)) for p in declared])
        names = [parameter.name for parameter in declared]
        self._values = {name: self.get_parameter(name).value for name in names}
        self._settings = with_values(defaults, self._values)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._refuse_impossible_transitions()
        self._session: FilterSession | None = None
        self._queue: InputQueue | None = None
        self._worker: threading.Thread | None = None
        self._outputs: dict[str, Any] = {}
        self._handled: Any = None
        self._reset_service: Any = None
        self._inputs: list[Any] = []
        self._failure = ''
        self._latencies: deque[float] = deque(maxlen=1000)
        self._rates = _Rates()
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', _RELIABLE)
        # With use_sim_time and nobody who tells the time, diagnostics are needed most.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._diagnose_period, clock=steady)

    def start(self) -> None:
        """Configures and activates the node, unless it is to wait for its services."""
        if not self._settings.autostart:
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def stop(self, timeout: float | None = None) -> bool:
        """Ends the thread that estimates, after its present image.

        Returns:
            Whether it has ended within `timeout` s.
        """
        if self._queue is not None:
            self._queue.close()
        if self._worker is not None:
            self._worker.join(timeout)
            if self._worker.is_alive():
                return False
        self._queue, self._worker = None, None
        return True

    # Lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Reads files, opens topics."""
        try:
            self._session = FilterSession(self._settings, self._publish, self._is_wanted)
        except ValueError as error:
            self._failure = str(error)
            self.get_logger().error(self._failure)
            self._diagnose()
            return TransitionCallbackReturn.FAILURE
        self._failure = ''
        for topic, published in TOPICS.items():
            self._outputs[topic] = self.create_lifecycle_publisher(
                _CLASSES[published.msgtype], topic, _LATCHED if published.latched else _RELIABLE
            )
        self._handled = self.create_lifecycle_publisher(DiagnosticStatus, '~/handled', _RELIABLE)
        self._reset_service = self.create_service(Reset, '~/reset', self._on_reset)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listens to the camera."""
        assert self._session is not None
        limits = {
            IMAGE: self._settings.queue_size,
            CAMERA_INFO: _SMALL_QUEUE,
            KEYPOINTS: _SMALL_QUEUE,
        }
        self._queue = InputQueue(limits, counted=IMAGE)
        result = super().on_activate(state)
        compressed = self._settings.image_transport == 'compressed'
        self._types = {
            CAMERA_INFO: 'sensor_msgs/msg/CameraInfo',
            IMAGE: f'sensor_msgs/msg/{"CompressedImage" if compressed else "Image"}',
            KEYPOINTS: 'hmt_msgs/msg/Keypoints2D',
        }
        self._worker = threading.Thread(
            target=self._work, args=(self._session, self._queue), name='estimate', daemon=True
        )
        self._worker.start()
        self._subscribe(CAMERA_INFO, CameraInfo, 'camera_info')
        self._subscribe(KEYPOINTS, Keypoints2D, 'keypoints')
        if compressed:
            self._subscribe(IMAGE, CompressedImage, 'image/compressed')
        else:
            self._subscribe(IMAGE, Image, 'image')
        topic = self._inputs[-1].topic_name
        self.get_logger().info(f'images from {topic}; waits for {self._session.state.wants}')
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listens no more; the track is kept."""
        self._unsubscribe()
        self.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forgets the track, closes topics."""
        self._close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As cleanup, from any state."""
        self._close()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Back to the state before configuration."""
        self._close()
        return super().on_error(state)

    def _subscribe(self, source: str, kind: type, topic: str) -> None:
        queue = self._queue
        assert queue is not None

        def receive(data: bytes) -> None:
            queue.put(source, data, time.monotonic())

        self._inputs.append(
            self.create_subscription(
                kind,
                topic,
                receive,
                qos_profile_sensor_data,
                raw=True,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        )

    def _unsubscribe(self) -> None:
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._inputs.clear()

    def _close(self) -> None:
        self._unsubscribe()
        self.stop()
        for publisher in [*self._outputs.values(), self._handled]:
            if publisher is not None:
                self.destroy_lifecycle_publisher(publisher)
        self._outputs.clear()
        self._handled = None
        if self._reset_service is not None:
            self.destroy_service(self._reset_service)
            self._reset_service = None
        self._session = None

    def _refuse_impossible_transitions(self) -> None:
        """A request for a transition that the state does not have must not end the node."""
        service = self._service_change_state
        change = service.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError as error:
                wanted = request.transition.label or request.transition.id
                self.get_logger().warn(f'transition {wanted} is not possible: {_first_line(error)}')
                response.success = False
                return response

        service.callback = answer

    # Parameters and services.

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        changed = {p.name: p.value for p in parameters if p.name in self._values}
        if not changed:
            return SetParametersResult(successful=True)
        try:
            settings = with_values(FilterParameters(), {**self._values, **changed})
            if any(name in changed for name in _FILES):
                prepare_start(settings)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._values.update(changed)
        self._settings = settings
        if self._session is not None:
            self._session.parameters = settings
        if self._queue is not None:
            self._queue.limit(IMAGE, settings.queue_size)
        return SetParametersResult(successful=True)

    def _on_reset(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        session, queue = self._session, self._queue
        if session is None or queue is None:
            response.success, response.message = False, 'the node is not active'
            return response
        try:
            start = prepare_start(self._settings, request.initial, session.state.body)
        except ValueError as error:
            response.success, response.message = False, str(error)
            return response
        queue.put(_RESTART, start, time.monotonic())
        response.success = True
        if start.initial is None:
            response.message = 'the track is dropped; nothing starts a new one without subject_file'
        else:
            response.message = 'the next image starts a new track'
        return response

    # The thread that estimates.

    def _work(self, session: FilterSession, queue: InputQueue) -> None:
        while (waiting := queue.get()) is not None:
            before = session.state
            try:
                self._handle(session, waiting)
            except Exception as error:  # noqa: BLE001
                # A fault of ours. The person in the next image may not suffer from it.
                self.get_logger().error(''.join(traceback.format_exception(error)))
                session.restart(session.start)
            after = session.state
            if (after.status, after.faults.keys()) != (before.status, before.faults.keys()):
                self._diagnose()

    def _handle(self, session: FilterSession, waiting: Waiting) -> None:
        session.count_dropped(waiting.dropped)
        tracked = session.state.images['tracked']
        if waiting.source == _RESTART:
            session.restart(waiting.content)
            return
        try:
            message = deserialise(waiting.content, self._types[waiting.source])
        except Exception as error:  # noqa: BLE001
            # Bytes from outside meet generated code here, which does not say what it may raise.
            handled = session.refuse(waiting.source, _first_line(error))
        else:
            handled = session.take(waiting.source, message)
        if session.state.images['tracked'] > tracked:
            self._latencies.append(time.monotonic() - waiting.arrival)
        for text in handled.warnings:
            self.get_logger().warn(f'{text} (more of the kind are counted in /diagnostics)')
        if self._handled.get_subscription_count():
            self._handled.publish(_handled_message(handled))

    def _publish(self, output: Output) -> None:
        self._outputs[output.topic].publish(output.data)

    def _is_wanted(self, topic: str) -> bool:
        return bool(self._outputs[topic].get_subscription_count())

    # Diagnostics.

    def _diagnose_period(self) -> None:
        state = self._session.state if self._session is not None else None
        latencies = [self._latencies.popleft() for _ in range(len(self._latencies))]
        self._rates.next_period(state, latencies)
        self._diagnose()

    def _diagnose(self) -> None:
        label = self._state_machine.current_state[1]
        state = self._session.state if self._session is not None else None
        status = DiagnosticStatus(name=f'{self.get_fully_qualified_name().strip("/")}: track')
        values = [('lifecycle', label)]
        if self._failure:
            status.level, status.message = DiagnosticStatus.ERROR, self._failure
        elif state is None or label != 'active':
            status.level, status.message = DiagnosticStatus.OK, label
        else:
            status.level, status.message = self._judgement(state)
        if state is not None:
            values += [*_state_values(state), *self._rates.values()]
        status.values = [KeyValue(key=key, value=value) for key, value in values]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _judgement(self, state: SessionState) -> tuple[bytes, str]:
        rates = self._rates
        if state.status == 'lost':
            return DiagnosticStatus.WARN, f'lost: misfit {state.misfit:.2f}'
        if rates.dropped:
            return DiagnosticStatus.WARN, f'late: {rates.dropped} images dropped in a second'
        if rates.faults:
            return DiagnosticStatus.WARN, state.last_fault
        if state.wants:
            return DiagnosticStatus.WARN, f'waits for {state.wants}'
        return DiagnosticStatus.OK, f'{state.status}, {state.modes} modes'


class _Rates:
    """What happened in the last period of diagnostics."""

    def __init__(self) -> None:
        self.dropped = 0
        self.faults = 0
        self._received = self._tracked = 0.0
        self._latencies: list[float] = []
        self._counts = (0, 0, 0, 0)
        self._began = time.monotonic()

    def next_period(self, state: SessionState | None, latencies: list[float]) -> None:
        now = time.monotonic()
        counts = (0, 0, 0, 0)
        if state is not None:
            images = state.images
            counts = (
                images['received'], images['tracked'], images['dropped'], state.faults.total(),
            )  # fmt: skip
        # A node that was configured anew counts anew.
        change = [max(new - old, 0) for new, old in zip(counts, self._counts, strict=True)]
        duration = max(now - self._began, 1e-3)
        self._received, self._tracked = change[0] / duration, change[1] / duration
        self.dropped, self.faults = change[2], change[3]
        self._latencies, self._counts, self._began = latencies, counts, now

    def values(self) -> list[tuple[str, str]]:
        known = self._latencies or [math.nan]
        return [
            ('images received a second', f'{self._received:.1f}'),
            ('images tracked a second', f'{self._tracked:.1f}'),
            ('latency, mean, ms', f'{1e3 * sum(known) / len(known):.1f}'),
            ('latency, largest, ms', f'{1e3 * max(known):.1f}'),
        ]


def _state_values(state: SessionState) -> list[tuple[str, str]]:
    return [
        ('status', state.status),
        *((f'images {what}', str(state.images[what])) for what in ('received', 'tracked')),
        *((f'images {what}', str(state.images[what])) for what in ('skipped', 'dropped')),
        ('modes', str(state.modes)),
        ('entropy of the weights, nats', f'{state.entropy:.3f}'),
        ('misfit', f'{state.misfit:.3f}'),
        ('evaluations of the likelihood', str(state.evaluations)),
        *((f'faults: {kind}', str(count)) for kind, count in sorted(state.faults.items())),
        ('last fault', state.last_fault),
    ]


def _handled_message(handled: Handled) -> DiagnosticStatus:
    values = [
        ('stamp', handled.stamp_ns),
        *(('fault', text) for text in handled.faults),
        *(('warning', text) for text in handled.warnings),
        *handled.published,
    ]
    return DiagnosticStatus(
        level=DiagnosticStatus.WARN if handled.faults else DiagnosticStatus.OK,
        name=handled.source,
        message='; '.join(handled.faults),
        values=[KeyValue(key=key, value=str(value)) for key, value in values],
    )


def _descriptor(parameter: DeclaredParameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=f'{parameter.description} {EFFECTS[parameter.effect]}',
        read_only=parameter.effect == AT_LAUNCH,
    )
    if parameter.limits is not None:
        low, high = parameter.limits
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
    return descriptor


def _first_line(error: BaseException) -> str:
    return ' '.join(str(error).split()) or type(error).__name__


def main(args: list[str] | None = None) -> int:
    """Runs the node until it is told to stop; 0, or 1 where it could not start."""
    # The handlers of rclpy end the context under whatever is going on; ours let it come to its end.
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = FilterNode()
    except (ParameterException, ValueError, RuntimeError) as error:
        sys.stderr.write(f'filter_node: {_first_line(error)}\n')
        rclpy.try_shutdown()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.start()
    while not stopped.is_set():
        # A signal does not wake who waits for messages.
        executor.spin_once(timeout_sec=0.2)
    if not node.stop(_LAST_ESTIMATE):
        sys.stderr.flush()
        os._exit(0)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
