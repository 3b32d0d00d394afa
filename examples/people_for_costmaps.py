#!/usr/bin/env python3
"""Publishes position and velocity of the person for social costmaps.

    python examples/people_for_costmaps.py --ros-args -r __ns:=/humans/bodies/p1

It subscribes to `pose_mixture` (hmt_msgs/PoseMixture) and publishes `people` (people_msgs/People):
the pelvis of the heaviest mode, its velocity, and the probability of all modes within `THERE` of
it; nobody if the track is lost. No distribution of ROS 2 has people_msgs; build it from source.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

THERE = 0.5  # maximum distance of a mode that counts for the position, m


def people(mixture: Any, message: Any, person: Any) -> Any:
    """The people_msgs/People of an hmt_msgs/PoseMixture, given the classes People and Person."""
    result = message(header=mixture.header)
    if mixture.state == mixture.STATE_TRACKING:
        pelvis, best = mixture.joint_names.index('pelvis'), mixture.components[0]
        places = [(x.weight, x.joint_positions[pelvis]) for x in mixture.components]
        here = places[0][1]
        p = (here.x, here.y, here.z)
        near = (weight for weight, q in places if math.dist(p, (q.x, q.y, q.z)) <= THERE)
        one = person(name=f'person_{mixture.track_id}', position=here, reliability=sum(near))
        if len(best.joint_velocities):
            velocity = best.joint_velocities[3 * pelvis : 3 * pelvis + 3]
            one.velocity.x, one.velocity.y, one.velocity.z = map(float, velocity)
        result.people.append(one)
    return result


def main() -> None:
    """Runs until it is interrupted."""
    import rclpy
    from hmt_msgs.msg import PoseMixture
    from people_msgs.msg import People, Person
    from rclpy.executors import ExternalShutdownException

    rclpy.init()
    node = rclpy.create_node('people_for_costmaps')
    publisher = node.create_publisher(People, 'people', 10)

    def tell(mixture: PoseMixture) -> None:
        publisher.publish(people(mixture, People, Person))

    node.create_subscription(PoseMixture, 'pose_mixture', tell, 10)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
