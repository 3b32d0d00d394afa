"""Intensities and motion along the surface (KJS 2).

    intensity     E(x) = w / Q sum_q rho(|I(u_q(x)) - c_q| / sigma)
    motion        E(x) = w / Q sum_q rho(|u_q(x) - p_q - f(p_q)| / (sigma + 0.15 |f(p_q)|))

The model carries the texture of the last accepted image: Q points of its surface, seen at pixels
p_q with colours c_q, that the pose x moves to u_q(x). The intensity term compares the colours with
the present image I; the motion term compares where the texture has moved with the optical flow f,
which says the same to first order but reaches further.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit

from hmt_ros.image.sampling import ImageMap, sample
from hmt_ros.image.surface import project
from hmt_ros.image.terms.image_term import (
    NO_MAP,
    ImageTerm,
    ImageWindow,
    Request,
    TermSettings,
    Weighting,
)
from hmt_ros.image.terms.residuals import add_residual, geman_mcclure

# Fewer texture points than this do not make each of them count more.
FEWEST = 20
# Optical flow errs by this share of the displacement on top of the term's sigma.
FLOW_ERROR = 0.15
# Standard deviation of the blur before intensities are compared, px.
BLUR = 1.5


class TextureInputs(NamedTuple):
    """Weighting, and the blurred colours (3 channels) or the optical flow (2 channels, px)."""

    term: Weighting
    image_map: ImageMap


def blurred_colours(window: ImageWindow) -> ImageMap:
    """The blurred image, three channels; NaN where somebody else is."""
    blurred = cv2.GaussianBlur(window.image, (0, 0), BLUR).astype(np.float32)
    return _map_without_others(window, blurred)


def optical_flow(window: ImageWindow) -> ImageMap | None:
    """Dense flow from the last image to this one, two channels, px [Kroeger et al., ECCV 2016].

    NaN where somebody else is.
    """
    if window.last_image is None:
        return None
    grey = [cv2.cvtColor(x, cv2.COLOR_BGR2GRAY) for x in (window.last_image, window.image)]
    if min(grey[0].shape) < 32:
        return window.as_map(np.zeros((2, *grey[0].shape), np.float32))
    # The stubs do not know that there may be no flow to start from.
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow = method.calc(grey[0], grey[1], None)
    return _map_without_others(window, flow)


def _map_without_others(window: ImageWindow, values: Any) -> ImageMap:
    """Values (h, w, C) as a map."""
    channels = np.ascontiguousarray(values.transpose(2, 0, 1))
    if window.others is not None:
        channels[:, window.others > 0] = np.nan
    return window.as_map(channels)


def _inputs(term: Weighting, evidence: Any, _request: Request) -> TextureInputs:
    return TextureInputs(term, evidence or NO_MAP)


@njit(cache=True, nogil=True)
def add_intensity(view, inputs, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
    """Colours of the texture against the image under it; see `ImageTerm.kernel`."""
    intensity, term = inputs.image_map, inputs.term
    texture, t, wanted = view.textures, view.texture_row, view.textured
    lens, columns, origins = view.lens, view.columns, view.origins
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
        if np.isnan(square):
            # Somebody else hides it: it costs what is usual, wherever it is.
            energy += geman_mcclure(1.0, term.scale, each)[0]
            continue
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
def add_motion(view, inputs, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
    """Motion of the texture against the optical flow; see `ImageTerm.kernel`."""
    flow, term = inputs.image_map, inputs.term
    texture, t, wanted = view.textures, view.texture_row, view.textured
    lens, columns, origins = view.lens, view.columns, view.origins
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
        if np.isnan(fu):
            energy += geman_mcclure(1.0, term.scale, each)[0]
            continue
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


INTENSITY = ImageTerm(
    'intensity',
    'Difference of the texture from that of the last image.',
    TermSettings(4.0, 20.0, 2.0),
    blurred_colours,
    _inputs,
    add_intensity,
    needs_texture=True,
)
MOTION = ImageTerm(
    'motion',
    "Difference of the texture's motion from the optical flow.",
    TermSettings(5.0, 1.5, 2.0),
    optical_flow,
    _inputs,
    add_motion,
    needs_texture=True,
)
