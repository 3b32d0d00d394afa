#!/usr/bin/env python3
"""Stops an arm while a hand of the person may be near; stop_near_hand.cpp does the same.

    python examples/stop_near_hand.py --ros-args -r __ns:=/humans/bodies/p1

It subscribes to `pose_mixture` (hmt_msgs/PoseMixture) and publishes `stop` (std_msgs/Bool), 10
times a second: true if a hand is within `NEAR` m of the origin of its frame with a probability of
at least `DOUBT`, if the person is not tracked, or if no mixture arrived for `SILENCE` s. To measure
from an arm, set `fixed_frame` of the filter to a frame there, and `publish_in_fixed_frame`.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import Any

NEAR, DOUBT = 0.8, 0.05  # distance, m; probability for stopping
SILENCE = 0.5  # maximum age of a message, s
HAND = ('wrist', 'hand')  # ends of the names of points of a hand


def hand_near(mixture: Any, near: float = NEAR) -> float:
    """Probability that a hand is within `near`, from an hmt_msgs/PoseMixture; NaN if unknown."""
    points = [j for j, name in enumerate(mixture.joint_names) if name.endswith(HAND)]
    total = 0.0 if points and mixture.components else math.nan
    for mode in mixture.components:
        if len(mode.joint_covariances) != 9 * len(mixture.joint_names):
            return math.nan
        none = 1.0
        for j in points:
            place = mode.joint_positions[j]
            p = (place.x, place.y, place.z)
            distance = max(math.hypot(*p), 1e-9)
            # The variance of the distance is that along the line to the origin.
            c = mode.joint_covariances[9 * j : 9 * j + 9]
            variance = sum(p[a] * c[3 * a + b] * p[b] for a in range(3) for b in range(3))
            sigma = math.sqrt(max(variance, 1e-12)) / distance
            none *= 1.0 - 0.5 * math.erfc((distance - near) / (sigma * math.sqrt(2.0)))
        total += mode.weight * (1.0 - none)
    return total


def must_stop(mixture: Any) -> bool:
    """Whether to stop, from an hmt_msgs/PoseMixture; true unless it shows that no hand is near."""
    if mixture.state == mixture.STATE_NOBODY:
        return False
    return mixture.state != mixture.STATE_TRACKING or not hand_near(mixture) < DOUBT


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import PoseMixture
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Bool

    rclpy.init()
    node = rclpy.create_node('stop_near_hand')
    publisher = node.create_publisher(Bool, 'stop', 10)
    newest = {'stop': True, 'at': -math.inf}

    def hear(mixture: PoseMixture) -> None:
        newest.update(stop=must_stop(mixture), at=time.monotonic())

    def tell() -> None:
        silent = time.monotonic() - newest['at'] > SILENCE
        publisher.publish(Bool(data=silent or newest['stop']))

    node.create_subscription(PoseMixture, 'pose_mixture', hear, 10)
    node.create_timer(0.1, tell)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
