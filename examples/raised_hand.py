#!/usr/bin/env python3
"""Publishes the probability that a hand is above the head.

    python examples/raised_hand.py --ros-args -r __ns:=/humans/bodies/p1

It subscribes to `pose_mixture` (hmt_msgs/PoseMixture) and publishes `raised_hand`
(std_msgs/Float64), the probability over all modes; NaN if nobody is tracked. Up is assumed to be
against the y axis of the image; if the camera is not level, rotate the positions first
(`docs/consumers.md`, frames).
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

HANDS, HEAD = ('left_wrist', 'right_wrist'), 'head'


def raised_hand(mixture: Any) -> float:
    """The probability, from an hmt_msgs/PoseMixture."""
    if mixture.state != mixture.STATE_TRACKING:
        return math.nan
    head = mixture.joint_names.index(HEAD)
    total = 0.0
    for mode in mixture.components:
        none = 1.0
        for name in HANDS:
            hand = mixture.joint_names.index(name)
            # y points down: a hand above the head has the smaller y.
            above = mode.joint_positions[head].y - mode.joint_positions[hand].y
            variance = sum(mode.joint_covariances_relative[9 * x + 4] for x in (head, hand))
            none *= 0.5 * math.erfc(above / math.sqrt(2.0 * max(variance, 1e-12)))
        total += mode.weight * (1.0 - none)
    return total


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import PoseMixture
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Float64

    rclpy.init()
    node = rclpy.create_node('raised_hand')
    publisher = node.create_publisher(Float64, 'raised_hand', 10)
    node.create_subscription(
        PoseMixture,
        'pose_mixture',
        lambda mixture: publisher.publish(Float64(data=raised_hand(mixture))),
        10,
    )
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
