"""Runs one or several nodes in this process until a signal stops it.

With --help it prints the usage and the parameters of a node.
"""

from __future__ import annotations

import ctypes
import os
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

import cv2
import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from hmt_ros.nodes.node_parameters import files_for_others
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.signals import on_signals
from hmt_ros.sessions.declared_parameters import DeclaredParameter, declared_parameters
from hmt_ros.sessions.parameter_file import yaml_scalar
from msg_tools.files.error_line import error_line

# Environment variable with the id of the parent process; a node ends when that process ends.
OWNER_VARIABLE = 'HMT_ROS_OWNER'

# Parameter of mallopt(3) for the maximum number of heaps.
_ARENA_MAX = -8
# Time after which a thread yields Python's lock, s. With the default of 5 ms, a busy thread would
# delay every other thread by 5 ms after each call of compiled code.
_SWITCH_INTERVAL = 0.0005
# Maximum time that a stopping node waits for its last estimate, s.
_LAST_ESTIMATE_TIME = 5.0
_WIDTH = 100
_TYPES = {bool: 'bool', int: 'int', float: 'float', str: 'string', tuple: 'list of floats'}


def run(kind: type[SessionNode[Any, Any]], args: list[str] | None = None) -> int:
    """Runs a node until a signal stops it; returns 0, or 1 if it could not start."""
    arguments = sys.argv[1:] if args is None else args
    if wants_help(arguments):
        sys.stdout.write(usage(kind))
        return 0
    return run_together(kind.NAME, lambda: [kind()], arguments)


def run_together(
    name: str, make: Callable[[], Sequence[SessionNode[Any, Any]]], arguments: list[str]
) -> int:
    """Runs nodes until a signal stops the process; returns 0, or 1 if a node could not start.

    Args:
        make: function that creates the nodes; called after ROS is initialised.
        arguments: command-line arguments, which are passed to ROS.
    """
    _use_one_heap()
    # OpenCV's threads busy-wait, which costs more than it saves on images of camera size.
    cv2.setNumThreads(1)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    # rclpy's own handlers would shut down the context during an estimate; these let it finish.
    stopped = threading.Event()
    on_signals(lambda *_: stopped.set())
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        nodes = make()
    except Exception as error:  # noqa: BLE001 - whatever it is given, a node starts or says why not
        sys.stderr.write(f'{name}: {error_line(error)}\n')
        rclpy.try_shutdown()
        return 1
    executor = _new_executor()
    for node in nodes:
        executor.add_node(node)
        for text in files_for_others(arguments, node.get_fully_qualified_name()):
            node.get_logger().warn(text)
    for node in nodes:
        node.start()
    # A killed parent process can not stop the node; the node then ends by itself.
    owner = os.environ.get(OWNER_VARIABLE)
    while not stopped.is_set() and owner in (None, str(os.getppid())):
        _spin_once(executor, nodes)
    end = time.monotonic() + _LAST_ESTIMATE_TIME
    ended = [node.stop(max(end - time.monotonic(), 0.0)) for node in nodes]
    if not all(ended):
        sys.stderr.flush()
        os._exit(0)
    executor.shutdown()
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()
    return 0


def _use_one_heap() -> None:
    """Makes all threads allocate from one heap, if the C library supports it.

    Image buffers pass from thread to thread. With one heap per thread, fragmentation would make the
    process grow without limit. Under Python's lock, threads rarely wait for the common heap.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def _new_executor() -> Executor:
    """Return an events executor; other executors search all topics of all nodes for each message.

    The events executor processes a quarter more images per second. Early Jazzy releases lack it.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _spin_once(executor: Executor, nodes: Sequence[SessionNode[Any, Any]]) -> None:
    try:
        # The timeout is needed because a signal does not wake a thread that waits for messages.
        executor.spin_once(timeout_sec=0.2)
    except Exception as error:  # noqa: BLE001
        # The node survives errors of rclpy, for example if /clock is negative.
        text = f'{type(error).__name__}: {error_line(error)}'
        nodes[0].get_logger().error(f'a callback failed: {text}', throttle_duration_sec=1.0)
        # Messages that arrived together with the failed one would stay unread; adding the nodes
        # again makes the executor find them.
        for node in nodes:
            executor.remove_node(node)
            executor.add_node(node)


def wants_help(arguments: Iterable[str]) -> bool:
    """Whether a command line asks for help, before or after --ros-args."""
    return any(word in ('-h', '--help') for word in arguments)


def usage(kind: type[SessionNode[Any, Any]]) -> str:
    """The help of a node: usage, and all parameters with types, ranges, defaults and effects."""
    name = kind.NAME
    # First line of a module: "<name>: <inputs> in, <outputs> out; <remarks>."
    module = sys.modules[kind.__module__].__doc__ or name
    purpose = module.splitlines()[0].partition(';')[0].rstrip('.')
    published = ', '.join(kind.SESSION.TOPICS)
    head = [
        f'usage: ros2 run hmt_ros {name} [--ros-args [-p NAME:=VALUE] [-r TOPIC:=NAME]',
        '           [-r __ns:=NAMESPACE] [--params-file FILE] [--log-level LEVEL] ...]',
        '',
        f'{purpose}.',
        '',
        *textwrap.wrap(f'Publishes {published}.', _WIDTH),
        f'"ros2 node info /{name}" lists all topics and services of the running node, and',
        f'"ros2 param describe /{name} NAME" describes a parameter.',
        '',
        'parameters, all optional, with type, range, default, and when a new value takes effect:',
    ]
    return '\n'.join([*head, *described(kind.DEFAULTS)]) + '\n'


def described(settings: Any) -> list[str]:
    """Lines that describe the parameters of a settings dataclass."""
    return [line for each in declared_parameters(settings) for line in _described(each)]


def _described(parameter: DeclaredParameter) -> list[str]:
    kind = _TYPES[type(parameter.default)]
    default = f'default {yaml_scalar(parameter.default)}'
    facts = filter(None, (kind, parameter.bounds, default, parameter.effect))
    text = textwrap.wrap(
        parameter.description,
        _WIDTH,
        initial_indent=6 * ' ',
        subsequent_indent=6 * ' ',
        break_on_hyphens=False,
    )
    return ['', f'  {parameter.name} ({"; ".join(facts)})', *text]
