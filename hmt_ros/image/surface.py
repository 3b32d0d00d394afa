"""Occluding contour of the flesh in the image: inputs and outputs of the compiled core.

`core/surface.h` traces the contour pose by pose, with the geometry of `body.flesh` and
`Camera.project`. On every ring of the flesh, the contour has the two points whose normal is
perpendicular to the viewing ray.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.inference.arrays import Array, Mask
from msg_tools.files.plain_yaml import load_plain_yaml

Ints = NDArray[np.int64]


class FleshTable(NamedTuple):
    """The flesh as input of the compiled core: parts (B,), and rings (R,) of `flesh.Rings`.

    `ring_noise` (R, 2) is the standard deviation of people's contours from the model's contour, at
    the sides and in front or behind, m; see `contour_noise.yaml`.
    """

    part_segments: Ints
    part_centres: Array
    part_radii: Array
    ring_parts: Ints
    ring_centres: Array
    ring_radii: Array
    ring_slopes: Array
    ring_leans: Array
    ring_exponents: Array
    ring_noise: Array


class Contour(NamedTuple):
    """Contour of one pose, P = 2R points.

    Attributes:
        parts: (P,) part of the flesh of each point.
        points: (P, 3) positions in the camera frame, m.
        pixels: (P, 2) projections of the points.
        projections: (P, 2, 3) derivative of the pixels with respect to the points.
        normals: (P, 2) outward normals in the image.
        valid: (P,) whether the point exists and lies in front of the camera.
        covered: (P,) whether another part lies on the same ray, in front or behind.
        hidden: (P,) whether another part lies on the same ray, in front.
        noise: (P,) standard deviation of people's contours from the point, m.
    """

    parts: Ints
    points: Array
    pixels: Array
    projections: Array
    normals: Array
    valid: Mask
    covered: Mask
    hidden: Mask
    noise: Array


@lru_cache(maxsize=16)
def flesh_table_of(body: Body) -> FleshTable:
    """The flesh of a body as input of the compiled core."""
    flesh, ring = body.flesh, body.flesh.rings
    return FleshTable(
        np.array([p.segment for p in flesh.parts], dtype=np.int64),
        flesh.table.centres,
        flesh.table.radii,
        flesh.ring_parts.astype(np.int64),
        ring.centre,
        ring.radius,
        ring.slope,
        ring.lean,
        ring.exponent,
        _contour_noise(body)[flesh.ring_parts],
    )


@lru_cache(maxsize=1)
def _noise_of_parts() -> dict[str, list[float]]:
    file = resources.files('hmt_ros.image') / 'contour_noise.yaml'
    content: dict[str, list[float]] = load_plain_yaml(file.read_text('utf-8'))
    return content


def _contour_noise(body: Body) -> Array:
    """Standard deviations (B, 2) of people's contours at the sides and in front of parts, m."""
    known, names = _noise_of_parts(), body.skeleton.segment_names
    plain = [names[p.segment].removeprefix('left_').removeprefix('right_') for p in body.shapes]
    return np.array([known.get(name, known['other']) for name in plain]).reshape(-1, 2)


def empty_contour(rings: int) -> Contour:
    """An empty buffer for the contour of one pose."""
    count = 2 * rings
    valid, covered, hidden = np.zeros((3, count), np.bool_)
    return Contour(
        np.zeros(count, np.int64),
        np.zeros((count, 3)),
        np.zeros((count, 2)),
        np.zeros((count, 2, 3)),
        np.zeros((count, 2)),
        valid,
        covered,
        hidden,
        np.zeros(count),
    )
