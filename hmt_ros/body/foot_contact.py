"""Contact of the feet: a hidden Markov chain for every point of the soles of a pose.

    prior      P = s + (c_(t-1) - s) exp(-(enter + leave) dt),    s = enter / (enter + leave)
    height     log N(h; 0, s_h) - log(1 / MAX_LIFT)
    motion     log(1 - q + q N(m; 0, S_rest) / N(m; 0, S_free)),  q = c_(t-1) exp(-leave dt) / P
    posterior  logit c_t = logit P + a(dt) (height + motion)

c is the probability that the point rests, m its motion since the previous image and h its height
above the floor. With probability q, a resting point was at rest before; otherwise it has just come
to rest. Images show little motion along the line of sight, so S_rest and S_free are larger in that
direction and differ less. Pose errors are correlated in time: the evidence of an image is weighted
by its share of time a(dt) (`hmt_ros.inference.error_model`), and pose errors differ little between
images close in time.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.ground_terms import FloorPlane
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import ERRORS, share_of_time
from hmt_ros.inference.linear_algebra import product
from hmt_ros.inference.logistic import log_odds, probability_of
from hmt_ros.inference.markov_chain import MarkovChain

# Rates at which a resting foot leaves the floor and a moving foot comes to rest in walking, 1/s.
LEAVING_RATE, LANDING_RATE = 1.5, 2.5
CONTACT_CHAIN = MarkovChain.of_two(LANDING_RATE, LEAVING_RATE)
# Standard deviations of the apparent motion of a resting point between distant times, across and
# along the line of sight, m.
REST_SIGMA_ACROSS, REST_SIGMA_ALONG = 0.013, 0.033
# Standard deviation of each velocity component of a moving foot, m/s.
FREE_SPEED = 1.0
# Standard deviation of the height of a resting point above the floor, in addition to the deviation
# of the floor itself; maximum height of a free foot, m.
REST_HEIGHT_SIGMA, MAX_LIFT = 0.04, 0.25


def first_contacts(plane: FloorPlane, points: Array) -> Array:
    """Contact probabilities (K, P) of new sole points (K, P, 3), from the stationary prior."""
    return probability_of(log_odds(CONTACT_CHAIN.usual[1]) + _height_evidence(plane, points))


def contacts(
    plane: FloorPlane, points: Array, rested: Array, before: Array, dt: float, *, still: bool
) -> Array:
    """Contact probabilities (K, P) of sole points after an image.

    Args:
        plane: gravity and floor.
        points: (K, P, 3) sole points, m.
        rested: (K, P) contact probabilities after the previous image.
        before: (K, P, 3) sole points in the previous image, in the same camera frame, m.
        dt: time since the previous image, s.
        still: whether the motion of the camera is known; if not, foot motion is ignored.
    """
    prior = CONTACT_CHAIN.closed(rested, dt)
    evidence = _height_evidence(plane, points)
    if still:
        stayed = rested * elementary.exp(-LEAVING_RATE * dt) / prior
        moved = _motion_evidence(before, points, dt)
        evidence += elementary.log1p(stayed * elementary.expm1(moved))
    share = share_of_time(dt, ERRORS['image'].time)
    return probability_of(log_odds(prior) + share * evidence)


def _height_evidence(plane: FloorPlane, points: Array) -> Array:
    """Return log odds (K, P) of rest from the heights of points (K, P, 3)."""
    if plane.height is None:
        return np.zeros(points.shape[:2])
    sigma = elementary.hypot(REST_HEIGHT_SIGMA, plane.height_sigma)
    z = (product(points, plane.up) + plane.height) / sigma
    result: Array = -0.5 * z * z - elementary.log(np.sqrt(2.0 * np.pi) * sigma / MAX_LIFT)
    return result


def _motion_evidence(before: Array, points: Array, dt: float) -> Array:
    """Return log odds (K, P) of rest from the motion of points (K, P, 3) in a time dt, s."""
    ray = points / np.linalg.norm(points, axis=2, keepdims=True)
    moved = points - before
    along = (moved * ray).sum(2)
    across = (moved * moved).sum(2) - along**2
    differs = np.sqrt(-elementary.expm1(-dt / ERRORS['image'].time))
    result = np.zeros(points.shape[:2])
    for square, axes, error in ((across, 2, REST_SIGMA_ACROSS), (along**2, 1, REST_SIGMA_ALONG)):
        rest = error * differs
        free = elementary.hypot(rest, FREE_SPEED * dt)
        result += axes * elementary.log(free / rest) - 0.5 * square * (
            1.0 / (rest * rest) - 1.0 / (free * free)
        )
    return result
