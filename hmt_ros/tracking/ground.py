"""The ground: vertical direction, and height of the camera above the floor.

    h(p) = n . p + d        height of a point p over the floor, camera frame, m

with n the unit vector against gravity and d the height of the camera. Unknown values are estimated
from the track; see `GroundEstimator`. Given values are measurements: other measurements refine them
within their error,

    p(n | v) ~ N(n; n_0, s_0^2) [p N(v; n, s^2) + 1 - p],     v the vertical of the lines

and can contradict them, but never replace them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import Body
from hmt_ros.body.camera import AXES, IMAGE_UP, Camera, roll, shortest_turn
from hmt_ros.body.camera_pose import USUAL_DISTANCE
from hmt_ros.body.foot_contact import contacts, first_contacts
from hmt_ros.body.ground_terms import (
    FEET,
    FloorPlane,
    GroundSettings,
    GroundTerm,
    masses,
    sole_points,
    soles,
)
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import turned
from hmt_ros.core import elementary
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.vertical_lines import Vertical, seen_vertical
from hmt_ros.inference.arrays import Array, Image
from hmt_ros.inference.error_model import seconds
from hmt_ros.inference.linear_algebra import inverse, length, product, symmetric_eigen, unit
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.settings import (
    AXIS_SIGMA,
    GIVEN_UP_SIGMA,
    HEAD_DOWN_IMAGES,
    LEVEL_QUANTILE,
    LEVEL_SIGMA,
    LEVEL_TIME,
    LOOK_NATS,
    MEASURED_SIGMA,
    RIGHT_VERTICAL_NATS,
    TURN_NOISE,
    UP_DRIFT,
    UP_SIGMA,
    UPRIGHT_CONCENTRATION,
    VERTICAL_TIME,
)


@dataclass(frozen=True)
class KnownGround:
    """Prior knowledge of gravity and floor.

    Attributes:
        up: (3,) unit vector against gravity in the camera frame; None: unknown.
        camera_height: height of the camera above the floor, m; None: unknown.
        up_sigma: standard deviation of the direction about each horizontal axis, rad.

    Raises:
        ValueError: the direction is not a unit vector, or the height is not positive.
    """

    up: Array | None = None
    camera_height: float | None = None
    up_sigma: float = GIVEN_UP_SIGMA

    def __post_init__(self) -> None:
        if self.up is not None:
            object.__setattr__(self, 'up', unit_vector(self.up))
        height = self.camera_height
        if height is not None and not (np.isfinite(height) and height > 0):
            raise ValueError(f'camera_height must be a positive number of metres, saw {height}')


class Ground(FloorPlane):
    """The present estimate of the ground, at the camera or at the person.

    An unknown height has an infinite standard deviation.
    """

    @property
    def plane(self) -> Array | None:
        """Plane (4,) of the floor: n and d with n . x + d = 0; None if the height is unknown."""
        return None if self.height is None else np.append(self.up, self.height)


def unit_vector(up: ArrayLike) -> Array:
    """Checks a direction (3,) and normalises it.

    Raises:
        ValueError: the shape is not (3,), or the length differs from 1 by 1 % or more.
    """
    vector = np.array(up, dtype=np.float64)
    size = length(vector) if vector.shape == IMAGE_UP.shape else np.nan
    if not abs(size - 1.0) < 0.01:
        raise ValueError(
            f'up must be a unit vector (3,) against gravity in the camera frame, saw {vector}'
        )
    result: Array = vector / size
    result.setflags(write=False)
    return result


class GroundEstimator:
    """Estimates the ground from prior knowledge, from the scene and from a track.

    The floor is a high quantile of the distance of the lowest sole below the camera in the last
    seconds, because people mostly stand on the floor, and sometimes jump. The lines of the scene
    (`image.vertical_lines`) refine a given vertical. Without a given vertical, the lines determine
    it. Without lines, the vertical is estimated near the vertical of the image, from the axis of a
    standing body (from the middle of the feet to the centre of mass). Errors of the axis persist,
    so all images within `VERTICAL_TIME` count as one, and the standard deviation is at least
    `AXIS_SIGMA`.

    A given vertical is doubted if the lines show a different vertical, or if the person would be
    lying down. It may have the wrong sign, as from an accelerometer at rest. The opposite vertical
    is used if keypoints show the person head down: from the first image if the given vertical
    points down in the image, otherwise after `HEAD_DOWN_IMAGES` images. If the vertical from the
    lines jumps, the next evaluation of lines must confirm the change.

    Args:
        known: prior knowledge of gravity and floor; None: unknown.

    Attributes:
        known: prior knowledge of gravity and floor.
        estimate: the present estimate at the camera.
        still: whether the motion of the camera is known, so that objects at rest have known places
            in the camera frame; set by the tracker.
        plane: gravity and floor at the person, for the energy of poses.
        turning: whether the last two given directions of gravity show that the camera turned.
    """

    def __init__(self, known: KnownGround | None = None) -> None:
        self.known = known or KnownGround()
        self.still = False
        self.turning = False
        self.forget_scene()

    def forget_scene(self) -> None:
        """Forgets the estimates from images and from a track."""
        self._seen: Vertical | None = None
        self._missed = False
        self._looked: int | None = None
        self._by_lines = self._by_person = self._by_keypoints = 0.0
        self.reset()

    def reset(self) -> None:
        """Forgets the estimates from a track."""
        self._mean, self._covariance = IMAGE_UP, AXES * UP_SIGMA**2
        self._levels: deque[tuple[float, float]] = deque()
        self._time = 0.0
        self._distance = USUAL_DISTANCE
        self._refresh_estimate()

    def carry(self, motion: CameraMotion) -> None:
        """Transforms known and estimated values to the camera frame of the next image.

        A camera height that would become zero or negative is dropped.
        """
        up = motion.directions(self.estimate.up)
        rise = -_dot(up, motion.translation)
        known = self.known
        height = None if known.camera_height is None else known.camera_height + rise
        self.known = replace(
            known,
            up=None if known.up is None else motion.directions(known.up),
            camera_height=height if height is not None and height > 0 else None,
        )
        self._mean = motion.directions(self._mean)
        turned = product(motion.rotation, self._covariance)
        self._covariance = product(turned, motion.rotation.T)
        if self._seen is not None:
            self._seen = replace(self._seen, up=motion.directions(self._seen.up))
        self._levels = deque((time, level + rise) for time, level in self._levels)
        self._refresh_estimate()

    def set_gravity(
        self, up: ArrayLike, camera_height: float | None = None, up_sigma: float = GIVEN_UP_SIGMA
    ) -> None:
        """Sets a new direction (3,) against gravity, camera frame, and height of the camera, m."""
        before, vector = self.known.up, unit_vector(up)
        self.turning = before is not None and length(vector - before) > TURN_NOISE
        height = self.known.camera_height if camera_height is None else camera_height
        self.known = KnownGround(vector, height, up_sigma)
        self._refresh_estimate()

    @property
    def reversed(self) -> bool:
        """Whether the given vertical is used with the opposite sign; see `GroundEstimator`."""
        up = self.known.up
        if up is None:
            return False
        return self._by_keypoints < (0.0 if _dot(up, IMAGE_UP) < 0.0 else -HEAD_DOWN_IMAGES)

    @property
    def contradicted(self) -> bool:
        """Whether lines of the scene, or the person, contradict the given vertical."""
        given = self._given
        if given is None:
            return False
        # The given gravity is more often wrong if the camera is mounted sideways or upside down.
        upright = _dot(given, IMAGE_UP) >= 0.5
        prior = -RIGHT_VERTICAL_NATS if upright else 1.0 - RIGHT_VERTICAL_NATS
        return prior + self._by_lines + self._by_person > 0.0

    @property
    def level(self) -> Array:
        """Rotation (3, 3) from an upright camera's axes to the camera's; identity if unknown."""
        return roll(self.estimate.up) if self.vertical_known else AXES.copy()

    @property
    def _given(self) -> Array | None:
        """The given vertical (3,) with its sign corrected; None if not given."""
        up = self.known.up
        return up if up is None or not self.reversed else -up

    def update_sign_by_keypoints(self, keypoints: Keypoints) -> None:
        """Updates the sign of the given vertical from the trunk of a detected person."""
        if self.known.up is not None:
            trunk = keypoints.trunk
            size = max(length(trunk), np.finfo(np.float64).eps)
            self._by_keypoints += _dot(trunk, self.known.up[:2]) / size
            self._refresh_estimate()

    def update_by_lines(self, image: Image, camera: Camera, stamp: int) -> None:
        """Updates the vertical from lines of an image, once per `VERTICAL_TIME`; stamp in ns."""
        if self._looked is not None and 0 <= seconds(stamp - self._looked) < VERTICAL_TIME:
            return
        self._looked, given = stamp, self._given
        found = seen_vertical(image, camera, AXES if given is None else roll(given))
        if found is None:
            return
        again, before = self._missed, self._seen
        self._missed = before is not None and found.agreement(before.up, before.sigma) < 1.0
        if not self._missed or again:
            self._seen, self._missed = found, False
        if given is not None:
            said = -float(elementary.log(found.agreement(given, self.known.up_sigma)))
            said = min(max(said, -LOOK_NATS), LOOK_NATS)
            self._by_lines = min(max(self._by_lines + said, -LOOK_NATS), 2.0 * LOOK_NATS)
        self._refresh_estimate()

    @property
    def vertical_known(self) -> bool:
        """Whether the vertical is given, or known from lines of the scene."""
        return self.known.up is not None or self._seen is not None

    @property
    def vertical(self) -> Array | None:
        """Vertical (3,), given or from lines of the scene, camera frame; None if unknown."""
        return self.estimate.up if self.vertical_known else None

    def gravity(self, weight: float) -> Gravity | None:
        """Gravity for the start of a track, with its energy's weight; None if unknown or unused."""
        return Gravity(self.plane, weight) if self.vertical_known and weight > 0 else None

    def with_contacts(self, body: Body, modes: Modes, before: Modes | None, dt: float) -> Modes:
        """Modes with their sole points and contact probabilities (`body.foot_contact`).

        Args:
            body: body of the modes.
            modes: modes of an image.
            before: modes of the previous image (the ancestors), in the same camera frame; None: the
                track starts.
            dt: time since the previous image, s.
        """
        points = sole_points(body, modes.poses)
        if before is None:
            return replace(modes, soles=points, contacts=first_contacts(self.plane, points))
        rested, stood = before.contacts[modes.ancestors], before.soles[modes.ancestors]
        found = contacts(self.plane, points, rested, stood, dt, still=self.still)
        return replace(modes, soles=points, contacts=found)

    def by_foot(self, modes: Modes) -> dict[str, float]:
        """Probabilities that 'left_foot' and 'right_foot' of the heaviest mode rest on the floor.

        Empty if there are no modes, if the ground terms are off, if the body has no feet, or while
        the motion of the camera is unknown.
        """
        if not (self.still and modes.contacts.size):
            return {}
        best = modes.contacts[0].reshape(len(FEET), -1).max(1)
        return {f'{side}_foot': float(p) for side, p in zip(FEET, best, strict=True)}

    def update(self, body: Body, modes: Modes, resting: float, dt: float) -> None:
        """Updates vertical and floor from the modes of an image.

        Args:
            body: body of the modes.
            modes: modes of the posterior.
            resting: probability that both feet rest on the floor.
            dt: time since the previous image, s.
        """
        feet, mass = soles(body), masses(body.skeleton)
        if not len(feet):
            return
        frames = forward(body.skeleton, modes.poses)
        weights = elementary.exp(modes.log_weights)
        weights = weights / weights.sum()
        points = frames.places(feet.segments, feet.local)
        self._time += dt
        place = product(weights, frames.segments[1][:, 0])
        if mass.known:
            axis = product(weights, unit(mass.centre_of_mass(frames) - points.mean(1)))
            if self._given is not None:
                self._by_person = self._log_odds_by_person(_dot(axis, self._given), dt)
            elif self._seen is None:
                self._follow_axis(axis, place, resting, dt)
                self._refresh_estimate()
        up = self.estimate.up
        level = float(-_dot(weights, product(points, up).min(1)))
        self._levels.append((self._time, level))
        while self._levels[0][0] < self._time - LEVEL_TIME:
            self._levels.popleft()
        self._distance = length(place - up * _dot(up, place))
        self._refresh_estimate()

    def _log_odds_by_person(self, cosine: float, dt: float) -> float:
        """Log odds against the given vertical, nats, from its cosine with the axis of a person."""
        stands = 2.0 * UPRIGHT_CONCENTRATION
        stands *= elementary.exp(UPRIGHT_CONCENTRATION * (cosine - 1.0))
        most = RIGHT_VERTICAL_NATS * (1.0 + max(-cosine, 0.0))
        said = -elementary.log(stands + elementary.exp(-most)) * min(dt / VERTICAL_TIME, 1.0)
        return min(max(self._by_person + float(said), -RIGHT_VERTICAL_NATS), most)

    def _follow_axis(self, axis: Array, place: Array, resting: float, dt: float) -> None:
        """Updates the vertical from the mean axis (3,) of a body at a position (3,)."""
        size = length(axis)
        if dt <= 0 or resting <= 0 or size == 0:
            return
        ray = unit(place)
        along = np.outer(ray, ray)
        error = AXIS_SIGMA**2 * (AXES - along) + (2.0 * AXIS_SIGMA) ** 2 * along
        error = error * max(VERTICAL_TIME / (resting * dt), 1.0)
        covariance = self._covariance + UP_DRIFT**2 * dt * AXES
        gain = product(covariance, inverse(covariance + error))
        mean = unit(self._mean + product(gain, axis / size - self._mean))
        most = 2.0 * UP_SIGMA
        cosine = _dot(mean, IMAGE_UP)
        if elementary.arccos(min(max(cosine, -1.0), 1.0)) > most:
            aside = unit(mean - IMAGE_UP * cosine)
            mean = elementary.cos(most) * IMAGE_UP + elementary.sin(most) * aside
        self._mean = mean
        values, vectors = symmetric_eigen(covariance - product(gain, covariance))
        values = np.clip(values, AXIS_SIGMA**2, UP_SIGMA**2)
        self._covariance = product(vectors * values, vectors.T)

    def _refresh_estimate(self) -> None:
        known, seen, given = self.known, self._seen, self._given
        if given is not None and seen is not None:
            seen = seen.refined(given, known.up_sigma)
        elif given is not None:
            seen = Vertical(given, known.up_sigma)
        if seen is None:
            seen = Vertical(self._mean, float(np.sqrt(self._covariance.trace() / len(self._mean))))
        tracked = Ground(seen.up, seen.sigma, *self._tracked_level(), measured=False)
        self.estimate = self.plane = tracked
        if known.camera_height is not None:
            self.estimate = Ground(seen.up, seen.sigma, known.camera_height, 2.0 * MEASURED_SIGMA)
            # An error of the vertical shifts the floor at the person.
            sigma = math.hypot(self.estimate.height_sigma, seen.sigma * self._distance)
            if sigma <= tracked.height_sigma:
                self.plane = replace(self.estimate, height_sigma=sigma)

    def _tracked_level(self) -> tuple[float | None, float]:
        """Height of the camera above the recent soles, m, and its standard deviation, m."""
        if not self._levels:
            return None, np.inf
        levels = sorted(level for _, level in self._levels)
        low, high = _quantile(levels, 0.5), _quantile(levels, LEVEL_QUANTILE)
        few = 2.0 * LEVEL_SIGMA / math.sqrt(len(levels))
        return high, math.sqrt(LEVEL_SIGMA**2 + (high - low) ** 2 + few**2)


def _dot(a: Array, b: Array) -> float:
    """Scalar product of vectors (N,)."""
    return float(product(a, b))


def _quantile(rising: list[float], share: float) -> float:
    """Quantile of sorted values, interpolated."""
    place = share * (len(rising) - 1)
    first = int(place)
    low, high = rising[first], rising[min(first + 1, len(rising) - 1)]
    return low + (place - first) * (high - low)


@dataclass(frozen=True, eq=False)
class Gravity:
    """Gravity at the start of a track, when the floor is unknown.

    Attributes:
        plane: direction against gravity and its standard deviation; the height is not used.
        weight: positive factor on the energy of the lean.
    """

    plane: FloorPlane
    weight: float = 1.0

    def term(self, body: Body) -> GroundTerm:
        """Energy of the lean of a body's pelvis and trunk."""
        plane = replace(self.plane, height=None, height_sigma=np.inf)
        return GroundTerm(body, GroundSettings(self.weight, 0.0), plane)

    def turned(self, body: Body, poses: Array) -> Array:
        """Rotates poses (N, d), upright in the image, by the shortest rotation to the vertical."""
        turn = shortest_turn(product(body.level, IMAGE_UP), self.plane.up)
        return np.clip(turned(body, poses, body, turn), body.lower, body.upper)
