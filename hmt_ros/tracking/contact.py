"""Which feet rest: a hidden Markov chain for every point of the soles of every mode.

    prior      P = c_(t-1) (1 - leave) + (1 - c_(t-1)) enter
    evidence   L = log N(m; 0, S_rest) - log N(m; 0, S_free) + log N(h; 0, s_h) - log(1 / LIFT)
    posterior  logit c_t = logit P + L

c is the probability that the point rests, m how far it moved since the image before and h its
height over the floor. Along the line of sight the image shows little of m, so there both deviations
are wider and nearer to each other. A point that rests has an anchor, the place where it rests,
which follows the pose slowly and so keeps what the first images of the contact have said.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.ground_terms import BALANCE_SIGMA, FloorPlane, Stance
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mass import masses
from hmt_ros.body.soles import FEET, soles
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.hypotheses import Modes

# Rates at which a resting foot leaves the floor, and another comes to rest: those of walking, 1/s.
LEAVES, ENTERS = 1.5, 2.5
# Probability that a foot of the first image rests.
AT_FIRST = 0.5
# How far a point moves from image to image, across and along the line of sight, m, while it rests.
REST_ACROSS, REST_ALONG = 0.012, 0.03
# Speed of a foot that does not rest, m/s: deviation of each component.
FREE_SPEED = 1.0
# Deviation of the height of a resting point from that of the floor, besides that of the floor
# itself; height up to which a free foot is lifted, m.
REST_HIGH, LIFT = 0.04, 0.25
# Evidence of one image is limited: errors of a pose last.
LEAST_EVIDENCE, MOST_EVIDENCE = -3.0, 1.0
# Largest probability of contact of a point in an energy: with it a wrong contact of a foot, which
# has two points, costs 2.4 nats.
MOST = 0.7
# Share of an anchor that remains from image to image, and its largest distance from the foot, m.
ANCHOR_KEPT, ANCHOR_REACH = 0.8, 0.06
# Time in which the centre of mass may be away from the support at its speed, s.
STEP_TIME = 0.15
# Height of the lowest sole over the floor from which on balance counts less, and how fast, m.
LOW, LOW_SIGMA = 0.06, 0.06


class FootContacts:
    """Contact of the feet of the modes of a filter, and what their successors refer to.

    Attributes:
        stance: of the modes; None: before the first image, or for a body without feet.
    """

    def __init__(self) -> None:
        self.stance: Stance | None = None
        self._probabilities = np.zeros((0, 0))
        self._points = np.zeros((0, 0, 3))

    def begin(self, body: Body, plane: FloorPlane, modes: Modes) -> None:
        """Starts with modes that come from nothing before."""
        points = self._sole_points(body, modes.poses)
        if points.shape[1] == 0:
            return
        evidence = self._height_evidence(plane, points)
        self._probabilities = _posterior(np.full(points.shape[:2], AT_FIRST), evidence)
        self._take(body, plane, modes, points, points, ENTERS / 30.0, LEAVES / 30.0)

    def update(
        self, body: Body, plane: FloorPlane, modes: Modes, dt: float, *, still: bool
    ) -> None:
        """Takes in the modes of the next image.

        Args:
            body: of the modes.
            plane: gravity and floor.
            modes: whose ancestors are the modes that were taken in before.
            dt: time since then, s.
            still: whether the motion of the camera is known; if not, no point is taken to rest.
        """
        if self.stance is None:
            return self.begin(body, plane, modes)
        points = self._sole_points(body, modes.poses)
        before = self.stance[modes.ancestors]
        enter, leave = (1.0 - np.exp(-rate * dt) for rate in (ENTERS, LEAVES))
        if not still:
            self._probabilities = np.zeros(points.shape[:2])
            return self._take(body, plane, modes, points, points, 0.0, leave)
        c = self._probabilities[modes.ancestors]
        evidence = self._height_evidence(plane, points)
        evidence += self._motion_evidence(points, modes.ancestors, dt)
        evidence = np.clip(evidence, LEAST_EVIDENCE, MOST_EVIDENCE)
        c = _posterior(c * (1.0 - leave) + (1.0 - c) * enter, evidence)
        self._probabilities = c
        offset = before.anchors - points
        near = np.linalg.norm(offset, axis=2) < ANCHOR_REACH
        kept = ANCHOR_KEPT * np.where(near & (c > 0.5), c, 0.0)
        return self._take(
            body, plane, modes, points, points + kept[..., None] * offset, enter, leave
        )

    def carry(self, motion: CameraMotion) -> None:
        """Takes the places of the soles into the camera frame of the next image."""
        if self.stance is None:
            return
        self._points = motion.points(self._points)
        self.stance = replace(self.stance, anchors=motion.points(self.stance.anchors))

    def by_foot(self) -> dict[str, float]:
        """Probability that the heaviest mode rests on a foot, by 'left_foot' and 'right_foot'."""
        if self.stance is None:
            return {}
        best = self._probabilities[0].reshape(len(FEET), -1).max(1)
        return {f'{side}_foot': float(p) for side, p in zip(FEET, best, strict=True)}

    def _take(
        self,
        body: Body,
        plane: FloorPlane,
        modes: Modes,
        points: Array,
        anchors: Array,
        enter: float,
        leave: float,
    ) -> None:
        c = self._probabilities
        expected = np.minimum(c * (1.0 - leave) + (1.0 - c) * enter, MOST)
        speed = _horizontal_speed(body, plane.up, modes)
        grounded = np.ones(len(points))
        if plane.height is not None:
            high = (points @ plane.up + plane.height).min(1) - LOW
            sigma = np.hypot(LOW_SIGMA, plane.height_sigma)
            grounded = np.exp(-0.5 * (np.maximum(high, 0.0) / sigma) ** 2)
        allowed = np.hypot(BALANCE_SIGMA, STEP_TIME * speed)
        self._points = points
        self.stance = Stance(expected, anchors, allowed, grounded)

    def _sole_points(self, body: Body, poses: Array) -> Array:
        """Points (K, P, 3) of the soles."""
        feet = soles(body)
        points = forward(body.skeleton, poses).points(feet.segments, feet.local)
        return np.ascontiguousarray(points.transpose(2, 0, 1))

    def _height_evidence(self, plane: FloorPlane, points: Array) -> Array:
        """Log odds (K, P) of rest by the heights of points (K, P, 3)."""
        if plane.height is None:
            return np.zeros(points.shape[:2])
        sigma = np.hypot(REST_HIGH, plane.height_sigma)
        z = (points @ plane.up + plane.height) / sigma
        result: Array = -0.5 * z * z - np.log(np.sqrt(2.0 * np.pi) * sigma / LIFT)
        return result

    def _motion_evidence(self, points: Array, ancestors: Index, dt: float) -> Array:
        """Log odds (K, P) of rest by how far points (K, P, 3) moved."""
        ray = points / np.linalg.norm(points, axis=2, keepdims=True)
        moved = points - self._points[ancestors]
        along = (moved * ray).sum(2)
        across = (moved * moved).sum(2) - along**2
        result = np.zeros(points.shape[:2])
        for square, axes, rest in ((across, 2, REST_ACROSS), (along**2, 1, REST_ALONG)):
            free = np.hypot(rest, FREE_SPEED * dt)
            result += axes * np.log(free / rest) - 0.5 * square * (rest**-2 - free**-2)
        return result


def _posterior(prior: Array, evidence: Array) -> Array:
    prior = np.clip(prior, 1e-3, 1.0 - 1e-3)
    result: Array = 1.0 / (1.0 + (1.0 - prior) / prior * np.exp(-evidence))
    return result


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
