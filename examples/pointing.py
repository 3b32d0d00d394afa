#!/usr/bin/env python3
"""Estimates at which object a person points, as probabilities of each object and of none.

    python examples/pointing.py --ros-args -r __ns:=/humans/bodies/p1 \
        -p objects:="[0.5, 0.2, 2.0, -0.8, 0.2, 2.5]" -p side:=right

It subscribes to `pose_mixture` (hmt_msgs/PoseMixture) and publishes `pointing`
(std_msgs/Float64MultiArray): the probabilities of the objects, given by x, y, z in the frame of the
mixture, m, and last that of none; all are NaN if nobody is tracked. A forearm that points towards
the camera looks like one that points away; if both are modes, both objects keep a probability.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

# Standard deviation of people's pointing direction, rad.
MISS = math.radians(10.0)


def pointing(mixture: Any, objects: Any, side: str = 'right') -> list[float]:
    """The probabilities (N + 1,), from an hmt_msgs/PoseMixture and object positions (N, 3)."""
    places = np.reshape(np.asarray(objects, dtype=float), (-1, 3))
    if mixture.state != mixture.STATE_TRACKING:
        return [math.nan] * (len(places) + 1)
    joints = [mixture.joint_names.index(f'{side}_{name}') for name in ('elbow', 'wrist')]
    total = np.zeros(len(places) + 1)
    for mode in mixture.components:
        elbow, wrist = (
            np.array([getattr(mode.joint_positions[i], axis) for axis in 'xyz']) for i in joints
        )
        forearm = wrist - elbow
        length = max(float(np.linalg.norm(forearm)), 1e-6)
        told = np.reshape(mode.joint_covariances_relative, (-1, 3, 3))
        # Variance of the direction, with that of both joints perpendicular to the forearm.
        across = np.eye(3) - np.outer(forearm, forearm) / length**2
        variance = MISS**2 + np.trace(across @ told[joints].sum(0)) / (2.0 * length**2)
        away = places - wrist
        cosines = away @ forearm / (np.maximum(np.linalg.norm(away, axis=1), 1e-6) * length)
        angles = np.arccos(np.clip(cosines, -1.0, 1.0))
        # Densities over directions: a Gaussian for each object, uniform for none.
        each = np.exp(-0.5 * angles**2 / variance) / (2.0 * math.pi * variance)
        shares = np.append(each, 1.0 / (4.0 * math.pi))
        total += mode.weight * shares / shares.sum()
    return [float(x) for x in total]


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import PoseMixture
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Float64MultiArray

    rclpy.init()
    node = rclpy.create_node('pointing')
    objects = node.declare_parameter('objects', [0.0, 0.0, 0.0]).value
    side = node.declare_parameter('side', 'right').value
    if len(objects) % 3 or side not in ('left', 'right'):
        raise SystemExit(
            f"pointing: wanted x, y, z of each of the objects, and side 'left' or 'right', saw "
            f'{len(objects)} numbers and {side!r}'
        )
    publisher = node.create_publisher(Float64MultiArray, 'pointing', 10)
    node.create_subscription(
        PoseMixture,
        'pose_mixture',
        lambda mixture: publisher.publish(Float64MultiArray(data=pointing(mixture, objects, side))),
        10,
    )
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
