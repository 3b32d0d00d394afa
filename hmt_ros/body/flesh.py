"""Flesh: superquadric ellipsoids with taper and bend around the segments (KJS 2, [Barr 1984]).

A part is a stack of rings along the axis of its segment. With s from -1 (start) to 1 (end of the
segment) and the angle w around the axis, its surface in the frame of the segment is

    x = c_x + b_x (1 - s^2) + r_x(s) C(w),   y = c_y + b_y (1 - s^2) + r_y(s) S(w),
    z = c_z - a_z s,
    r(s) = a (1 + t s) (1 - |s|^(2/e1))^(e1/2),   C = sgn(cos) |cos|^e2,   S = sgn(sin) |sin|^e2

The nine shape parameters are three radii a, two exponents e, two tapers t and two bends b.

The occluding contour is exact: on every ring it contains the points whose normal is perpendicular
to the ray from the camera. On a ring with centre u relative to the camera, in the segment's frame,
the condition normal . point = 0 reads

    g(w) = 1 + U_x C'(w) + U_y S'(w) - u_z (k_x cos^2 w + k_y sin^2 w) = 0,

where k are the slopes, C' and S' signed powers with exponent 2 - e2, and U = (u - u_z lean) /
radius. If both slopes are equal and e2 = 1, the solution has a closed form (`image.surface`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from hmt_ros.core import elementary, fill_rings, fill_surface
from hmt_ros.inference.arrays import Array, Index


@dataclass(frozen=True)
class Superquadric:
    """One part of the flesh, in the frame of its segment; lengths in m.

    Attributes:
        segment: index of the segment that carries the part.
        centre: centre of the part.
        radii: semi-axes along x, y and z.
        exponents: shape along the axis and around it; 1 is elliptic, near 0 is boxy.
        taper: relative change of the x and y radii from the middle to the end (s = 1).
        bend: shift in x and y of the middle relative to both ends, m.
    """

    segment: int
    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    exponents: tuple[float, float] = (1.0, 1.0)
    taper: tuple[float, float] = (0.0, 0.0)
    bend: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(r > 0 for r in self.radii):
            raise ValueError(f'radii of a superquadric must be positive, saw {self.radii}')
        if not all(0 < e <= 2 for e in self.exponents):
            raise ValueError(f'exponents must lie in (0, 2], saw {self.exponents}')
        if not all(abs(t) < 1 for t in self.taper):
            raise ValueError(f'tapers must lie in (-1, 1), saw {self.taper}')


@dataclass(frozen=True, eq=False)
class Rings:
    """Cross-sections (R,) of a part, in the frame of its segment.

    Attributes:
        centre: (R, 3) m.
        radius: (R, 2) along x and y, m.
        slope: (R, 2) d log(radius) / dz, 1/m.
        lean: (R, 2) d centre / dz.
        exponent: (R,) exponent e2 of the shape around the ring.
    """

    centre: Array
    radius: Array
    slope: Array
    lean: Array
    exponent: Array


class Superquadrics(NamedTuple):
    """Attributes of P parts as arrays (P, 3) and (P, 2), for the core."""

    centres: Array
    radii: Array
    exponents: Array
    tapers: Array
    bends: Array


def surfaces(parts: Superquadrics, s: Array, w: Array) -> tuple[Array, Array]:
    """Return points and outward normals (P, R + 2, 3) at R heights and angles, and at both tips.

    s: (R,) heights in (-1, 1); w: (R,) angles, rad.
    """
    points, normals = np.empty((2, len(parts.radii), len(s) + 2, 3))
    fill_surface(parts, s, elementary.cos(w), elementary.sin(w), points, normals)
    return points, normals


@dataclass(frozen=True, eq=False)
class Flesh:
    """All parts of a body, and the rings at which their contours are sampled.

    Attributes:
        parts: the superquadrics.
        ring_count: number of rings of each part.
    """

    parts: tuple[Superquadric, ...]
    ring_count: tuple[int, ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.ring_count:
            object.__setattr__(self, 'ring_count', tuple(5 for _ in self.parts))
        if len(self.ring_count) != len(self.parts):
            raise ValueError(f'{len(self.ring_count)} ring counts for {len(self.parts)} parts')

    @cached_property
    def table(self) -> Superquadrics:
        """The parts as arrays, for the core."""
        names, sizes = ('centre', 'radii', 'exponents', 'taper', 'bend'), (3, 3, 2, 2, 2)
        return Superquadrics(
            *(
                np.array([getattr(part, name) for part in self.parts], np.float64).reshape(-1, size)
                for name, size in zip(names, sizes, strict=True)
            )
        )

    @cached_property
    def rings(self) -> Rings:
        """Rings of all parts, one part after the other."""
        count = len(self.ring_parts)
        centre, (radius, slope, lean) = np.empty((count, 3)), np.empty((3, count, 2))
        heights = np.concatenate([np.zeros(0), *map(_ring_heights, self.ring_count)])
        fill_rings(self.table, self.ring_parts, heights, centre, radius, slope, lean)
        return Rings(centre, radius, slope, lean, self.table.exponents[self.ring_parts, 1])

    @cached_property
    def ring_parts(self) -> Index:
        """Index of the part that each ring belongs to."""
        return np.repeat(np.arange(len(self.parts)), self.ring_count)

    def mesh(self, stacks: int = 9, slices: int = 12) -> Mesh:
        """Triangulate all parts: `stacks` rings of `slices` points and two tips per part.

        Raises:
            ValueError: there are fewer than 2 stacks or 3 slices.
        """
        return _mesh(self, stacks, slices)

    def points_on(self, segment: int, stacks: int = 9, slices: int = 12) -> Array:
        """Return the vertices (V, 3) of the mesh on one segment, m."""
        own = Flesh(tuple(part for part in self.parts if part.segment == segment))
        return surfaces(own.table, *_grid(stacks, slices))[0].reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangulated flesh, in the frames of the segments.

    Attributes:
        vertices, normals: (V, 3) m, outward unit vectors.
        segments: (V,) index of the segment that carries each vertex.
        parts: (V,) part of each vertex.
        triangles: (F, 3) vertices, counter-clockwise seen from outside.
    """

    vertices: Array
    normals: Array
    segments: Index
    parts: Index
    triangles: Index


@lru_cache(maxsize=32)
def _triangles(stacks: int, slices: int) -> Index:
    """Triangles (F, 3) of one part."""
    if stacks < 2 or slices < 3:
        raise ValueError(f'a mesh needs 2 stacks and 3 slices at least, saw {stacks}, {slices}')
    body = []
    for i in range(stacks - 1):
        for j in range(slices):
            a, b = i * slices + j, i * slices + (j + 1) % slices
            body += [(a, a + slices, b + slices), (a, b + slices, b)]
    first, last = stacks * slices, stacks * slices + 1
    for j in range(slices):
        k = (j + 1) % slices
        body += [(first, j, k), (last, last - 2 - slices + 1 + k, last - 2 - slices + 1 + j)]
    return np.array(body, dtype=np.intp)


@lru_cache(maxsize=32)
def _ring_heights(count: int) -> Array:
    return np.asarray(elementary.sin(np.linspace(-0.42, 0.42, count) * np.pi))


@lru_cache(maxsize=32)
def _grid(stacks: int, slices: int) -> tuple[Array, Array]:
    """Heights and angles of the vertices of a part."""
    s = elementary.sin(np.linspace(-0.46, 0.46, stacks) * np.pi)
    return np.repeat(s, slices), np.tile(np.arange(slices) * (2 * np.pi / slices), stacks)


@lru_cache(maxsize=16)
def _mesh(flesh: Flesh, stacks: int, slices: int) -> Mesh:
    parts, triangles = flesh.parts, _triangles(stacks, slices)
    vertices, normals = surfaces(flesh.table, *_grid(stacks, slices))
    which, count = np.arange(len(parts)), stacks * slices + 2
    return Mesh(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.repeat(np.array([part.segment for part in parts], dtype=np.intp), count),
        np.repeat(which, count),
        (triangles + count * which[:, None, None]).reshape(-1, 3),
    )
