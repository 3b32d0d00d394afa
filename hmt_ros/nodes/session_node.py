"""A lifecycle node around a session: messages in, messages out, one thread that estimates.

The executor's thread only queues messages and answers services; another thread estimates.
Messages pass the middleware as bytes, so that nodes and offline commands read and write them with
the same code.

Nodes of one process share their threads and pass messages to each other unserialised. If several
nodes need a topic of another process, one node subscribes on behalf of all.

`~/handled` (hmt_msgs/Handled) reports every received message, once all its results are published.
A player that waits for this report runs in lock step with the node.
"""

from __future__ import annotations

import gc
import time
import traceback
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from hmt_ros.nodes.diagnostics import MiddlewareEvents, Rates, trouble_of_period
from hmt_ros.nodes.estimating_thread import (
    EstimatingThreads,
    Estimator,
    Waiting,
    received,
)
from hmt_ros.nodes.node_parameters import (
    QOS_OVERRIDES,
    declare,
    file_folders,
    next_step,
    refuse,
    unknown_parameters,
)
from hmt_ros.nodes.own_messages import OwnMessages
from hmt_ros.nodes.patient_reader import PatientReader
from hmt_ros.nodes.silent_topics import SilentTopics
from hmt_ros.nodes.subscribed_topic import (
    HANDLED_QOS,
    RELIABLE_QOS,
    SubscribedTopic,
    message_class,
    published_with,
    read_installed_messages,
)
from hmt_ros.sessions.declared_parameters import (
    NodeParameters,
    values_of,
    with_values,
)
from hmt_ros.sessions.handled import HANDLED, Handled, Output, handled_message
from hmt_ros.sessions.named_file import FILE_PARAMETERS, check_place, public_line
from hmt_ros.sessions.session import SUBSCRIBERS_KEY, Session, SessionState
from msg_tools import RosbagsMessages
from msg_tools.files.error_line import error_line, one_line
from msg_tools.messages.cdr import serialise

AnySession = TypeVar('AnySession', bound=Session[Any, Any])
Parameters = TypeVar('Parameters', bound=NodeParameters)
# Number of diagnostics periods between two console lines with the same status.
QUIET_PERIODS = 10
# Time for which the diagnostics report a backward jump of the clock, s.
TIME_JUMP_ALARM_TIME = 5.0
# Maximum number of parameters in one request; each takes a fraction of a millisecond.
MAX_PARAMETERS = 256


class SessionNode(LifecycleNode, Generic[AnySession, Parameters]):
    """A lifecycle node around a session; a settings dataclass defines the parameters.

    Args:
        defaults: default values of the parameters; None: `DEFAULTS`.
        beside: node of this process whose threads are shared; None for the first node.
        options: keyword arguments of `rclpy.lifecycle.LifecycleNode`.

    Attributes:
        NAME: name of the node.
        SUBJECT: subject in the name of the diagnostics status, such as 'track'.
        SESSION: class of the session.
        DEFAULTS: parameters with their default values.
        CAN_WAIT: whether the other nodes of the process have priority over this one.
    """

    NAME: ClassVar[str]
    SUBJECT: ClassVar[str]
    # Any, because ClassVar does not support the type variables of the class.
    SESSION: ClassVar[Any]
    DEFAULTS: ClassVar[Any]
    CAN_WAIT: ClassVar[bool] = False

    def __init__(
        self,
        defaults: Any = None,
        beside: SessionNode[Any, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(self.NAME, **options)
        defaults = self._in_namespace(self.DEFAULTS if defaults is None else defaults)
        if self.get_parameter('use_sim_time').value:
            # Simulated time jumps back when a bag is played again.
            defaults = replace(defaults, reset_on_time_jump=True)
        self._settings: Parameters = declare(self, defaults)
        # Only parameters that were set at launch may name files in any folder.
        self._at_launch = self._settings
        self._folders = file_folders(self._settings.file_folders)
        self._reader = PatientReader()
        self._names = values_of(defaults).keys()
        self._warn_of_unknown(qos=False)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        for service in self.services:
            service.callback = partial(self._serve, service.callback)
        self._session: AnySession | None = None
        self._estimator: Estimator | None = None
        self._outputs: dict[str, Any] = {}
        self._handled: Any = None
        self._offered: list[Any] = []
        self._threads: EstimatingThreads = (
            EstimatingThreads() if beside is None else beside._threads
        )
        # Nodes of this process, in the order in which they take turns.
        self._nodes: list[SessionNode[Any, Any]] = [] if beside is None else beside._nodes
        self._local_names: dict[str, str] = {}
        offered = (topic for topic in self._offered_topics() if not topic.startswith('/'))
        self._offered_names = {self._local_name(topic) for topic in offered}
        # Inputs of this node, and the subscriptions that it owns, by local topic name.
        self._heard: dict[str, SubscribedTopic] = {}
        self._connected: dict[str, Any] = {}
        self._nodes.append(self)
        # Sent messages on topics that the node also subscribes to.
        self._own = OwnMessages()
        self._failure = ''
        # Report on the last backward jump of the clock, and the time when it was first seen, s.
        self._jump = '', 0.0
        # Number of internal errors of the node, and the last error message.
        self._errors, self._last_error = 0, ''
        self._told_at = self._untold = 0
        self._told_status = ''
        self._events = MiddlewareEvents(self.get_logger().warn)
        self._silent = SilentTopics(self, self.get_logger().warn)
        self._rates = Rates(f'{self.SESSION.UNIT}s', self.SESSION.DONE)
        self._diagnostics = self.create_publisher(
            DiagnosticArray,
            '/diagnostics',
            RELIABLE_QOS,
            event_callbacks=self._events.of_publisher('/diagnostics'),
        )
        # Diagnostics must also run with use_sim_time when nobody publishes a clock.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._diagnose_period, clock=steady)

    # Methods that nodes override.

    def _offered_topics(self) -> Iterable[str]:
        """Topics that the node publishes; the nodes of this process receive them directly."""
        return self.SESSION.TOPICS

    def _in_namespace(self, defaults: Any) -> Any:
        """Default values of the parameters, adapted to the namespace of the node."""
        return defaults

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        """Types, names and callbacks of the services."""
        return ()

    @abstractmethod
    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        """Topics to subscribe to; the messages of the last topic trigger estimates."""

    def _messages_of_others(self, settings: Parameters) -> Mapping[str, str]:
        """Message types from other packages, each mapped to the feature that needs it.

        Raises:
            ValueError: no suitable package is installed.
        """
        return {}

    # Common to all nodes.

    def start(self) -> None:
        """Configures and activates the node, unless `autostart` is off."""
        if not self._settings.autostart:
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def stop(self, timeout: float | None = None) -> bool:
        """Stops the estimator when its present work is done.

        Returns:
            Whether it stopped within `timeout` s.
        """
        if self._estimator is not None and not self._estimator.stop(timeout):
            return False
        self._estimator = None
        return True

    def _new_session(self, settings: Parameters, *functions: Callable[..., Any]) -> AnySession:
        """A session with these parameters.

        Raises:
            ValueError: a parameter names a file or package that is missing or unusable.
        """
        for msgtype, needed_by in self._messages_of_others(settings).items():
            read_installed_messages(msgtype, needed_by)
        session: AnySession = self.SESSION(settings, *functions)
        session.decode_image = self._threads.decode
        session.share(self._threads.seen_images)
        return session

    def _answer(self, response: Any, field: str, make: Callable[[AnySession], Any]) -> Any:
        """Fills a field of a response with a message that the session makes.

        Raises:
            ValueError: the node is not configured.
        """
        if self._session is None:
            raise ValueError('the node is not configured')
        data = serialise(make(self._session))
        response.success = True
        setattr(response, field, deserialize_message(data, type(getattr(response, field))))
        return response

    def _new_publisher(self, topic: str, msgtype: str, qos: QoSProfile) -> Any:
        events = self._events.of_publisher(self.resolve_topic_name(topic))
        return self.create_lifecycle_publisher(
            message_class(msgtype), topic, qos, event_callbacks=events
        )

    # Lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Creates the session, its publishers and services."""
        try:
            session = self._new_session(self._settings, self._publish, self._is_wanted)
        except ValueError as error:
            self._failure = f'{public_line(error)}; {next_step(self)}'
            self.get_logger().error(self._failure)
            self._diagnose()
            return TransitionCallbackReturn.FAILURE
        self._failure = ''
        self._session = session
        for topic in self._offered_topics():
            published = published_with(self.SESSION.TOPICS[topic])
            self._outputs[topic] = self._new_publisher(topic, *published)
        self._handled = self._new_publisher('~/handled', HANDLED, HANDLED_QOS)
        self._offered = [
            self.create_service(kind, name, partial(self._serve, callback))
            for kind, name, callback in self._offered_services()
        ]
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribes to the inputs and starts the estimator."""
        assert self._session is not None
        session, inputs = self._session, list(self._wanted_inputs())
        result = super().on_activate(state)
        self._estimator = Estimator(
            session,
            self._threads.later if self.CAN_WAIT else self._threads.poses,
            place=self._nodes.index(self),
            report=self._report_handled,
            report_change=self._diagnose,
            report_error=self._describe_error,
        )
        session.topic_names = {one.source: self.resolve_topic_name(one.topic) for one in inputs}
        self._silent.listen(inputs, self.SESSION.COUNTED)
        for one in inputs:
            self._subscribe(one)
        self._warn_of_unknown(qos=True)
        topic = session.topic_names[inputs[-1].source]
        wants = session.state.wants
        self.get_logger().info(f'{self._rates.name} from {topic}; waits for {wants}')
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribes and stops the estimator."""
        self._unsubscribe()
        self.stop()
        if self._session is not None:
            self._report_handled(self._session.finish())
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deletes the session and its topics; also called at shutdown and after an error."""
        self._close()
        return super().on_cleanup(state)

    on_shutdown = on_error = on_cleanup

    def _subscribe(self, wanted: SubscribedTopic) -> None:
        assert self._estimator is not None
        self._estimator.listen(wanted)
        name = self._local_name(wanted.topic)
        self._heard[name] = wanted
        self._connect(name)

    def _connect(self, name: str) -> None:
        """Subscribes to a topic, unless a node of this process already publishes or receives it."""
        if any(name in one._offered_names or name in one._connected for one in self._nodes):
            return
        wanted = self._heard[name]

        def receive(data: bytes) -> None:
            if wanted.topic not in self._outputs or not self._own.is_own(data):
                waiting = received(data, wanted)
                for one in self._listeners(name):
                    one._enqueue(name, waiting)

        self._connected[name] = self.create_subscription(
            message_class(wanted.msgtype),
            wanted.topic,
            receive,
            wanted.qos,
            raw=True,
            event_callbacks=self._events.of_subscription(self.resolve_topic_name(wanted.topic)),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _hand_over(self, name: str) -> None:
        """Unsubscribes from a topic; the next listening node of the process subscribes to it."""
        del self._heard[name]
        if (subscription := self._connected.pop(name, None)) is None:
            return
        self.destroy_subscription(subscription)
        for one in self._listeners(name):
            one._connect(name)

    def _listeners(self, name: str) -> list[SessionNode[Any, Any]]:
        """The nodes of this process that listen to a topic."""
        return [one for one in self._nodes if name in one._heard]

    def _enqueue(self, name: str, waiting: Waiting) -> None:
        """Queues a message of a topic. Thread-safe."""
        wanted, estimator = self._heard.get(name), self._estimator
        if wanted is not None and estimator is not None:
            self._silent.arrived(wanted.source, waiting.arrival)
            estimator.queue.put(waiting._replace(source=wanted.source))

    def _unsubscribe(self) -> None:
        for name in list(self._heard):
            self._hand_over(name)
        self._events.forget()
        self._silent.listen(())

    def _close(self) -> None:
        self._unsubscribe()
        self.stop()
        for publisher in [*self._outputs.values(), self._handled]:
            if publisher is not None:
                self.destroy_lifecycle_publisher(publisher)
        self._outputs.clear()
        self._handled = None
        for service in self._offered:
            self.destroy_service(service)
        self._offered.clear()
        self._session = None
        # Reference cycles keep a session and its images alive until the next garbage collection.
        gc.collect()

    def _serve(self, callback: Callable[..., Any], request: Any, response: Any) -> Any:
        """Calls the callback of a service; if it fails, refuses the request with the reason."""
        asked = getattr(request, 'parameters', ())
        try:
            if len(asked) > MAX_PARAMETERS:
                raise ValueError(f'{len(asked)} parameters, the limit is {MAX_PARAMETERS}')
            response = callback(request, response)
        except Exception as error:  # noqa: BLE001
            what, text = 'a request is refused', public_line(error)
            if (transition := getattr(request, 'transition', None)) is not None:
                what = f'transition {one_line(transition.label) or transition.id} is not possible'
            self.get_logger().warn(f'{what}: {text}', throttle_duration_sec=1.0)
            refuse(response, len(asked), text)
        for result in getattr(response, 'results', ()):
            result.reason = one_line(result.reason)
        return response

    # Parameters.

    def _warn_of_unknown(self, *, qos: bool) -> None:
        """Warns about values that are given for unknown parameters.

        Args:
            qos: True checks only the QoS overrides, which subscriptions declare; False checks
                all other parameters.
        """
        given = [x for x in self._parameter_overrides if x.startswith(QOS_OVERRIDES) == qos]
        for text in unknown_parameters(given, self._parameters):
            self.get_logger().warn(text)

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        changed = {p.name: p.value for p in parameters if p.name in self._names}
        if not changed:
            return SetParametersResult(successful=True)
        try:
            settings = with_values(self._settings, changed)
            if any(name in changed for name in self.SESSION.CHECKED):
                self._reader.read(settings, partial(self._check, settings), self._receive)
        except Exception as error:  # noqa: BLE001
            # Every refused request gets a reason.
            return SetParametersResult(successful=False, reason=public_line(error))
        self._settings = settings
        if self._session is not None:
            self._session.parameters = settings
        if self._estimator is not None:
            self._estimator.take_limit()
        return SetParametersResult(successful=True)

    def _check(self, settings: Parameters) -> None:
        """Checks new parameters by reading the files that they name.

        Raises:
            ValueError: a file can not be used, or must not be read by a running node.
        """
        launched, values = values_of(self._at_launch), values_of(settings)
        for name in FILE_PARAMETERS:
            if values.get(name, '') != launched.get(name, ''):
                check_place(name, values[name], self._folders)
        self._new_session(settings, lambda output: None)

    def _receive(self) -> None:
        """Receives messages while the executor's thread is blocked."""
        for one in (x for node in self._nodes for x in [*node._connected.values()]):
            with one.handle:
                while (found := one.handle.take_message(one.msg_type, one.raw)) is not None:
                    one.callback(found[0])

    # Called by the thread that estimates.

    def _report_handled(self, handled: Handled) -> None:
        for text in handled.events:
            self.get_logger().info(text)
        for text in handled.warnings:
            self.get_logger().warn(f'{text} (more of this kind are counted in /diagnostics)')
        if self._handled.get_subscription_count():
            self._handled.publish(serialise(handled_message(RosbagsMessages(), handled)))

    def _describe_error(self, error: Exception) -> str:
        self._errors += 1
        self._last_error = f'{type(error).__name__}: {error_line(error)}'
        self.get_logger().error(f'{self._last_error}; --log-level debug shows where')
        self.get_logger().debug(''.join(traceback.format_exception(error)))
        return self._last_error

    def _publish(self, output: Output) -> None:
        publisher, name = self._outputs[output.topic], self._local_name(output.topic)
        if name in self._heard:
            self._own.sent(output.data)
        inside = self._inside(output.topic)
        # If only nodes of this process subscribe, the message is not published over ROS.
        if not inside or publisher.get_subscription_count():
            publisher.publish(output.data)
        for one in inside:
            one._enqueue(
                name, Waiting('', lambda: output.message, time.monotonic(), output.stamp_ns)
            )

    def _is_wanted(self, topic: str) -> bool:
        return bool(self._subscribers(topic))

    def _subscribers(self, topic: str) -> int:
        """Number of subscribers to a topic of this node, in this process and in others."""
        others = self._outputs[topic].get_subscription_count()
        return int(others) + len(self._inside(topic))

    def _inside(self, topic: str) -> list[SessionNode[Any, Any]]:
        """The nodes of this process that receive a topic of this node directly."""
        return [] if topic.startswith('/') else self._listeners(self._local_name(topic))

    def _local_name(self, topic: str) -> str:
        """Name of a topic in this process; absolute topics, such as /tf, only pass over ROS."""
        if topic not in self._local_names:
            own = f'{self.get_fully_qualified_name()} {topic}'
            name = own if topic.startswith('/') else self.resolve_topic_name(topic)
            self._local_names[topic] = name
        return self._local_names[topic]

    # Diagnostics.

    def _diagnose_period(self) -> None:
        counts: Counter[str] = Counter()
        if self._session is not None:
            state = self._session.state
            counts = Counter(state.counts)
            counts['faults'] = state.faults.total()
        counts['lost'] = self._events.lost
        estimator = self._estimator
        durations = [] if estimator is None else estimator.take_durations()
        waiting = 0 if estimator is None else len(estimator.queue)
        self._rates.next_period(counts, durations, waiting)
        if self._session is not None and self._heard:
            self._silent.check(self._session.needed_inputs())
        self._diagnose()
        self._log_status(counts)

    def _log_status(self, counts: Counter[str]) -> None:
        """While messages arrive, logs the status after each change, and periodically in between."""
        if self._session is None or counts['received'] == self._told_at:
            return
        state, self._told_at = self._session.state, counts['received']
        self._untold += 1
        if state.status == self._told_status and self._untold < QUIET_PERIODS:
            return
        self._told_status, self._untold = state.status, 0
        label = self._state_machine.current_state[1]
        _, text = self._status_level(label, state)
        self.get_logger().info(f'{text}; {self._rates.line()}')

    def _status_level(self, label: str, state: SessionState | None) -> tuple[bytes, str]:
        """Level and message of the diagnostics."""
        if self._failure:
            return DiagnosticStatus.ERROR, self._failure
        if state is None or label != 'active':
            return DiagnosticStatus.OK, label
        if state.time_jump != self._jump[0]:
            self._jump = state.time_jump, time.monotonic()
        if state.time_jump and time.monotonic() - self._jump[1] < TIME_JUMP_ALARM_TIME:
            return DiagnosticStatus.ERROR, state.time_jump
        trouble = (
            state.trouble()
            or self._events.deaf_topic(self._connected.values())
            or trouble_of_period(state, self._rates, self._silent)
        )
        if trouble:
            return DiagnosticStatus.WARN, trouble
        return DiagnosticStatus.OK, f'{state.status}, {state.summary()}'

    def _hardware(self, state: SessionState | None) -> str:
        """Name of the camera: its frame or, if the frame is unknown, the topic of its messages."""
        if state is not None and state.frame_id:
            return state.frame_id
        # The local name of an absolute topic starts with the name of the node.
        return next(reversed(self._heard), '').rpartition(' ')[2]

    def _diagnose(self) -> None:
        label = self._state_machine.current_state[1]
        state = self._session.state if self._session is not None else None
        name = f'{self.get_fully_qualified_name().strip("/")}: {self.SUBJECT}'
        level, text = self._status_level(label, state)
        status = DiagnosticStatus(name=name, level=level, message=text)
        status.hardware_id = self._hardware(state)
        values = [('lifecycle', label)]
        if state is not None:
            values += [
                ('status', state.status),
                *(
                    (f'{self._rates.name} {what}', str(state.counts[what]))
                    for what in ('received', self.SESSION.DONE, 'skipped', 'dropped')
                ),
                *state.values(),
                *((f'faults: {kind}', str(count)) for kind, count in sorted(state.faults.items())),
                ('last fault', state.last_fault),
                ('errors of the node itself', str(self._errors)),
                ('last error of the node itself', self._last_error),
                *((f'nothing on {topics}', why) for topics, why in self._silent.texts.items()),
                *self._events.values(),
                *self._rates.values(),
                *(
                    (f'{SUBSCRIBERS_KEY}{topic}', str(self._subscribers(topic)))
                    for topic in self._outputs
                ),
            ]
        status.values = [KeyValue(key=key, value=value) for key, value in values]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
