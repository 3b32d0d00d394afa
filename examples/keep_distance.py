#!/usr/bin/env python3
"""Slows a robot down near a person, and stops it where nothing is known.

    python examples/keep_distance.py --ros-args -r __ns:=/humans/bodies/p1

It takes `keep_out` (hmt_msgs/KeepOut) and publishes `speed_scale` (std_msgs/Float64), 10 times a
second: 1 where the space to keep out of is `FREE` m away from the origin of its frame or more, 0
where it is nearer than `STOP`, and 0 where the person was not seen for `UNSEEN` s or nothing comes.
Set `fixed_frame` of the filter, and measure from your robot in that frame, where the camera is not
on the robot.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import Any

import numpy as np

STOP, FREE = 0.5, 2.0  # m
UNSEEN, SILENCE = 0.5, 0.5  # s


def distance_to_capsules(starts: Any, ends: Any, radii: Any) -> float:
    """Distance of the origin from the nearest capsule, m; infinite without capsules."""
    a, b = np.reshape(starts, (-1, 3)), np.reshape(ends, (-1, 3))
    if not len(a):
        return math.inf
    along = b - a
    squared = np.maximum((along**2).sum(1), 1e-12)
    at = np.clip(-(a * along).sum(1) / squared, 0.0, 1.0)
    nearest = np.linalg.norm(a + at[:, None] * along, axis=1) - np.asarray(radii)
    return max(float(nearest.min()), 0.0)


def speed_scale(message: Any) -> float:
    """Share of its usual speed with which the robot may go, by an hmt_msgs/KeepOut."""
    if message.state == message.STATE_NOBODY:
        return 1.0
    known = message.state in (message.STATE_TRACKING, message.STATE_LOST)
    if not known or not message.unseen < UNSEEN:
        return 0.0
    distance = distance_to_capsules(message.starts, message.ends, message.radii)
    return float(np.clip((distance - STOP) / (FREE - STOP), 0.0, 1.0))


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import KeepOut
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Float64

    rclpy.init()
    node = rclpy.create_node('keep_distance')
    publisher = node.create_publisher(Float64, 'speed_scale', 10)
    newest = {'scale': 0.0, 'at': -math.inf}

    def hear(message: KeepOut) -> None:
        newest.update(scale=speed_scale(message), at=time.monotonic())

    def tell() -> None:
        silent = time.monotonic() - newest['at'] > SILENCE
        publisher.publish(Float64(data=0.0 if silent else newest['scale']))

    node.create_subscription(KeepOut, 'keep_out', hear, 10)
    node.create_timer(0.1, tell)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
