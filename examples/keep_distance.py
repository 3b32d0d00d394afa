#!/usr/bin/env python3
"""Slows a robot down near people, and stops it if their positions are unknown.

    python examples/keep_distance.py --ros-args -r __ns:=/humans/bodies/p1
    python examples/keep_distance.py --ros-args -p people:=true

It subscribes to `keep_out` (hmt_msgs/KeepOut) and publishes `speed_scale` (std_msgs/Float64), 10
times a second: 1 if the keep-out space is at least `FREE` m away from the origin of its frame, 0 if
it is nearer than `STOP`, and 0 if the person was not seen for `UNSEEN` s or no messages arrive.
With `people`, it uses everybody on the list `people` of people_node; the nearest person decides.
If the camera is not on the robot, set `fixed_frame` of the filter, and measure from your robot in
that frame.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import Any

import numpy as np

STOP, FREE = 0.5, 2.0  # distances for stopping and for full speed, m
UNSEEN, SILENCE = 0.5, 0.5  # maximum age of an observation, and of a message, s


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
    """Allowed share of the robot's usual speed, from an hmt_msgs/KeepOut."""
    if message.state == message.STATE_NOBODY:
        return 1.0
    known = message.state in (message.STATE_TRACKING, message.STATE_LOST)
    if not known or not message.unseen < UNSEEN:
        return 0.0
    distance = distance_to_capsules(message.starts, message.ends, message.radii)
    return float(np.clip((distance - STOP) / (FREE - STOP), 0.0, 1.0))


class Nearest:
    """Allowed share of the usual speed near several people, whose messages are asynchronous.

    Attributes:
        listed: names of the people present, and arrival time of the list, s.
        scales: last `speed_scale` and its arrival time, s, by person.
    """

    def __init__(self) -> None:
        self.listed: tuple[list[str], float] = [], -math.inf
        self.scales: dict[str, tuple[float, float]] = {}

    def scale(self, now: float) -> float:
        """The minimum share; 0 if the list, or the message of a person on it, is missing or old."""
        names, since = self.listed
        new = {name: x for name, (x, at) in self.scales.items() if now - at <= SILENCE}
        if now - since > SILENCE or not new.keys() >= {*names}:
            return 0.0
        return min(new.values(), default=1.0)


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import KeepOut, People2D
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Float64

    rclpy.init()
    node = rclpy.create_node('keep_distance')
    publisher = node.create_publisher(Float64, 'speed_scale', 10)
    nearest, subscribed = Nearest(), {}

    def subscribe(name: str, topic: str) -> None:
        def hear(message: KeepOut) -> None:
            nearest.scales[name] = speed_scale(message), time.monotonic()

        subscribed[name] = node.create_subscription(KeepOut, topic, hear, 10)

    def list_people(message: People2D) -> None:
        nearest.listed = list(message.ids), time.monotonic()
        for name in message.ids:
            if name not in subscribed:
                subscribe(name, f'humans/bodies/{name}/keep_out')
        for name in [*subscribed]:
            # A person who has left is published for some seconds.
            if name not in message.ids and not node.count_publishers(subscribed[name].topic_name):
                node.destroy_subscription(subscribed.pop(name))

    def publish() -> None:
        now = time.monotonic()
        if not several:
            nearest.listed = [''], now
        publisher.publish(Float64(data=nearest.scale(now)))

    several = node.declare_parameter('people', False).value
    if several:
        node.create_subscription(People2D, 'people', list_people, 10)
    else:
        subscribe('', 'keep_out')
    node.create_timer(0.1, publish)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
