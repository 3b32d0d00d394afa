#!/usr/bin/env python3
"""Converts the keep-out space into a grid of obstacles, for example for a costmap of Nav2.

    python examples/keep_out_grid.py --ros-args -r __ns:=/humans/bodies/p1

It subscribes to `keep_out` (hmt_msgs/KeepOut) and publishes `keep_out_grid`
(nav_msgs/OccupancyGrid), 10 times a second: cells of `AREA` are 100 below a capsule at any height,
and 0 elsewhere. All are 100 if the person was not seen for `UNSEEN` s or no messages arrive. The
filter needs `fixed_frame` and `publish_in_fixed_frame`, because a grid needs a frame with z up.

In a rolling costmap of Nav2, name the layer before others: it overwrites what came before.

    plugins: [person, obstacle_layer, inflation_layer]
    person: {plugin: "nav2_costmap_2d::StaticLayer", map_topic: /humans/bodies/p1/keep_out_grid}
"""

from __future__ import annotations

import array
import contextlib
import math
import time
from typing import Any

import numpy as np

FRAME = 'odom'
AREA, CELL = (-5.0, -5.0, 5.0, 5.0), 0.05  # minimum x and y, maximum x and y, and side of a cell, m
UNSEEN, SILENCE = 0.5, 0.5  # maximum age of an observation, and of a message, s
FREE, OCCUPIED = 0, 100


def shadows(starts: Any, ends: Any, radii: Any) -> Any:
    """Mask of the cells below capsules (rows along y, columns along x)."""
    x, y = (np.arange(AREA[k] + CELL / 2, AREA[k + 2], CELL) for k in (0, 1))
    under = np.zeros((len(y), len(x)), bool)
    corner = CELL * math.sqrt(0.5)
    a, b = (np.reshape(given, (-1, 3))[:, :2] for given in (starts, ends))
    for start, end, radius in zip(a, b, np.asarray(radii) + corner, strict=True):
        low, high = np.minimum(start, end) - radius, np.maximum(start, end) + radius
        columns, rows = (
            slice(*np.searchsorted(at, (low[k], high[k]))) for k, at in enumerate((x, y))
        )
        cells = np.stack(np.meshgrid(x[columns], y[rows]), -1) - start
        along = end - start
        share = np.clip(cells @ along / max(along @ along, 1e-12), 0.0, 1.0)
        under[rows, columns] |= np.linalg.norm(cells - share[..., None] * along, axis=-1) <= radius
    return under


def occupancy(message: Any) -> Any:
    """Values of all cells (rows, columns), from an hmt_msgs/KeepOut."""
    known = message.state in (message.STATE_TRACKING, message.STATE_LOST)
    nobody = message.state == message.STATE_NOBODY
    under = shadows(message.starts, message.ends, message.radii)
    stop = message.header.frame_id != FRAME or not (nobody or (known and message.unseen < UNSEEN))
    return np.where(under | stop, OCCUPIED, FREE).astype(np.int8)


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import KeepOut
    from nav_msgs.msg import OccupancyGrid
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import DurabilityPolicy, QoSProfile

    rclpy.init()
    node = rclpy.create_node('keep_out_grid')
    # Latched, as a costmap expects of a map.
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(OccupancyGrid, 'keep_out_grid', latched)
    everything = np.full_like(shadows([], [], []), OCCUPIED, np.int8)
    newest = {'cells': everything, 'at': -math.inf}

    def hear(message: KeepOut) -> None:
        if (seen := message.header.frame_id) != FRAME:
            wanted = f'keep_out is in frame {seen!r}, wanted {FRAME!r}: set publish_in_fixed_frame'
            node.get_logger().error(f'{wanted} of the filter, or FRAME of this program', once=True)
        newest.update(cells=occupancy(message), at=time.monotonic())

    def tell() -> None:
        silent = time.monotonic() - newest['at'] > SILENCE
        cells = everything if silent else newest['cells']
        grid = OccupancyGrid(data=array.array('b', cells.tobytes()))
        grid.header.frame_id, grid.header.stamp = FRAME, node.get_clock().now().to_msg()
        grid.info.resolution = CELL
        grid.info.height, grid.info.width = cells.shape
        grid.info.origin.position.x, grid.info.origin.position.y = AREA[:2]
        publisher.publish(grid)

    node.create_subscription(KeepOut, 'keep_out', hear, 10)
    node.create_timer(0.1, tell)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
