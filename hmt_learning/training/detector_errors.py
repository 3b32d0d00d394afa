"""Simulated errors of detected keypoints in windows of images.

Errors of single landmarks are in `image/keypoint_schemes.yaml`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_ros.experts.lifter import EXCHANGES, LANDMARKS, TIMES
from hmt_ros.inference.arrays import Array

Floats = NDArray[np.float32]

# Masks of landmarks.
BELOW_KNEE = np.array([name.endswith(('knee', 'ankle', 'heel', 'toe')) for name in LANDMARKS])
BELOW_HIP = BELOW_KNEE | np.array([name.endswith('hip') for name in LANDMARKS])


@dataclass(frozen=True)
class DetectorErrors:
    """Parameters of the joint errors of a detector's keypoints.

    `sigma`, `lasting` and `exchanged` are close to the values that `benchmarks keypoint_noise`
    measures on rendered clips; the others are chosen by hand.

    Attributes:
        sigma: Standard deviation of a confident keypoint, m at the person.
        spread: Standard deviation of log `sigma` over windows.
        white, lasting, constant: Shares of the error variance that are independent between images,
            correlated over `time`, and constant.
        time: Correlation time of the `lasting` errors, s.
        hidden, always_hidden: Shares of landmarks that are uncertain for some time, and always.
        hidden_time: Mean half-duration of the uncertainty, s.
        hidden_factor: Maximum factor on the errors of an uncertain landmark.
        heavy: Share of landmarks with large errors in spite of a high confidence.
        unconfident: Share of detectors without confidences.
        missing: Share of landmarks, of single keypoints and of images that are missing.
        cut: Shares of windows without landmarks from the knees down, and from the hips down.
        beyond: Increase of the error of a landmark beyond the border, per tangent of the angle.
        doubted: Decrease of its confidence, per tangent; half of the detectors omit it.
        exchanged: Shares of windows in which nothing, all, arms or legs have swapped sides.
        exchange_time: Mean half-duration of a swap, s; half of the swaps last the whole window.
    """

    sigma: float = 0.016
    spread: float = 0.35
    white: float = 0.08
    lasting: float = 0.64
    constant: float = 0.25
    time: float = 0.2
    hidden: float = 0.12
    always_hidden: float = 0.04
    hidden_time: float = 0.5
    hidden_factor: float = 6.0
    heavy: float = 0.03
    unconfident: float = 0.2
    missing: float = 0.02
    cut: tuple[float, float] = (0.08, 0.08)
    beyond: float = 12.0
    doubted: float = 3.2
    exchanged: tuple[float, ...] = (0.91, 0.04, 0.025, 0.025)
    exchange_time: float = 0.3


def with_errors(
    rays: Floats,
    confidences: Floats,
    distance: Floats,
    times: Array,
    rng: np.random.Generator,
    amount: float = 1.0,
    border: Array | None = None,
) -> tuple[Floats, Floats]:
    """Rays (N, S, L, 2) and confidences (N, S, L) with the errors of a detector.

    Args:
        rays, confidences: exact values; a confidence of 0 marks a landmark missing in the scheme,
            or a missing image.
        distance: (N,) distance of the person, m.
        times: (N, S) times of the images, s; in the same order in all windows.
        amount: factor on the standard deviations.
        border: (N,) y / z of the lower image border; None if nothing is cut off.
    """
    e = DetectorErrors()
    n, s, count = confidences.shape
    f32 = np.float32

    def normal(*shape: int) -> Floats:
        return rng.standard_normal(shape, dtype=f32)

    sigma = e.sigma * amount * np.exp(e.spread * rng.normal(size=n)) / distance
    noise = np.sqrt(f32(e.white)) * normal(n, s, count, 2)
    noise += np.sqrt(f32(e.constant)) * normal(n, 1, count, 2)
    lasting, order = normal(n, s, count, 2), np.argsort(TIMES)
    for before, after in pairwise(order.tolist()):
        gap = np.abs(times[:, after] - times[:, before])
        rho = np.exp(-gap / e.time).astype(f32)[:, None, None]
        lasting[:, after] *= np.sqrt(1 - rho * rho)
        lasting[:, after] += rho * lasting[:, before]
    noise += np.sqrt(f32(e.lasting)) * lasting
    # Landmarks hidden for some time or always, and those with large errors at high confidence.
    reach = float(TIMES.max()) + 0.1
    middle, half = (
        rng.uniform(-reach, reach, (n, 1, count)),
        rng.exponential(e.hidden_time, (n, 1, count)),
    )
    hidden = (rng.random((n, 1, count)) < e.hidden) & (np.abs(times[:, :, None] - middle) < half)
    hidden |= rng.random((n, 1, count)) < e.always_hidden
    factor = np.where(hidden, rng.uniform(1.5, e.hidden_factor, (n, 1, count)), 1.0)
    heavy = rng.random((n, 1, count)) < e.heavy
    factor = factor * np.where(heavy, rng.uniform(2.0, 5.0, (n, 1, count)), 1.0)
    beyond = np.zeros_like(factor)
    if border is not None:
        beyond = np.maximum(rays[..., 1] - border[:, None, None], 0.0)
        factor = factor * np.minimum(1.0 + e.beyond * beyond, e.hidden_factor)
    rays = rays + (sigma[:, None, None] * factor)[..., None].astype(f32) * noise
    doubt = 0.75 - 0.12 * factor + 0.15 * normal(n, 1, count) + 0.05 * normal(n, s, count)
    sure = np.where(
        hidden, np.clip(doubt, 0.02, 0.9), np.clip(1 - 0.04 * np.abs(normal(n, s, count)), 0.5, 1)
    )
    sure = np.where(rng.random((n, 1, 1)) < e.unconfident, 1.0, sure)
    sure = np.where(beyond > 0, np.clip(sure - e.doubted * beyond, 0.02, 1.0), sure)
    sure *= ~((beyond > 0) & (rng.random((n, 1, 1)) < 0.5))
    confidences = confidences * sure.astype(f32)
    confidences *= ~(hidden & (rng.random((n, 1, 1)) < 0.3))
    for shape in ((n, 1, count), (n, s, count), (n, s, 1)):
        confidences *= rng.random(shape) > e.missing
    for share, below in zip(e.cut, (BELOW_KNEE, BELOW_HIP), strict=True):
        confidences[rng.random(n) < share] *= ~below
    _exchange(rays, confidences, times, rng, e)
    return rays.astype(f32), confidences


def _exchange(
    rays: Floats, confidences: Floats, times: Array, rng: np.random.Generator, e: DetectorErrors
) -> None:
    """Swaps left and right in some windows, for a run of images or for all of them."""
    n = len(rays)
    kind = rng.choice(4, n, p=e.exchanged)
    whole, reach = rng.random(n) < 0.5, float(TIMES.max()) + 0.2
    middle, half = rng.uniform(-reach, reach, n), rng.exponential(e.exchange_time, n)
    for number, order in enumerate(EXCHANGES[1:], 1):
        rows = np.flatnonzero(kind == number)
        on = whole[rows, None] | (np.abs(times[rows] - middle[rows, None]) < half[rows, None])
        rays[rows] = np.where(on[..., None, None], rays[rows][:, :, order], rays[rows])
        confidences[rows] = np.where(
            on[..., None], confidences[rows][:, :, order], confidences[rows]
        )
