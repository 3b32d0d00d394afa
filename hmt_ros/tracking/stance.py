"""How the modes of an image stand: what the balance of their successors refers to."""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.ground_terms import BALANCE_SIGMA, FloorPlane, Stance
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mass import masses
from hmt_ros.body.soles import sole_points
from hmt_ros.inference.arrays import Array
from hmt_ros.tracking.hypotheses import Modes

# Time in which the centre of mass may be away from the support at its speed, s.
STEP_TIME = 0.15
# Height of the lowest sole over the floor from which on balance counts less, and the deviation
# beyond it, m.
LOW = 0.06


def stance_of(body: Body, plane: FloorPlane, modes: Modes) -> Stance:
    """The stance of modes over a floor."""
    allowed = np.hypot(BALANCE_SIGMA, STEP_TIME * _horizontal_speed(body, plane.up, modes))
    points, grounded = sole_points(body, modes.poses), np.ones(len(modes))
    if points.size and plane.height is not None:
        high = np.maximum((points @ plane.up + plane.height).min(1) - LOW, 0.0)
        grounded = np.exp(-0.5 * (high / np.hypot(LOW, plane.height_sigma)) ** 2)
    return Stance(allowed, grounded)


def _horizontal_speed(body: Body, up: Array, modes: Modes) -> Array:
    """Speeds (K,) of the centres of mass of modes, seen from above, m/s."""
    mass = masses(body)
    if not mass.known:
        return np.zeros(len(modes))
    step = 1e-3
    now, then = (
        mass.centre_of_mass(forward(body.skeleton, poses))
        for poses in (modes.poses, modes.poses + step * modes.velocities)
    )
    velocity = (then - now) / step
    velocity = velocity - np.outer(up, up @ velocity)
    return np.asarray(np.linalg.norm(velocity, axis=0), dtype=np.float64)
