"""Likelihood of intensities and of motion along the surface (KJS 2).

The model carries the texture of the last accepted image. The intensity term compares it with the
present image; the motion term compares where the texture has moved with the optical flow, which
says the same to first order but reaches further.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_ros.image.sampling import sample
from hmt_ros.image.surface import project
from hmt_ros.image.terms.accumulation import add_residual
from hmt_ros.image.terms.robust_kernel import geman_mcclure

# Fewer texture points than this do not make each of them count more.
FEWEST = 20
# Optical flow errs by this share of the displacement on top of the term's sigma.
FLOW_ERROR = 0.15


@njit(cache=True, nogil=True)
def add_intensity(  # type: ignore[no-untyped-def]
    intensity, texture, t, wanted, lens, columns, origins, term, wrenches, stiffnesses
):
    """Differences in colour between the texture and the image under it; returns the energy.

    Args:
        intensity: the blurred image, three channels.
        texture: of several poses.
        t: which of them this pose carries.
        wanted: (S,) segments whose texture counts.
        lens: the camera.
        columns, origins: frames of the segments.
        term: weight, sigma (grey levels) and scale (sigmas) of the term.
        wrenches, stiffnesses: sums of the segments, added to.
    """
    count = texture.counts[t]
    each = term.weight / max(count, FEWEST)
    pixel, projection = np.empty((1, 2)), np.empty((1, 2, 3))
    errors, slopes = np.empty(3), np.empty((3, 2))
    energy = 0.0
    for q in range(count):
        s = texture.segments[t, q]
        if not wanted[s]:
            continue
        p0, p1, p2 = _place(texture.local, t, q, columns, origins, s)
        if not project(lens, p0, p1, p2, 0, pixel, projection):
            continue
        square = 0.0
        for c in range(3):
            value, gu, gv = sample(intensity, c, pixel[0, 0], pixel[0, 1])
            errors[c] = (value - texture.colours[t, q, c]) / term.sigma
            slopes[c, 0], slopes[c, 1] = gu / term.sigma, gv / term.sigma
            square += errors[c] * errors[c]
        rho, _, curvature = geman_mcclure(np.sqrt(square), term.scale, each)
        energy += rho
        g0, g1, h00, h01, h11 = 0.0, 0.0, 1e-9, 0.0, 1e-9
        for c in range(3):
            g0 += errors[c] * slopes[c, 0]
            g1 += errors[c] * slopes[c, 1]
            h00 += slopes[c, 0] * slopes[c, 0]
            h01 += slopes[c, 0] * slopes[c, 1]
            h11 += slopes[c, 1] * slopes[c, 1]
        _add_pixel_energy(
            g0, g1, h00, h01, h11, curvature, s, p0, p1, p2, projection, wrenches, stiffnesses
        )
    return energy


@njit(cache=True, nogil=True)
def add_motion(  # type: ignore[no-untyped-def]
    flow, texture, t, wanted, lens, columns, origins, term, wrenches, stiffnesses
):
    """Differences between the motion of the texture and the optical flow; returns the energy.

    Args:
        flow: from the last image to this one, two channels, px.
        texture, t, wanted, lens, columns, origins, wrenches, stiffnesses: as for `add_intensity`.
        term: weight, sigma (px) and scale (sigmas) of the term.
    """
    count = texture.counts[t]
    each = term.weight / max(count, FEWEST)
    pixel, projection = np.empty((1, 2)), np.empty((1, 2, 3))
    energy = 0.0
    for q in range(count):
        s = texture.segments[t, q]
        if not wanted[s]:
            continue
        p0, p1, p2 = _place(texture.local, t, q, columns, origins, s)
        if not project(lens, p0, p1, p2, 0, pixel, projection):
            continue
        u, v = texture.pixels[t, q, 0], texture.pixels[t, q, 1]
        fu, _, _ = sample(flow, 0, u, v)
        fv, _, _ = sample(flow, 1, u, v)
        inverse = 1.0 / (term.sigma + FLOW_ERROR * np.sqrt(fu * fu + fv * fv))
        e0, e1 = (pixel[0, 0] - u - fu) * inverse, (pixel[0, 1] - v - fv) * inverse
        rho, _, curvature = geman_mcclure(np.sqrt(e0 * e0 + e1 * e1), term.scale, each)
        energy += rho
        for a in range(2):
            error = e0 if a == 0 else e1
            add_residual(
                wrenches, stiffnesses, s, p0, p1, p2, projection[0, a, 0] * inverse,
                projection[0, a, 1] * inverse, projection[0, a, 2] * inverse,
                curvature * error, curvature,
            )  # fmt: skip
    return energy


@njit(cache=True, nogil=True, inline='always')
def _place(local, t, q, columns, origins, s):  # type: ignore[no-untyped-def]
    """Point q of texture t in the camera frame."""
    x, y, z = local[t, q, 0], local[t, q, 1], local[t, q, 2]
    return (
        origins[s, 0] + columns[s, 0, 0] * x + columns[s, 1, 0] * y + columns[s, 2, 0] * z,
        origins[s, 1] + columns[s, 0, 1] * x + columns[s, 1, 1] * y + columns[s, 2, 1] * z,
        origins[s, 2] + columns[s, 0, 2] * x + columns[s, 1, 2] * y + columns[s, 2, 2] * z,
    )


@njit(cache=True, nogil=True, inline='always')
def _add_pixel_energy(  # type: ignore[no-untyped-def]
    g0, g1, h00, h01, h11, curvature, segment, p0, p1, p2, projection, wrenches, stiffnesses
):
    """Adds an energy with gradient g and Hessian G over the pixel, as two residuals.

    With G = L L^T they have the directions of the rows of L^T and the pulls L^-1 g: both are met.
    """
    l00 = np.sqrt(h00)
    l10 = h01 / l00
    l11 = np.sqrt(max(h11 - l10 * l10, 1e-12))
    first = g0 / l00
    second = (g1 - l10 * first) / l11
    j = projection
    add_residual(
        wrenches, stiffnesses, segment, p0, p1, p2,
        l00 * j[0, 0, 0] + l10 * j[0, 1, 0], l00 * j[0, 0, 1] + l10 * j[0, 1, 1],
        l00 * j[0, 0, 2] + l10 * j[0, 1, 2], curvature * first, curvature,
    )  # fmt: skip
    add_residual(
        wrenches, stiffnesses, segment, p0, p1, p2,
        l11 * j[0, 1, 0], l11 * j[0, 1, 1], l11 * j[0, 1, 2], curvature * second, curvature,
    )  # fmt: skip
