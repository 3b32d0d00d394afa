"""Occluding contours in vectorised numpy, the reference of `hmt_ros.image.surface`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.flesh import Flesh, Superquadric, surfaces
from hmt_ros.body.kinematics import Frames

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Contour:
    """Occluding contour of the flesh for N poses: two points on each of R rings.

    Attributes:
        segments, parts: (2R,) segment and part of each point.
        local: (2R, 3, N) positions in the frames of the segments, m.
        points: (2R, 3, N) camera frame, m.
        normals: (2R, 3, N) outward unit normals, camera frame; perpendicular to the ray.
        exists: (2R, N) false if a ring is seen from its end and has no contour.
        turns: (2R, 2, N) cosine and sine of the angle around the ring.
    """

    segments: Index
    parts: Index
    local: Array
    points: Array
    normals: Array
    exists: NDArray[np.bool_]
    turns: Array


def occluding_contour(flesh: Flesh, frames: Frames) -> Contour:
    """Points of the flesh whose normal is perpendicular to the ray from the camera.

    The roots of g(w) of `hmt_ros.body.flesh`: with one slope and e2 = 1 in closed form, elsewhere
    by bracketing.
    """
    ring, segments = flesh.rings, np.array([p.segment for p in flesh.parts])[flesh.ring_parts]
    columns, origins = frames.columns[segments], frames.origins[segments]
    # The camera's centre seen from the segment: -R^T o; u = centre + R^T o.
    u = np.einsum('rixn,rxn->rin', columns, origins) + ring.centre[:, :, None]
    uz = u[:, 2]
    radius, slope, lean = ring.radius[:, :, None], ring.slope[:, :, None], ring.lean[:, :, None]
    big_u = (u[:, :2] - uz[:, None] * lean) / radius
    length = np.hypot(big_u[:, 0], big_u[:, 1])
    cosine = -(1.0 - uz * slope[:, 0]) / np.maximum(length, 1e-12)
    exists = np.abs(cosine) < 1.0
    middle = np.arctan2(big_u[:, 1], big_u[:, 0])
    half = np.arccos(np.clip(cosine, -1.0, 1.0))
    w = np.stack([middle + half, middle - half])  # (2, R, N)
    general = np.flatnonzero((ring.exponent != 1.0) | (ring.slope[:, 0] != ring.slope[:, 1]))
    if len(general):
        w[:, general], exists[general] = _bracketed_angles(
            big_u[general], uz[general], ring.slope[general], ring.exponent[general]
        )
    cos, sin = np.cos(w), np.sin(w)
    e2 = ring.exponent[:, None]
    powers = np.stack([cos, sin], axis=2)  # (2, R, 2, N)
    outline, lateral = powers, powers
    if len(general) and np.any(ring.exponent != 1.0):
        outline = signed_power(powers, e2[..., None])
        lateral = signed_power(powers, 2 - e2[..., None])
    count = 2 * len(segments)
    local: Array = np.empty((2, len(segments), 3, frames.count))
    local[:, :, :2] = ring.centre[:, :2, None] + radius * outline
    local[:, :, 2] = ring.centre[:, 2, None]
    normal: Array = np.empty_like(local)
    normal[:, :, :2] = lateral / radius
    normal[:, :, 2] = -(slope * powers * powers).sum(2) - (normal[:, :, :2] * lean).sum(2)
    normal /= np.sqrt(np.einsum('krin,krin->krn', normal, normal))[:, :, None]
    local = local.reshape(count, 3, -1)
    both = np.tile(segments, 2)
    points = frames.points(both, local)
    normal = normal.reshape(count, 3, -1)
    c = frames.columns[both]
    normals = c[:, 0] * normal[:, 0, None] + c[:, 1] * normal[:, 1, None]
    normals += c[:, 2] * normal[:, 2, None]
    return Contour(
        both, np.tile(flesh.ring_parts, 2), local, points, normals, np.tile(exists, (2, 1)),
        powers.reshape(count, 2, -1),
    )  # fmt: skip


def _bracketed_angles(
    big_u: Array, uz: Array, slopes: Array, exponent: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """The two roots w (2, R, N) of g and their existence, by bracketing and false position."""
    power = (2.0 - exponent)[:, None]
    kx, ky = slopes.T[:, :, None]

    def g(w: Array) -> Array:
        cos, sin = np.cos(w), np.sin(w)
        result: Array = 1 + big_u[:, 0] * signed_power(cos, power)
        result += big_u[:, 1] * signed_power(sin, power)
        slope: Array = kx * cos * cos + ky * sin * sin
        return result - uz * slope

    steps = 48
    grid = np.linspace(-np.pi, np.pi, steps + 1)
    values = np.stack([g(np.full_like(uz, w)) for w in grid])
    positive = values > 0
    roots = []
    exists = np.ones(uz.shape, dtype=bool)
    for change in (~positive[:-1] & positive[1:], positive[:-1] & ~positive[1:]):
        exists &= change.any(0)
        k = change.argmax(0)
        low, high = grid[k], grid[k + 1]
        at_low = np.take_along_axis(values, k[None], 0)[0]
        at_high = np.take_along_axis(values, k[None] + 1, 0)[0]
        for _ in range(16):  # Illinois: false position that never stalls at one end
            w = low - at_low * (high - low) / np.where(at_high != at_low, at_high - at_low, 1.0)
            at = g(w)
            same = (at > 0) == (at_high > 0)
            low, at_low = np.where(same, low, high), np.where(same, 0.5 * at_low, at_high)
            high, at_high = w, at
        roots.append(w)
    return np.stack(roots), exists


def surface(part: Superquadric, s: Array, w: Array) -> tuple[Array, Array]:
    """Points and normals (R, 3) of a part at heights s (R,) and angles w (R,)."""
    points, normals = surfaces(Flesh((part,)).table, s, w)
    return points[0, :-2], normals[0, :-2]


def signed_power(x: Array, exponent: Array | float) -> Array:
    """sgn(x) |x|^exponent."""
    return np.asarray(np.sign(x) * np.abs(x) ** exponent)
