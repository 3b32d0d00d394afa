"""The player, a ROS node that sends messages to the real nodes, in a separate DDS domain."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch


class LiveNodeError(ValueError):
    """A node did not start or does not answer; the message is one line."""


class Player:
    """A ROS node that publishes for other nodes and subscribes to them, in a separate domain.

    Raises:
        LiveNodeError: ROS is not available.
    """

    def __init__(self, opened: ExitStack) -> None:
        self.folder = Path(opened.enter_context(TemporaryDirectory(prefix='hmt_ros.')))
        self.domain = opened.enter_context(reserved_domain())
        try:
            import rclpy
            from diagnostic_msgs.msg import DiagnosticArray
            from geometry_msgs.msg import PoseWithCovarianceStamped
            from hmt_msgs.msg import (
                Body,
                Ground,
                Handled,
                KeepOut,
                Keypoints2D,
                Keypoints3D,
                PoseMixture,
                TrajectoryMixture,
            )
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
            from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
            from std_msgs.msg import String
            from tf2_msgs.msg import TFMessage
            from visualization_msgs.msg import MarkerArray
        except ImportError as error:
            raise LiveNodeError(
                f'--live needs a sourced ROS 2 workspace ({error}): source install/setup.bash'
            ) from error
        kinds = (
            Body,
            CameraInfo,
            CompressedImage,
            Ground,
            Handled,
            Image,
            JointState,
            KeepOut,
            Keypoints2D,
            Keypoints3D,
            MarkerArray,
            PoseMixture,
            PoseWithCovarianceStamped,
            String,
            TFMessage,
            TrajectoryMixture,
        )
        self.classes: dict[str, Any] = {
            f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}': kind for kind in kinds
        }
        self.reliable = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        self.latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        context = rclpy.Context()
        with patch.dict(os.environ, environment(self.domain)):
            rclpy.init(context=context, domain_id=self.domain)
        opened.callback(rclpy.try_shutdown, context=context)
        self.node = rclpy.create_node('replay', context=context)
        opened.callback(self.node.destroy_node)
        self.executor = SingleThreadedExecutor(context=context)
        opened.callback(self.executor.shutdown)
        self.executor.add_node(self.node)
        # Newest diagnostics by node name.
        self.diagnostics: dict[str, dict[str, str]] = {}

        def diagnosed(message: DiagnosticArray) -> None:
            for status in message.status:
                name = status.name.partition(':')[0]
                self.diagnostics[name] = {value.key: value.value for value in status.values}

        self.node.create_subscription(DiagnosticArray, '/diagnostics', diagnosed, self.reliable)


@contextmanager
def reserved_domain() -> Iterator[int]:
    """Reserves a ROS domain that no other replay or test run on this machine uses.

    As in ament's domain_coordinator, a domain is in use while port 32768 + domain is bound.
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
    raise LiveNodeError('all ROS domains from 1 to 100 are in use')


def environment(domain: int) -> dict[str, str]:
    """Environment variables that put a process into a domain, limited to this machine."""
    return {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
