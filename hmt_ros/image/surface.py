"""The occluding contour in the image, and its visible points; compiled, pose by pose.

The counterpart of the contours of `body.flesh` and `Camera.project` for the inner loop of the
likelihood: on every ring of the flesh the two points whose normal is perpendicular to the ray.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import NEAR, Camera
from hmt_ros.inference.arrays import Array, Mask
from msg_tools.files.plain_yaml import load_plain_yaml

Ints = NDArray[np.int64]

# Parts are grown by this factor when they hide others: superquadrics are fatter than ellipsoids.
COVER = 1.04
# A point this much behind the front of another part, relative to its distance, is hidden by it.
HIDDEN = 0.004
LENSES = {'plumb_bob': 0, 'rational_polynomial': 0, 'equidistant': 1}


class Lens(NamedTuple):
    """A camera as compiled code reads it: fx fy cx cy, model (-1: no distortion), coefficients."""

    focal: tuple[float, float]
    centre: tuple[float, float]
    model: int
    coefficients: tuple[float, float, float, float, float, float, float, float]


class FleshTable(NamedTuple):
    """The flesh as the compiled code reads it: parts (B,), and rings (R,) of `flesh.Rings`.

    `ring_noise` (R, 2) tells how far contours of people lie from the model's, standard deviations
    at the sides and in front and behind, m; see `contour_noise.yaml`.
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
        parts: (P,).
        points: (P, 3) camera frame, m.
        pixels: (P, 2).
        projections: (P, 2, 3) derivative of the pixels with respect to the points.
        normals: (P, 2) out of the body, in the image.
        valid: (P,) the point exists and lies before the camera.
        covered: (P,) another part lies on the same ray, before or behind.
        hidden: (P,) another part lies on the same ray, before.
        noise: (P,) how far contours of people lie from the point, a standard deviation, m.
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


def lens_of(camera: Camera) -> Lens:
    """The compiled code's view of a camera."""
    k1, k2, k3, k4, k5, k6, k7, k8, *_ = (*map(float, camera.distortion), *(0.0,) * 8)
    model = LENSES[camera.distortion_model] if camera.distortion else -1
    return Lens(
        (float(camera.fx), float(camera.fy)),
        (float(camera.cx), float(camera.cy)),
        model,
        (k1, k2, k3, k4, k5, k6, k7, k8),
    )


def flesh_table_of(body: Body) -> FleshTable:
    """The compiled code's view of a body's flesh."""
    flesh, ring = body.flesh, body.flesh.rings
    return FleshTable(
        np.array([p.segment for p in flesh.parts], dtype=np.int64),
        np.array([p.centre for p in flesh.parts]).reshape(-1, 3),
        np.array([p.radii for p in flesh.parts]).reshape(-1, 3),
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
    """Standard deviations (B, 2) of contours at the sides of each part, and in front, m."""
    known, names = _noise_of_parts(), body.skeleton.segment_names
    plain = [names[p.segment].removeprefix('left_').removeprefix('right_') for p in body.shapes]
    return np.array([known.get(name, known['other']) for name in plain]).reshape(-1, 2)


@njit(cache=True, nogil=True)
def empty_contour(rings):  # type: ignore[no-untyped-def]
    """Room for the contour of one pose."""
    count = 2 * rings
    return Contour(
        np.empty(count, np.int64),
        np.empty((count, 3)),
        np.empty((count, 2)),
        np.empty((count, 2, 3)),
        np.empty((count, 2)),
        np.empty(count, np.bool_),
        np.empty(count, np.bool_),
        np.empty(count, np.bool_),
        np.empty(count),
    )


@njit(cache=True, nogil=True, inline='always')
def project(lens, x, y, z, i, pixels, projections):  # type: ignore[no-untyped-def]
    """Pixel and derivative of a point into row i of (P, 2), (P, 2, 3); False behind the camera."""
    if not z > NEAR:
        return False
    a, b = x / z, y / z
    if lens.model < 0:
        da, db, ea, eb = 1.0, 0.0, 0.0, 1.0
        u, v = a, b
    elif lens.model == 0:
        k = lens.coefficients
        p1, p2 = k[2], k[3]
        s = a * a + b * b
        top = 1.0 + s * (k[0] + s * (k[1] + s * k[4]))
        bottom = 1.0 + s * (k[5] + s * (k[6] + s * k[7]))
        radial = top / bottom
        slope = (
            k[0]
            + s * (2.0 * k[1] + s * 3.0 * k[4])
            - radial * (k[5] + s * (2.0 * k[6] + s * 3.0 * k[7]))
        ) / bottom
        u = a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a)
        v = b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b
        da = radial + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        db = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        ea = db
        eb = radial + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
    else:
        k = lens.coefficients
        r = np.sqrt(a * a + b * b)
        theta = np.arctan(r)
        t = theta * theta
        bent = theta * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))
        d_bent = 1.0 + t * (3.0 * k[0] + t * (5.0 * k[1] + t * (7.0 * k[2] + t * 9.0 * k[3])))
        scale = bent / r if r > 1e-8 else 1.0
        slope = (d_bent / (1.0 + r * r) - scale) / (r * r) if r > 1e-4 else 2.0 * (k[0] - 1.0 / 3.0)
        u, v = a * scale, b * scale
        da = scale + a * a * slope
        db = a * b * slope
        ea = db
        eb = scale + b * b * slope
    fx, fy = lens.focal[0] / z, lens.focal[1] / z
    pixels[i, 0] = lens.focal[0] * u + lens.centre[0]
    pixels[i, 1] = lens.focal[1] * v + lens.centre[1]
    projections[i, 0, 0] = fx * da
    projections[i, 0, 1] = fx * db
    projections[i, 0, 2] = -fx * (da * a + db * b)
    projections[i, 1, 0] = fy * ea
    projections[i, 1, 1] = fy * eb
    projections[i, 1, 2] = -fy * (ea * a + eb * b)
    return True


@njit(cache=True, nogil=True, inline='always')
def signed_power(x, exponent):  # type: ignore[no-untyped-def]
    """sgn(x) |x|^exponent."""
    return np.sign(x) * np.abs(x) ** exponent


@njit(cache=True, nogil=True, inline='always')
def ring_seen(r, s, ring_centres, columns, origins):  # type: ignore[no-untyped-def]
    """The centre of ring r of segment s relative to the camera, in the axes of the segment."""
    o0, o1, o2 = origins[s, 0], origins[s, 1], origins[s, 2]
    ux = columns[s, 0, 0] * o0 + columns[s, 0, 1] * o1 + columns[s, 0, 2] * o2
    uy = columns[s, 1, 0] * o0 + columns[s, 1, 1] * o1 + columns[s, 1, 2] * o2
    uz = columns[s, 2, 0] * o0 + columns[s, 2, 1] * o1 + columns[s, 2, 2] * o2
    return ux + ring_centres[r, 0], uy + ring_centres[r, 1], uz + ring_centres[r, 2]


@njit(cache=True, nogil=True, inline='always')
def ring_point(r, s, c, sn, ring_centres, ring_radii, ring_slopes, ring_leans, e, columns, origins):  # type: ignore[no-untyped-def]
    """A point of ring r of segment s, and the normal there, both in the camera frame.

    c and sn are cosine and sine of its angle, e is the exponent of the ring.
    """
    x0, x1, x2 = columns[s, 0, 0], columns[s, 0, 1], columns[s, 0, 2]
    y0, y1, y2 = columns[s, 1, 0], columns[s, 1, 1], columns[s, 1, 2]
    z0, z1, z2 = columns[s, 2, 0], columns[s, 2, 1], columns[s, 2, 2]
    outline_x, outline_y, lateral_x, lateral_y = c, sn, c, sn
    if e != 1.0:
        outline_x, outline_y = signed_power(c, e), signed_power(sn, e)
        lateral_x, lateral_y = signed_power(c, 2.0 - e), signed_power(sn, 2.0 - e)
    rx, ry, cz = ring_radii[r, 0], ring_radii[r, 1], ring_centres[r, 2]
    px, py = ring_centres[r, 0] + rx * outline_x, ring_centres[r, 1] + ry * outline_y
    nx, ny = lateral_x / rx, lateral_y / ry
    nz = -(ring_slopes[r, 0] * c * c + ring_slopes[r, 1] * sn * sn)
    nz = nz - (nx * ring_leans[r, 0] + ny * ring_leans[r, 1])
    return (
        origins[s, 0] + x0 * px + y0 * py + z0 * cz,
        origins[s, 1] + x1 * px + y1 * py + z1 * cz,
        origins[s, 2] + x2 * px + y2 * py + z2 * cz,
        x0 * nx + y0 * ny + z0 * nz,
        x1 * nx + y1 * ny + z1 * nz,
        x2 * nx + y2 * ny + z2 * nz,
    )


@njit(cache=True, nogil=True, inline='always')
def ring_deviation(r, c, sn, ring_noise):  # type: ignore[no-untyped-def]
    """How far contours of people lie from the point of ring r with an angle, deviation, m."""
    across, ahead = c * ring_noise[r, 0], sn * ring_noise[r, 1]
    return np.sqrt(across * across + ahead * ahead)


@njit(cache=True, nogil=True)
def trace_contour(flesh, wanted, lens, columns, origins, contour):  # type: ignore[no-untyped-def]
    """Fills the contour of one pose: points, pixels, normals.

    Args:
        flesh: the flesh.
        wanted: (B,) parts whose contour is traced; the others have no valid points.
        lens: the camera.
        columns, origins: (S, 3, 3), (S, 3) frames of the segments; columns[s, i] is axis i.
        contour: filled.
    """
    # Fields that are looked up in a loop would be counted as references there, each time.
    part_segments, ring_parts, ring_centres = (
        flesh.part_segments,
        flesh.ring_parts,
        flesh.ring_centres,
    )
    ring_radii, ring_slopes, ring_leans = flesh.ring_radii, flesh.ring_slopes, flesh.ring_leans
    ring_exponents, ring_noise = flesh.ring_exponents, flesh.ring_noise
    parts, points, pixels, projections = (
        contour.parts,
        contour.points,
        contour.pixels,
        contour.projections,
    )
    normals, valid, noise = contour.normals, contour.valid, contour.noise
    rings = len(ring_parts)
    cosines, sines = np.empty(2), np.empty(2)
    for r in range(rings):
        part = ring_parts[r]
        s = part_segments[part]
        parts[r] = part
        parts[r + rings] = part
        valid[r] = False
        valid[r + rings] = False
        if not wanted[part]:
            continue
        ux, uy, uz = ring_seen(r, s, ring_centres, columns, origins)
        kx, ky = ring_slopes[r, 0], ring_slopes[r, 1]
        e = ring_exponents[r]
        bx = (ux - uz * ring_leans[r, 0]) / ring_radii[r, 0]
        by = (uy - uz * ring_leans[r, 1]) / ring_radii[r, 1]
        if e == 1.0 and kx == ky:
            length = np.sqrt(bx * bx + by * by)
            cosine = -(1.0 - uz * kx) / max(length, 1e-12)
            if not abs(cosine) < 1.0:
                continue
            sine = np.sqrt(1.0 - cosine * cosine)
            cm, sm = bx / length, by / length
            cosines[0], sines[0] = cm * cosine - sm * sine, sm * cosine + cm * sine
            cosines[1], sines[1] = cm * cosine + sm * sine, sm * cosine - cm * sine
        elif not _bracketed_roots(bx, by, uz, kx, ky, 2.0 - e, cosines, sines):
            continue
        for side in range(2):
            c, sn, i = cosines[side], sines[side], r + side * rings
            noise[i] = ring_deviation(r, c, sn, ring_noise)
            p0, p1, p2, n0, n1, _ = ring_point(
                r, s, c, sn, ring_centres, ring_radii, ring_slopes, ring_leans, e, columns, origins
            )
            points[i, 0], points[i, 1], points[i, 2] = p0, p1, p2
            if not project(lens, p0, p1, p2, i, pixels, projections):
                continue
            nu, nv = n0 / lens.focal[0], n1 / lens.focal[1]
            size = np.sqrt(nu * nu + nv * nv)
            if not size > 0.0:
                continue
            normals[i, 0], normals[i, 1] = nu / size, nv / size
            valid[i] = True


@njit(cache=True, nogil=True)
def _bracketed_roots(bx, by, uz, kx, ky, power, cosines, sines):  # type: ignore[no-untyped-def]
    """Cosines, sines of the two roots of g(w) of `body.flesh`; False: none."""
    steps = 48
    found = np.zeros(2, np.bool_)
    before = 0.0
    for k in range(steps + 1):
        w = -np.pi + k * (2.0 * np.pi / steps)
        at = _condition(w, bx, by, uz, kx, ky, power)
        if k > 0 and (before > 0) != (at > 0):
            side = 0 if at > 0 else 1
            if not found[side]:
                low, high, at_low, at_high = w - 2.0 * np.pi / steps, w, before, at
                root = high
                for _ in range(16):  # Illinois: false position that never stalls at one end
                    if at_high == at_low:
                        break
                    root = low - at_low * (high - low) / (at_high - at_low)
                    value = _condition(root, bx, by, uz, kx, ky, power)
                    if (value > 0) == (at_high > 0):
                        at_low *= 0.5
                    else:
                        low, at_low = high, at_high
                    high, at_high = root, value
                cosines[side], sines[side] = np.cos(root), np.sin(root)
                found[side] = True
        before = at
    return found[0] and found[1]


@njit(cache=True, nogil=True, inline='always')
def _condition(w, bx, by, uz, kx, ky, power):  # type: ignore[no-untyped-def]
    c, s = np.cos(w), np.sin(w)
    turned = bx * signed_power(c, power) + by * signed_power(s, power)
    return 1.0 + turned - uz * (kx * c * c + ky * s * s)


@njit(cache=True, nogil=True)
def mark_visibility(flesh, occluders, columns, origins, parts, points, valid, covered, hidden):  # type: ignore[no-untyped-def]
    """Marks points (P, 3) with other parts on their rays, and those with parts before them.

    Every part counts as its ellipsoid |A (x - c)| = 1. On the ray t p it is entered at
    t = (m.k - sqrt((m.k)^2 - m.m (k.k - 1))) / m.m with m = A p, k = A c.

    Args:
        flesh: the flesh.
        occluders: (B,) parts that can hide.
        columns, origins: frames of the segments.
        parts: (P,) part of each point, which does not hide it.
        points: (P, 3) camera frame, m.
        valid: (P,) points that matter.
        covered, hidden: (P,) results.
    """
    part_segments, part_centres, part_radii = (
        flesh.part_segments,
        flesh.part_centres,
        flesh.part_radii,
    )
    count = len(part_segments)
    shapes = np.empty((count, 3, 3))
    centres, k = np.empty((count, 3)), np.empty((count, 3))
    reach, far, outside = np.empty(count), np.empty(count), np.empty(count)
    for b in range(count):
        s = part_segments[b]
        largest = 0.0
        for i in range(3):
            centres[b, i] = origins[s, i]
            for j in range(3):
                centres[b, i] += columns[s, j, i] * part_centres[b, j]
        outside[b] = -1.0
        for i in range(3):
            radius = COVER * part_radii[b, i]
            largest = max(largest, radius)
            k[b, i] = 0.0
            for j in range(3):
                shapes[b, i, j] = columns[s, i, j] / radius
                k[b, i] += shapes[b, i, j] * centres[b, j]
            outside[b] += k[b, i] * k[b, i]
        reach[b] = largest * largest
        far[b] = centres[b, 0] ** 2 + centres[b, 1] ** 2 + centres[b, 2] ** 2
    for n in range(len(points)):
        covered[n] = False
        hidden[n] = False
        if not valid[n]:
            continue
        p0, p1, p2 = points[n, 0], points[n, 1], points[n, 2]
        inverse = 1.0 / (p0 * p0 + p1 * p1 + p2 * p2)
        for b in range(count):
            along = centres[b, 0] * p0 + centres[b, 1] * p1 + centres[b, 2] * p2
            if far[b] - along * along * inverse > reach[b]:
                continue
            if b == parts[n] or not occluders[b]:
                continue
            mm, mk = 0.0, 0.0
            for i in range(3):
                m = shapes[b, i, 0] * p0 + shapes[b, i, 1] * p1 + shapes[b, i, 2] * p2
                mm += m * m
                mk += m * k[b, i]
            discriminant = mk * mk - mm * outside[b]
            if discriminant > 0.0:
                covered[n] = True
                if mk - np.sqrt(discriminant) < (1.0 - HIDDEN) * mm:
                    hidden[n] = True
                    break
