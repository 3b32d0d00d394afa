"""What a depth camera measures of a scene: noise, steps of disparity, holes.

Sensors with structured light or two cameras measure disparity, so that their error grows with the
square of the depth [Khoshelham and Elberink, Sensors 2012]:

    d = 1 / z + noise_d,   noise_d of standard deviation NOISE, smooth over a few pixels

Nothing is measured in the shadow that something near casts between the two eyes of the sensor, at
edges, where its window sees two depths, on patches that reflect badly, and out of range.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.camera import Camera

Depth = NDArray[np.floating]

# Standard deviation and step of the disparity, divided by focal length and distance of the eyes:
# what the square of a depth is multiplied with, 1/m.
NOISE, STEP = 0.0020, 0.0008
# Standard deviation of the blur that makes neighbouring errors alike, px.
BLUR = 1.5
# Distance of the eyes of the sensor, m.
BASELINE = 0.05
# Depths that differ by more than this share over a pixel are an edge.
EDGE = 0.05
# Share of the pixels that reflect badly, and standard deviation of the patches' blur, px.
DARK, PATCH = 0.02, 5.0
NEAREST, FURTHEST = 0.3, 10.0
# Stream of random numbers of a seed; a scene uses others.
OF_DEPTH = 6


def sensed_depth(depth: Depth, camera: Camera, seed: int, frame: int = 0) -> NDArray[np.uint16]:
    """What a sensor measures of true depths.

    Args:
        depth: (H, W) along the axis of the camera, m; inf where nothing is.
        camera: whose images the depths are registered to.
        seed: of all random numbers.
        frame: number of the image, which seeds its noise.

    Returns:
        (H, W) mm, 0 where nothing was measured.
    """
    rng = np.random.default_rng([seed, OF_DEPTH, frame])
    z = np.asarray(depth, dtype=np.float64)
    inverse = 1.0 / z
    smooth = _smooth_noise(rng, z.shape, BLUR)
    measured = np.round((inverse + NOISE * smooth) / STEP) * STEP
    bad = (z < NEAREST) | (z > FURTHEST) | (measured <= 0.0)
    bad |= _shadowed(inverse, camera.fx * BASELINE)
    least, most = cv2.erode(z, np.ones((3, 3))), cv2.dilate(np.where(bad, 0.0, z), np.ones((3, 3)))
    with np.errstate(invalid='ignore'):
        bad |= (most - least > EDGE * least) & (rng.random(z.shape) < 0.5)
    patches = _smooth_noise(rng, z.shape, PATCH)
    bad |= patches > np.quantile(patches, 1.0 - DARK)
    with np.errstate(divide='ignore'):
        mm = np.where(bad, 0.0, np.rint(1000.0 / np.where(bad, 1.0, measured)))
    return np.clip(mm, 0, 65535).astype(np.uint16)


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], blur: float) -> Depth:
    """Noise of unit variance that is alike over some pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), blur)
    result: Depth = noise / noise.std()
    return result


def _shadowed(inverse: Depth, shift: float) -> NDArray[np.bool_]:
    """What the second eye, to the right, does not see, by disparities in units of 1/m."""
    column = np.arange(inverse.shape[1])
    # A pixel is seen there at this column; what is nearer, further right, covers it.
    there = column - shift * inverse
    nearest_right = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
    result: NDArray[np.bool_] = there > nearest_right + 0.5
    return result
