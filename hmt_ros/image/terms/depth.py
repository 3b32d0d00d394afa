"""Depth: visible points of the model's surface lie where a depth image sees a surface.

    E(x) = w / V sum_i rho((D(u_i(x)) - z_i(x)) / sigma_i)
    sigma_i^2 = sigma^2 + (growth D^2)^2 + (noise_i / cos a_i)^2

over the V visible points i of the flesh: on every ring the two on either side of the part that
faces the camera. D is the depth image, registered to the colour image, z the depth of the point,
both along the axis of the camera, m. The error of a sensor that triangulates grows with the square
of the distance [Khoshelham and Elberink, Sensors 2012]; that of the flesh, `noise`, is along the
normal of the surface, which the ray meets at the angle a. In the gradient the points stay on the
skin, and their deviations are constant.

Where nothing was measured a point has the cost of an error of one deviation, whatever the pose. A
surface before a point, or far behind it, costs at most the maximum of the kernel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import (
    mark_visibility,
    project,
    ring_deviation,
    ring_point,
    ring_seen,
)
from hmt_ros.image.terms.image_term import (
    ImageTerm,
    ImageWindow,
    Request,
    TermSettings,
    Weighting,
)
from hmt_ros.image.terms.residuals import add_residual, geman_mcclure, weight_of_each

# Depths that sensors measure, m; nearer and further ones are no evidence.
NEAREST, FURTHEST = 0.2, 20.0
# Angle around a ring between the part that faces the camera and a point, rad.
ASIDE = np.pi / 4
COS, SIN = float(np.cos(ASIDE)), float(np.sin(ASIDE))
# Points whose normal is further from the ray than this are not compared, as a cosine.
LEAST_COSINE = 0.3
# Neighbouring depths that differ by more, as a share of the depth, lie on two surfaces.
JUMP = 0.03


class DepthInputs(NamedTuple):
    """Weighting, and the depths, m, 0 where nothing was measured."""

    term: Weighting
    depths: ImageMap


NO_DEPTHS = ImageMap(np.zeros((1, 2, 2), np.float32))


def usable_depths(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """A depth image (H, W), m, with 0 for holes and for depths out of range."""
    with np.errstate(invalid='ignore'):
        good = (depth >= NEAREST) & (depth <= FURTHEST)
    result: NDArray[np.float32] = np.where(good, depth, 0.0).astype(np.float32)
    return result


def depth_map(window: ImageWindow) -> ImageMap | None:
    """The depths of a window; None: nothing was measured there."""
    if window.depth is None:
        return None
    depths = usable_depths(window.depth)
    return window.as_map(depths[None]) if depths.any() else None


def _inputs(term: Weighting, evidence: Any, _request: Request) -> DepthInputs:
    return DepthInputs(term, evidence or NO_DEPTHS)


@njit(cache=True, nogil=True, inline='always')
def sample_depth(values, left, top, u, v):  # type: ignore[no-untyped-def]
    """Depth at a pixel and its derivatives by u and v; 0 where nothing was measured.

    Between four depths of one surface it is bilinear, else that of the nearest pixel.
    """
    h, w = values.shape[1], values.shape[2]
    x, y = u - left, v - top
    if not (0.0 <= x <= w - 1.0 and 0.0 <= y <= h - 1.0):
        return 0.0, 0.0, 0.0
    i, j = min(int(y), h - 2), min(int(x), w - 2)
    dv, du = y - i, x - j
    a, b = float(values[0, i, j]), float(values[0, i, j + 1])
    p, q = float(values[0, i + 1, j]), float(values[0, i + 1, j + 1])
    least, most = min(min(a, b), min(p, q)), max(max(a, b), max(p, q))
    if least <= 0.0 or most - least > JUMP * least:
        near, far = (a, b) if dv < 0.5 else (p, q)
        return (near if du < 0.5 else far), 0.0, 0.0
    upper = a + (b - a) * du
    lower = p + (q - p) * du
    return upper + (lower - upper) * dv, (b - a) * (1.0 - dv) + (q - p) * dv, lower - upper


@njit(cache=True, nogil=True)
def trace_front(flesh, wanted, lens, columns, origins, parts, points, cosines, noise, valid):  # type: ignore[no-untyped-def]
    """Fills in the points of one pose that face the camera, two on each of R rings.

    Args:
        flesh, wanted, lens, columns, origins: as for `surface.trace_contour`.
        parts, points: (2R,), (2R, 3) their parts, and places in the camera frame, m.
        cosines: (2R,) of the angle between normal and ray.
        noise: (2R,) deviation of the flesh of people along the normal, m.
        valid: (2R,) whether the point faces the camera.
    """
    part_segments, ring_parts, ring_centres = (
        flesh.part_segments,
        flesh.ring_parts,
        flesh.ring_centres,
    )
    ring_radii, ring_slopes, ring_leans = flesh.ring_radii, flesh.ring_slopes, flesh.ring_leans
    ring_exponents, ring_noise = flesh.ring_exponents, flesh.ring_noise
    rings = len(ring_parts)
    for r in range(rings):
        part = ring_parts[r]
        s = part_segments[part]
        ux, uy, uz = ring_seen(r, s, ring_centres, columns, origins)
        e = ring_exponents[r]
        fx = -(ux - uz * ring_leans[r, 0]) / ring_radii[r, 0]
        fy = -(uy - uz * ring_leans[r, 1]) / ring_radii[r, 1]
        size = max(np.sqrt(fx * fx + fy * fy), 1e-12)
        fx, fy = fx / size, fy / size
        for side in range(2):
            i = r + side * rings
            parts[i] = part
            valid[i] = False
            if not wanted[part]:
                continue
            turn = -SIN if side == 0 else SIN
            c, sn = fx * COS - fy * turn, fy * COS + fx * turn
            p0, p1, p2, n0, n1, n2 = ring_point(
                r, s, c, sn, ring_centres, ring_radii, ring_slopes, ring_leans, e, columns, origins
            )
            points[i, 0], points[i, 1], points[i, 2] = p0, p1, p2
            sizes = np.sqrt((n0 * n0 + n1 * n1 + n2 * n2) * (p0 * p0 + p1 * p1 + p2 * p2))
            cosines[i] = -(n0 * p0 + n1 * p1 + n2 * p2) / max(sizes, 1e-12)
            noise[i] = ring_deviation(r, c, sn, ring_noise)
            valid[i] = cosines[i] > LEAST_COSINE


@njit(cache=True, nogil=True)
def add_depth(view, inputs, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
    """Depths of visible points against those that were measured; see `ImageTerm.kernel`."""
    term, depths, flesh = inputs.term, inputs.depths, view.flesh
    values, left, top, owners = depths.values, depths.left, depths.top, view.owners
    count = 2 * len(flesh.ring_parts)
    parts, points = np.empty(count, np.int64), np.empty((count, 3))
    cosines, noise = np.empty(count), np.empty(count)
    valid, covered = np.empty(count, np.bool_), np.empty(count, np.bool_)
    hidden = np.empty(count, np.bool_)
    trace_front(
        flesh,
        view.traced,
        view.lens,
        view.columns,
        view.origins,
        parts,
        points,
        cosines,
        noise,
        valid,
    )
    pixel, j = np.empty((count, 2)), np.empty((count, 2, 3))
    for i in range(count):
        if valid[i]:
            valid[i] = project(view.lens, points[i, 0], points[i, 1], points[i, 2], i, pixel, j)
    mark_visibility(
        flesh, view.occluders, view.columns, view.origins, parts, points, valid, covered, hidden
    )
    each = weight_of_each(term.weight, view.contour_points * 5 // 10, valid, hidden)
    unknown, _, _ = geman_mcclure(1.0, term.scale, each)
    energy = 0.0
    for i in range(count):
        if not valid[i] or hidden[i]:
            continue
        value, gu, gv = sample_depth(values, left, top, pixel[i, 0], pixel[i, 1])
        if value <= 0.0:
            energy += unknown
            continue
        own, flesh_error = term.growth * value * value, noise[i] / cosines[i]
        inverse = 1.0 / np.sqrt(term.sigma * term.sigma + own * own + flesh_error * flesh_error)
        error = (value - points[i, 2]) * inverse
        rho, pull, curvature = geman_mcclure(error, term.scale, each)
        energy += rho
        add_residual(
            wrenches,
            stiffnesses,
            owners[parts[i]],
            points[i, 0],
            points[i, 1],
            points[i, 2],
            (gu * j[i, 0, 0] + gv * j[i, 1, 0]) * inverse,
            (gu * j[i, 0, 1] + gv * j[i, 1, 1]) * inverse,
            (gu * j[i, 0, 2] + gv * j[i, 1, 2] - 1.0) * inverse,
            pull,
            curvature,
        )
    return energy


DEPTH = ImageTerm(
    'depth',
    'Depth of visible points of the surface from the depth image.',
    TermSettings(30.0, 0.01, 4.0, growth=0.002),
    depth_map,
    _inputs,
    add_depth,
)
