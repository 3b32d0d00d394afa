#!/usr/bin/env python3
"""Converts one motion of the smoother's window to a JointTrajectory for a robot.

    python examples/joint_trajectory.py --ros-args -r __ns:=/humans/bodies/p1

It subscribes to `trajectory_mixture` (hmt_msgs/TrajectoryMixture) and publishes `joint_trajectory`
(trajectory_msgs/JointTrajectory), the positions of the heaviest motion with the names of the URDF.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from msg_tools import MessageError
from msg_tools.messages.headers import SECOND_NS, header_message
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture, trajectory_mixture_of


def joint_trajectory(
    messages: MessageFactory, content: TrajectoryMixture, identity: int | None = None
) -> Any:
    """trajectory_msgs/JointTrajectory of one of the trajectories of a window: positions only.

    Args:
        messages: factory; one for ROS has the classes JointTrajectory, JointTrajectoryPoint,
            Duration, Header and Time.
        identity: identity of the motion; None selects the heaviest.

    Returns:
        A message with the timestamp of the first pose; its times are relative to it.

    Raises:
        MessageError: no trajectory has the identity.
    """
    weights = content.weights
    if identity is not None:
        weights = np.where(content.identities == identity, weights, -1.0)
    chosen = int(np.argmax(weights))
    if weights[chosen] < 0.0:
        assert content.identities is not None
        raise MessageError(
            f'trajectories: none has the identity {identity}, they have '
            f'{content.identities.tolist()}'
        )
    points = []
    for pose, stamp in zip(content.means[chosen], content.stamps_ns, strict=True):
        seconds, rest = divmod(stamp - content.stamps_ns[0], SECOND_NS)
        time = messages.create('builtin_interfaces/msg/Duration', sec=seconds, nanosec=rest)
        kind = 'trajectory_msgs/msg/JointTrajectoryPoint'
        points.append(messages.create(kind, positions=pose, time_from_start=time))
    return messages.create(
        'trajectory_msgs/msg/JointTrajectory',
        header=header_message(messages, content.stamps_ns[0], content.frame_id),
        joint_names=list(content.dof_names),
        points=points,
    )


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from builtin_interfaces.msg import Duration, Time
    from hmt_msgs.msg import TrajectoryMixture as Trajectories
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Header
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    from msg_tools.messages.message_types import GeneratedMessages

    messages = GeneratedMessages([JointTrajectory, JointTrajectoryPoint, Duration, Time, Header])
    rclpy.init()
    node = rclpy.create_node('joint_trajectory')
    publisher = node.create_publisher(JointTrajectory, 'joint_trajectory', 10)

    def tell(window: Trajectories) -> None:
        publisher.publish(joint_trajectory(messages, trajectory_mixture_of(window)))

    node.create_subscription(Trajectories, 'trajectory_mixture', tell, 10)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
