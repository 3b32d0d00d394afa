"""The camera: perspective projection with the distortion models of sensor_msgs/CameraInfo.

Frame: camera optical frame of REP 103, x right, y down, z forward, m. Pixels: column u, row v, the
centre of the first pixel at (0, 0).

`hmt_learning.motion.viewpoint.Viewpoint` is the pose of a static camera above a level floor. The
world frame of rendered motions has its origin on the floor, straight in front of the camera. In
this frame a person in the rest pose faces the camera: x to the person's right (left in the image),
y towards the camera, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary, find_pixels, find_rays
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product

# Number of coefficients of each model of sensor_msgs/distortion_models.
DISTORTION_MODELS = {'plumb_bob': (0, 4, 5), 'rational_polynomial': (8,), 'equidistant': (4,)}

# Axes of a camera, in rows: right, down and ahead.
AXES = np.eye(3)
AXES.setflags(write=False)
# Direction against gravity in the frame of an upright camera.
IMAGE_UP = np.array([0.0, -1.0, 0.0])
IMAGE_UP.setflags(write=False)
# Range of distances with 95 % of visible people, m, for a lens with the usual angle of view, rad.
NEAR_PERSON_DISTANCE, FAR_PERSON_DISTANCE, USUAL_ANGLE_OF_VIEW = 0.4, 15.0, np.radians(60.0)

MIN_DEPTH = 0.01  # minimum depth of a point that can be projected, m
# Minimum component of the unit vertical across the optical axis for which the roll is defined.
MIN_ROLL_COMPONENT = 0.1
# Tangents of the angles at which a distortion is checked; maximum growth of the magnification
# outwards. Calibrations of real lenses reach 2.5, at the corners of wide images.
_TURNS = 0.499 * np.pi * np.linspace(0.0, 1.0, 300) ** 2
CHECKED_RADII = elementary.sin(_TURNS) / elementary.cos(_TURNS)
MAX_RISE = 4.0
# Fraction of the way from the principal point to a corner up to which a distortion must not fold.
# It covers the ends of the longer side; real calibrations may have polynomials that fold farther
# out.
MIN_UNFOLDED_FRACTION = 0.8

# Code of each distortion model in compiled code.
LENS_CODES = {'plumb_bob': 0, 'rational_polynomial': 0, 'equidistant': 1}


class Lens(NamedTuple):
    """A camera for compiled code: fx fy cx cy, model (-1: no distortion), coefficients.

    `near` is the minimum depth of a point that can be projected, m.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    model: int
    coefficients: tuple[float, ...]
    near: float = MIN_DEPTH


@dataclass(frozen=True)
class Camera:
    """A calibrated camera.

    Attributes:
        fx, fy: focal lengths, px.
        cx, cy: principal point, px.
        width, height: size of the image, px.
        distortion: coefficients in the order of CameraInfo.d; empty without distortion.
        distortion_model: 'plumb_bob' (k1 k2 p1 p2 [k3]), 'rational_polynomial' (k1 k2 p1 p2 k3 k4
            k5 k6) or 'equidistant' (k1 k2 k3 k4).

    Raises:
        ValueError: a focal length is not positive, a value is not finite, the model is unknown or
            has a different number of coefficients, or the distortion folds well inside the image.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    distortion_model: str = 'plumb_bob'

    def __post_init__(self) -> None:
        coefficients = tuple(float(x) for x in self.distortion)
        if self.distortion_model not in DISTORTION_MODELS:
            raise ValueError(
                f'unknown distortion model {self.distortion_model!r}, wanted one of '
                f'{sorted(DISTORTION_MODELS)}'
            )
        counts = DISTORTION_MODELS[self.distortion_model]
        if coefficients and len(coefficients) not in counts:
            raise ValueError(
                f'distortion model {self.distortion_model} has {counts} coefficients, '
                f'saw {len(coefficients)}'
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *coefficients)
        if not np.isfinite(numbers).all():
            raise ValueError(f'camera parameters must be finite, saw {numbers}')
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f'focal lengths must be positive, saw {self.fx} and {self.fy}')
        if self.width < 1 or self.height < 1:
            raise ValueError(f'image size must be positive, saw {self.width} x {self.height}')
        # With all coefficients at zero, only the fisheye model bends rays.
        bends = any(coefficients) or self.distortion_model == 'equidistant'
        if bends and not coefficients:
            coefficients = (0.0,) * max(counts)
        object.__setattr__(self, 'distortion', coefficients if bends else ())
        if bends and (share := unfolded_share(self)) < MIN_UNFOLDED_FRACTION:
            raise ValueError(
                f'the distortion {self.distortion_model} of {self.distortion} folds or '
                f'overstretches the image of {self.width}x{self.height} pixels from {share:.0%} of '
                'the way to a corner on: it is of another camera or size, or the pattern was not '
                'seen far out; calibrate again, as a fisheye if the lens is wide'
            )

    def scaled(self, width: int, height: int) -> Camera:
        """Return a copy of the camera with a new image size, px.

        Raises:
            ValueError: the aspect ratio differs by more than rounding to whole pixels.
        """
        if abs(width * self.height - height * self.width) >= max(self.width, self.height):
            raise ValueError(
                f'the calibration is for images of {self.width}x{self.height} pixels, which have '
                f'another shape than {width}x{height}; calibrate with images of this size'
            )
        x, y = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=(self.cx + 0.5) * x - 0.5,
            cy=(self.cy + 0.5) * y - 0.5,
            width=width,
            height=height,
        )

    @cached_property
    def lens(self) -> Lens:
        """The camera for compiled code."""
        coefficients = (*map(float, self.distortion), *(0.0,) * 8)[:8]
        model = LENS_CODES[self.distortion_model] if self.distortion else -1
        focal, centre = (float(self.fx), float(self.fy)), (float(self.cx), float(self.cy))
        return Lens(focal, centre, model, coefficients)

    @property
    def matrix(self) -> Array:
        """Intrinsic matrix K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera frame, m.

        A point on or behind the plane z = 0.01 m has no image: its pixel is NaN.
        """
        p = np.ascontiguousarray(points, dtype=np.float64)
        result = np.empty((*p.shape[:-1], 2))
        find_pixels(self.lens, p.reshape(-1, 3), result.reshape(-1, 2))
        return result

    def project_with_derivative(
        self, points: Array, *, derivative: bool = True
    ) -> tuple[Array, Array]:
        """Pixels (2, ...) of points (3, ...), and their derivatives (2, 3, ...).

        The first axis is the coordinate, so that batches stay contiguous. Points with z below
        0.01 m give NaN.
        """
        x, y, z = points
        z = np.where(z > MIN_DEPTH, z, np.nan)
        a, b = x / z, y / z
        distorted, inner = self.distort(a, b)
        lens = ((self.fx, self.cx), (self.fy, self.cy))
        pixels = np.stack([f * x + c for (f, c), x in zip(lens, distorted, strict=True)])
        if not derivative:
            return pixels, np.empty(0)
        jacobian = np.empty((2, 3, *np.shape(z)))
        for i, (f, _) in enumerate(lens):
            jacobian[i, 0] = f * inner[i][0] / z
            jacobian[i, 1] = f * inner[i][1] / z
            jacobian[i, 2] = -(jacobian[i, 0] * a + jacobian[i, 1] * b)
        return pixels, jacobian

    def magnification(self, depth: float) -> float:
        """Pixels per metre perpendicular to the optical axis, at a depth, m."""
        return float(np.sqrt(self.fx * self.fy)) / max(depth, MIN_DEPTH)

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit rays (..., 3) through pixels (..., 2).

        Newton's method inverts the distortion. If the model has no ray through a pixel, the result
        is the ray after the last iteration.
        """
        uv = np.ascontiguousarray(pixels, dtype=np.float64)
        result = np.empty((*uv.shape[:-1], 3))
        find_rays(self.lens, uv.reshape(-1, 2), result.reshape(-1, 3))
        return result

    def distort(self, a: Array, b: Array) -> tuple[Array, tuple[tuple[Array, Array], ...]]:
        """Distorted normalised coordinates (2, ...), and derivatives with respect to a and b."""
        if not self.distortion:
            one, zero = np.ones(()), np.zeros(())
            return np.stack([a, b]), ((one, zero), (zero, one))
        if self.distortion_model == 'equidistant':
            return self._equidistant(a, b)
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *(0.0,) * (8 - len(self.distortion)))
        s = a * a + b * b  # r^2
        top = 1 + s * (k1 + s * (k2 + s * k3))
        bottom = 1 + s * (k4 + s * (k5 + s * k6))
        radial = top / bottom
        d_top = k1 + s * (2 * k2 + s * 3 * k3)
        d_bottom = k4 + s * (2 * k5 + s * 3 * k6)
        slope = (d_top - radial * d_bottom) / bottom  # d radial / d s
        value = np.stack(
            [
                a * radial + 2 * p1 * a * b + p2 * (s + 2 * a * a),
                b * radial + p1 * (s + 2 * b * b) + 2 * p2 * a * b,
            ]
        )
        mixed = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
        inner = (
            (radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a, mixed),
            (mixed, radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a),
        )
        return value, inner

    def _equidistant(self, a: Array, b: Array) -> tuple[Array, tuple[tuple[Array, Array], ...]]:
        k1, k2, k3, k4 = self.distortion
        r = np.sqrt(a * a + b * b)
        safe = np.maximum(r, 1e-12)
        theta = elementary.arctan(r)
        t = theta * theta
        bent = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
        d_bent = 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))
        scale = np.where(r > 1e-8, bent / safe, 1.0)
        # d scale / d r, divided by r
        slope = np.where(r > 1e-4, (d_bent / (1 + r * r) - scale) / (safe * safe), 2 * (k1 - 1 / 3))
        value = np.stack([a * scale, b * scale])
        mixed = a * b * slope
        return value, ((scale + a * a * slope, mixed), (mixed, scale + b * b * slope))


@lru_cache(maxsize=64)
def unfolded_share(camera: Camera) -> float:
    """Return the fraction of the way to the corners before the distortion folds, 0 to 1.

    From the principal point to each corner the distorted radius must increase with the ideal
    radius, and its slope must stay below `MAX_RISE` times the smallest slope nearer the centre.
    """
    x, y = (np.array([-0.5, n - 0.5]) for n in (camera.width, camera.height))
    a, b = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    corners = elementary.hypot(a, b).reshape(-1, 1).clip(min=1e-9)
    ideal = CHECKED_RADII * np.stack([a, b]).reshape(2, -1, 1) / corners
    with np.errstate(all='ignore'):  # a rational model has poles outside the image
        radius = elementary.hypot(*camera.distort(*ideal)[0])
        slope = np.diff(radius) / np.diff(CHECKED_RADII)
    # A fold outside the image may map back into it, but affects no pixel.
    reached = np.maximum.accumulate(radius, axis=1)[:, :-1]
    # The slope at the principal point is 1.
    steepest = MAX_RISE * np.minimum.accumulate(slope, axis=1).clip(max=1.0)
    folded = (reached < corners) & ((slope <= 0) | (slope > steepest))
    return float(np.where(folded, reached / corners, 1.0).min())


def roll(ups: ArrayLike) -> Array:
    """Return roll rotations (..., 3, 3) from an upright camera's axes to the actual camera's axes.

    Args:
        ups: (..., 3) vectors against gravity, camera frame. The roll is zero for vectors nearly
            along the optical axis (`MIN_ROLL_COMPONENT`) and for zeros.
    """
    x, y, _ = np.moveaxis(np.asarray(ups, dtype=np.float64), -1, 0)
    length = elementary.hypot(x, y)
    x, y = np.where(
        length > MIN_ROLL_COMPONENT, (x, y), np.reshape((0.0, -1.0), (2, *(1,) * np.ndim(length)))
    )
    sine, cosine = np.stack([x, -y]) / elementary.hypot(x, y)
    result = np.zeros((*np.shape(x), 3, 3))
    result[..., 0, 0] = result[..., 1, 1] = cosine
    result[..., 0, 1], result[..., 1, 0], result[..., 2, 2] = -sine, sine, 1.0
    return result


def shortest_turn(start: Array, end: Array) -> Array:
    """Return the rotation (3, 3) with the smallest angle from one unit vector to another.

    For opposite vectors this rotation is ambiguous. The result is then half a turn about the
    optical axis, as for a camera that is mounted upside down.
    """
    cosine = float(product(start, end))
    if cosine <= -1.0 + 1e-9:
        return np.diag([-1.0, -1.0, 1.0])
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    result: Array = np.eye(3) + cross + product(cross, cross) / (1.0 + cosine)
    return result


def tangent(angle: float) -> float:
    """Tangent of an angle, rad."""
    return float(elementary.sin(angle) / elementary.cos(angle))


def log_prior_of_distance(camera: Camera, distance: float) -> float:
    """Return the log prior of a person's distance, m, relative to the most likely distance, nats.

    The prior is log-normal, and wide enough to exclude no distance.
    """
    lens = camera.fx / (0.5 * camera.width / tangent(0.5 * USUAL_ANGLE_OF_VIEW))
    middle = math.sqrt(NEAR_PERSON_DISTANCE * FAR_PERSON_DISTANCE)
    # The range spans two standard deviations on either side.
    sigma = float(elementary.log(FAR_PERSON_DISTANCE / NEAR_PERSON_DISTANCE)) / 4.0
    return -0.5 * (float(elementary.log(max(distance, 1e-3) / (lens * middle))) / sigma) ** 2
