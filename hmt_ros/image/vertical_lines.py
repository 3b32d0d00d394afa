"""Estimates the vertical from the straight lines of a scene (Coughlan and Yuille, ICCV 1999).

Edges of walls, doors and furniture run along the vertical or along two horizontal directions at
right angles to each other. These three directions are a frame R. If e_ik is the angle in the image
between line i and direction k, projected at the place of the line,

    log p(lines | R) = sum_i log[1 - s + s / 3 sum_k r(e_ik)],   r(e) = N(e; 0, sigma) / uniform,

where a share s of all lines follows the frame and the rest is clutter. The sum over a raster of
frames, with a prior over the orientations of mounted cameras, gives the probability that such a
frame exists, and the direction of its vertical. Furniture can have any horizontal direction.
Therefore only lines that agree with the vertical refine it, with a sigma that decreases from round
to round.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from hmt_ros.body.camera import Camera
from hmt_ros.core import elementary, rate_frames, rate_lines
from hmt_ros.inference.arrays import Array, Image, Index
from hmt_ros.inference.linear_algebra import inverse, length, log_sum_exp, product, solve
from hmt_ros.inference.logistic import probability_of

# Rotation `level` of an upright camera.
UPRIGHT_FRAME = np.eye(3)
# Maximum side of an image, px (larger images are reduced), and minimum length of a line, rad.
MAX_IMAGE_SIDE, MIN_LINE_LENGTH = 800, 0.03
# Angle between the planes of two lines through the camera below which they are one line, rad.
SAME_LINE_ANGLE = np.radians(0.7)
# Share of lines that follow the frame; standard deviation of a line's end points, px.
FRAME_SHARE, END_SIGMA = 0.5, 0.5
# Prior over orientations of cameras, rad: mean pitch (positive downwards), its standard deviations
# upwards and downwards, and its limits; standard deviation of roll, and its limit.
PITCH, PITCH_SIGMA = np.radians(5.0), (np.radians(12.0), np.radians(20.0))
PITCH_LIMITS = np.radians(-40.0), np.radians(72.0)
ROLL_SIGMA, MAX_ROLL = np.radians(6.0), np.radians(32.0)
# Step of the raster of frames, and standard deviations of the angle of a line on the raster and in
# each round of the refinement, rad.
RASTER_STEP, COARSE_SIGMA = np.radians(4.0), np.radians(2.5)
REFINED_SIGMAS = tuple(np.radians([4.0, 3.0, 2.0, 1.0, 0.5, 0.5, 0.5]))
# Standard deviation of the vertical of the best frame on the raster, and minimum standard deviation
# after the refinement, because walls lean and lenses bend lines, rad.
RASTER_SIGMA, MIN_SIGMA = np.radians(4.0), np.radians(1.0)
# Probability that a detected vertical is right, and density of a wrong vertical, 1/sr.
CORRECT_PROBABILITY, UNIFORM_DENSITY = 0.9, 1.0 / (2.0 * np.pi)
# Minimum probability that a frame exists whose vertical is near the best vertical, and radius of
# this neighbourhood, rad.
MIN_FRAME_PROBABILITY, NEIGHBOURHOOD_RADIUS = 0.95, np.radians(10.0)


class Lines(NamedTuple):
    """Straight lines of an image.

    Attributes:
        normals: (N, 3) unit normals of the planes through the camera and the lines, camera frame.
        middles: (N, 3) unit rays to the middles of the lines, camera frame.
        errors: (N,) standard deviations of the directions of the lines in the image, rad.
    """

    normals: Array
    middles: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class Vertical:
    """The vertical that an image shows.

    Attributes:
        up: (3,) unit vector against gravity, camera frame.
        sigma: standard deviation of the angle of `up` about each horizontal axis, rad.
    """

    up: Array
    sigma: float

    def agreement(self, up: Array, sigma: float) -> float:
        """Density of this vertical given the vertical `up` (3,), divided by the uniform density."""
        variance = sigma**2 + self.sigma**2
        square = 2.0 - 2.0 * float(product(up, self.up))
        near = elementary.exp(-0.5 * square / variance) / (2.0 * np.pi * variance)
        return float(CORRECT_PROBABILITY * near / UNIFORM_DENSITY + 1.0 - CORRECT_PROBABILITY)

    def refined(self, up: Array, sigma: float) -> Vertical:
        """Refines another vertical `up` (3,) by this vertical, in proportion to their agreement.

        The other vertical moves by at most `sigma`, its standard deviation.
        """
        right = 1.0 - (1.0 - CORRECT_PROBABILITY) / self.agreement(up, sigma)
        share = max(right, 0.0) * sigma**2 / (sigma**2 + self.sigma**2)
        share = min(share, sigma / max(length(self.up - up), 1e-9))
        mean = (1.0 - share) * up + share * self.up
        return Vertical(mean / length(mean), sigma * float(np.sqrt(1.0 - share)))


def seen_vertical(image: Image, camera: Camera, level: Array = UPRIGHT_FRAME) -> Vertical | None:
    """The vertical from lines in an image (H, W) or (H, W, 3); None if the lines show no vertical.

    Args:
        image: image of the camera.
        camera: camera in a usual orientation after the rotation `level` is undone.
        level: (3, 3) rotation about the optical axis, from the axes of an upright camera to the
            camera's axes.
    """
    lines = straight_lines(image, camera)
    upright = lines._replace(
        normals=product(lines.normals, level), middles=product(lines.middles, level)
    )
    found = vertical_of(upright) if len(lines.normals) else None
    return None if found is None else Vertical(product(level, found.up), found.sigma)


def straight_lines(image: Image, camera: Camera) -> Lines:
    """The straight lines of an image (H, W) or (H, W, 3), longest first, without duplicates."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = min(MAX_IMAGE_SIDE / max(grey.shape), 1.0)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found: Any = cv2.createLineSegmentDetector().detect(np.ascontiguousarray(grey))[0]
    if found is None:  # no line found
        return Lines(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    # The centre of the first pixel is at 0 before and after the reduction.
    ends = (found.reshape(-1, 2, 2).astype(np.float64) + 0.5) / scale - 0.5
    rays = camera.rays(ends.reshape(-1, 2)).reshape(-1, 2, 3)
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    normals = np.cross(rays[:, 0], rays[:, 1])
    angle = np.linalg.norm(normals, axis=1)
    order = np.argsort(-angle, kind='stable')
    order = order[angle[order] > MIN_LINE_LENGTH]
    normals = normals[order] / angle[order, None]
    kept = _distinct(normals)
    middles = rays[order].sum(1)[kept]
    length = scale * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[order][kept]
    return Lines(
        normals[kept],
        middles / np.linalg.norm(middles, axis=1, keepdims=True),
        np.sqrt(2.0) * END_SIGMA / length,
    )


def vertical_of(lines: Lines) -> Vertical | None:
    """The vertical from lines; None if the lines are clutter or fit several verticals."""
    raster = _raster()
    ratios = _ratios(raster.directions, lines, COARSE_SIGMA)
    value = np.empty(raster.first.shape)
    rate_frames(ratios, raster.vertical, raster.first, raster.second, FRAME_SHARE, value)
    posterior = log_sum_exp(value) - elementary.log(len(raster.first[0])) + raster.log_prior
    evidence = float(log_sum_exp(posterior))
    found = _refined(raster.ups[posterior.argmax()], lines)
    near = product(raster.ups, found.up) > elementary.cos(NEIGHBOURHOOD_RADIUS)
    believed = probability_of(evidence) * elementary.exp(posterior[near] - evidence).sum()
    return found if believed > MIN_FRAME_PROBABILITY else None


def _refined(start: Array, lines: Lines) -> Vertical:
    """Refines a vertical `start` (3,) from the raster by the lines that agree with it."""
    up = start
    information = np.eye(3)
    for sigma in REFINED_SIGMAS:
        ratios = _ratios(up[None], lines, sigma)[0]
        agree = FRAME_SHARE / 3.0 * ratios
        weight = agree / (agree + 1.0 - FRAME_SHARE / 3.0) / (sigma**2 + lines.errors**2)
        foreshortening = 1.0 / np.sqrt(np.maximum(1.0 - product(lines.middles, up) ** 2, 1e-4))
        slopes = foreshortening[:, None] * np.cross(up, lines.normals)
        information = product((slopes * weight[:, None]).T, slopes) + np.eye(3) / RASTER_SIGMA**2
        pull = product(-(weight * foreshortening * product(lines.normals, up)), slopes)
        pull = pull + np.cross(up, start) / RASTER_SIGMA**2
        turn = solve(information, pull)
        up = up + np.cross(turn, up)
        up = up / length(up)
    across = np.cross(np.eye(3), up)
    covariance = product(product(across, inverse(information)), across.T)
    return Vertical(up, float(np.sqrt(covariance.trace() / 2.0 + MIN_SIGMA**2)))


def _ratios(directions: Array, lines: Lines, sigma: float) -> Array:
    """Ratios r (D, N) of the module's equation, for N lines and directions (D, 3)."""
    deviations = np.sqrt(sigma**2 + lines.errors**2)
    result = np.empty((len(directions), len(deviations)))
    rate_lines(directions, lines.normals, lines.middles, deviations, result)
    return result


def _distinct(normals: Array) -> Index:
    """Indices of unit normals (N, 3), of which none is close to an earlier normal."""
    same = np.abs(product(normals, normals.T)) > elementary.cos(SAME_LINE_ANGLE)
    free = np.ones(len(normals), dtype=np.bool_)
    kept = []
    for i in range(len(normals)):
        if free[i]:
            kept.append(i)
            free &= ~same[i]
    return np.array(kept, dtype=np.intp)


class _Raster(NamedTuple):
    """Candidate frames: F verticals, each with A pairs of horizontal directions.

    Attributes:
        ups: (F, 3) verticals.
        log_prior: (F,) log prior probabilities of the verticals.
        directions: (D, 3) all distinct directions of the frames, rounded; opposite directions are
            equal.
        vertical: (F,) index of each vertical in `directions`.
        first, second: (F, A) indices of the horizontal directions in `directions`.
    """

    ups: Array
    log_prior: Array
    directions: Array
    vertical: Index
    first: Index
    second: Index


@lru_cache(maxsize=1)
def _raster() -> _Raster:
    pitch, roll = (
        x.ravel()
        for x in np.meshgrid(
            np.arange(PITCH_LIMITS[0], PITCH_LIMITS[1] + 1e-9, RASTER_STEP),
            np.arange(-MAX_ROLL, MAX_ROLL + 1e-9, RASTER_STEP),
            indexing='ij',
        )
    )
    ups = np.stack(
        [
            elementary.sin(roll) * elementary.cos(pitch),
            -elementary.cos(roll) * elementary.cos(pitch),
            -elementary.sin(pitch),
        ],
        axis=1,
    )
    deviation = np.where(pitch < PITCH, *PITCH_SIGMA)
    log_prior = (
        -0.5 * ((pitch - PITCH) / deviation) ** 2
        - 0.5 * (roll / ROLL_SIGMA) ** 2
        + elementary.log(elementary.cos(pitch))
    )
    turns = np.arange(0.0, np.pi / 2.0 - 1e-9, RASTER_STEP)
    across = np.cross(ups, [0.0, 0.0, 1.0])
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    ahead = np.cross(ups, across)
    cosine, sine = elementary.cos(turns)[None, :, None], elementary.sin(turns)[None, :, None]
    first = cosine * across[:, None] + sine * ahead[:, None]
    second = cosine * ahead[:, None] - sine * across[:, None]
    # Directions are rounded to half a step.
    every = np.concatenate([ups, first.reshape(-1, 3), second.reshape(-1, 3)])
    every = every * np.where(every[:, 2:] < 0.0, -1.0, 1.0)
    cells = np.round(every / (0.5 * RASTER_STEP)).astype(np.int64)
    _, places, which = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    count, pairs = len(ups), first.shape[0] * first.shape[1]
    return _Raster(
        ups,
        log_prior - log_sum_exp(log_prior),
        every[places],
        which[:count],
        which[count : count + pairs].reshape(first.shape[:2]),
        which[count + pairs :].reshape(first.shape[:2]),
    )
