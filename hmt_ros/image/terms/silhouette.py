"""The silhouette (KJS 2; Sminchisescu and Triggs, IJRR 2003).

    coverage      E(x) = w / M sum_m rho(|u_i(m)(x) - s_m| / sigma)

s_m are M samples of the outline of the silhouette, u_i points of the model's contour, and i(m) is
the one nearest to sample m. The model explains the silhouette when its outline lies on the contour
of the model.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit

from hmt_ros.image.terms.image_term import (
    ImageTerm,
    ImageWindow,
    Request,
    TermSettings,
    Weighting,
)
from hmt_ros.image.terms.residuals import add_residual, contour_sigma, geman_mcclure
from hmt_ros.inference.arrays import Array

# Samples on the outline.
OUTLINE_POINTS = 120
# Pixels that a unit of difference in direction counts as when outline and contour are matched.
TURN = 12.0
# Along the outline distances up to this, px, cost nothing: the contour's points stand that far
# apart.
SPACING = 8.0
# Belief in a sample of the outline beyond which, this many px away, the person may go on.
UNSURE = 0.3
BESIDE = 4.0


class Outline(NamedTuple):
    """M samples on the outline of a silhouette.

    Attributes:
        pixels: (M, 2).
        normals: (M, 2) unit vectors out of the silhouette.
        beliefs: (M,) belief in each, 0 to 1.
    """

    pixels: Array
    normals: Array
    beliefs: Array


class CoverageInputs(NamedTuple):
    """Inputs of the kernel of the coverage.

    Attributes:
        term: weighting.
        outline: samples.
        explained: (X, M) maximum energy of samples; a row a pose, or one row for all.
        costs: (N, M) result: energy of each sample.
    """

    term: Weighting
    outline: Outline
    explained: Array
    costs: Array


def outline(window: ImageWindow, count: int = OUTLINE_POINTS) -> Outline | None:
    """Points spaced evenly along all outlines of the silhouette, holes included."""
    mask = window.mask
    if mask is None:
        return None
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    contours = [c[:, 0].astype(float) for c in contours if len(c) >= 12]
    if not contours:
        return NO_OUTLINE
    steps = [np.linalg.norm(np.roll(c, -1, axis=0) - c, axis=1) for c in contours]
    total = sum(x.sum() for x in steps)
    points = []
    for contour, step in zip(contours, steps, strict=True):
        n = max(round(count * step.sum() / total), 3)
        along = np.concatenate([[0.0], np.cumsum(step)])
        closed = np.concatenate([contour, contour[:1]])
        at = (np.arange(n) + 0.5) / n * along[-1]
        points.append(np.stack([np.interp(at, along, closed[:, i]) for i in range(2)], axis=1))
    pixels = np.concatenate(points)
    # Out of the silhouette is against the gradient of the blurred mask.
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.0)
    column, row = np.round(pixels).astype(int).T
    normals = -np.stack(
        [
            cv2.Sobel(blurred, cv2.CV_32F, 1, 0)[row, column],
            cv2.Sobel(blurred, cv2.CV_32F, 0, 1)[row, column],
        ],
        axis=1,
    ).astype(float)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-3
    normals = normals[good] / length[good, None]
    # The outline lies half a pixel outside the last pixels of the silhouette.
    pixels = pixels[good]
    beliefs = np.ones(len(pixels))
    if window.unsure is not None or window.others is not None:
        column, row = np.round(pixels + BESIDE * normals).astype(int).T
        column = np.clip(column, 0, mask.shape[1] - 1)
        row = np.clip(row, 0, mask.shape[0] - 1)
        if window.unsure is not None:
            beliefs[window.unsure[row, column] > 0] = UNSURE
        if window.others is not None:
            beliefs[window.others[row, column] > 0] = 0.0
    pixels = pixels + 0.5 * normals + np.array([window.left, window.top])
    return Outline(pixels, normals, beliefs)


NO_OUTLINE = Outline(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def _coverage_inputs(term: Weighting, evidence: Any, request: Request) -> CoverageInputs:
    found: Outline = evidence or NO_OUTLINE
    samples = len(found.pixels)
    if samples == 0:
        term = term._replace(weight=0.0)
    explained = request.explained
    if explained is None:
        explained = np.full((1, samples), np.inf)
    return CoverageInputs(term, found, explained, np.zeros((request.poses, samples)))


@njit(cache=True, nogil=True)
def _nearest(pixels, normals, places, directions, use):  # type: ignore[no-untyped-def]
    """For each sample the point of the contour, one of `use`, that is nearest and points its way.

    Places and directions are the pixels and normals of the contour. All samples are compared with
    one point at a time: so the compiler takes many at once.
    """
    turn, count = np.float32(TURN), len(pixels)
    us, vs = np.empty(count, np.float32), np.empty(count, np.float32)
    nus, nvs = np.empty(count, np.float32), np.empty(count, np.float32)
    least, result = np.empty(count, np.float32), np.zeros(count, np.int32)
    for m in range(count):
        us[m], vs[m] = pixels[m, 0], pixels[m, 1]
        nus[m], nvs[m] = turn * np.float32(normals[m, 0]), turn * np.float32(normals[m, 1])
        least[m] = np.inf
    for i in use:
        u, v = np.float32(places[i, 0]), np.float32(places[i, 1])
        nu = np.float32(turn * directions[i, 0])
        nv = np.float32(turn * directions[i, 1])
        point = np.int32(i)
        for m in range(count):
            du, dv, dnu, dnv = u - us[m], v - vs[m], nu - nus[m], nv - nvs[m]
            gap = du * du + dv * dv + dnu * dnu + dnv * dnv
            closer = gap < least[m]
            least[m] = gap if closer else least[m]
            result[m] = point if closer else result[m]
    return result


@njit(cache=True, nogil=True)
def add_coverage(view, inputs, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
    """Energy of the distances from outline samples to the contour; see `ImageTerm.kernel`.

    Nearest by position and direction, among contour points that no other part covers.
    """
    pixels, normals = inputs.outline.pixels, inputs.outline.normals
    term, contour, part_segments = inputs.term, view.contour, view.owners
    parts, p, places, j = contour.parts, contour.points, contour.pixels, contour.projections
    valid, covered, noise = contour.valid, contour.covered, contour.noise
    beliefs = inputs.outline.beliefs
    share = term.weight / len(pixels)
    explained = inputs.explained[view.number[0] if len(inputs.explained) > 1 else 0]
    costs = inputs.costs[view.number[0]]
    count = len(parts)
    use = np.empty(count, np.int64)
    used = 0
    for i in range(count):
        if valid[i] and not covered[i]:
            use[used] = i
            used += 1
    if used == 0:  # a pose whose contour is covered everywhere keeps all that exists
        for i in range(count):
            if valid[i]:
                use[used] = i
                used += 1
    if used == 0:
        energy = 0.0
        for m in range(len(pixels)):
            costs[m] = min(explained[m], 0.5 * share * beliefs[m] * term.scale * term.scale)
            energy += costs[m]
        return energy
    nearest = _nearest(pixels, normals, places, contour.normals, use[:used])
    inverse = np.empty(count)
    for i in range(count):
        inverse[i] = 1.0 / contour_sigma(term, noise[i])
    across, beyond = np.empty(len(pixels)), np.empty(len(pixels))
    per_scale, energy = 1.0 / (term.scale * term.scale), 0.0
    for m in range(len(pixels)):
        i = nearest[m]
        du, dv = places[i, 0] - pixels[m, 0], places[i, 1] - pixels[m, 1]
        nx, ny = normals[m, 0], normals[m, 1]
        along = nx * dv - ny * du
        across[m] = (nx * du + ny * dv) * inverse[i]
        beyond[m] = (along - min(max(along, -SPACING), SPACING)) * inverse[i]
        square = across[m] * across[m] + beyond[m] * beyond[m]
        rho = 0.5 * share * beliefs[m] * square / (1.0 + square * per_scale)
        costs[m] = min(rho, explained[m])
        energy += costs[m]
    if len(wrenches) == 0:
        return energy
    for m in range(len(pixels)):
        square = across[m] * across[m] + beyond[m] * beyond[m]
        rho, _, curvature = geman_mcclure(np.sqrt(square), term.scale, share * beliefs[m])
        if rho >= explained[m]:
            continue
        i = nearest[m]
        segment = part_segments[parts[i]]
        nx, ny = normals[m, 0] * inverse[i], normals[m, 1] * inverse[i]
        add_residual(
            wrenches,
            stiffnesses,
            segment,
            p[i, 0],
            p[i, 1],
            p[i, 2],
            nx * j[i, 0, 0] + ny * j[i, 1, 0],
            nx * j[i, 0, 1] + ny * j[i, 1, 1],
            nx * j[i, 0, 2] + ny * j[i, 1, 2],
            curvature * across[m],
            curvature,
        )
        if beyond[m] != 0.0:
            add_residual(
                wrenches,
                stiffnesses,
                segment,
                p[i, 0],
                p[i, 1],
                p[i, 2],
                nx * j[i, 1, 0] - ny * j[i, 0, 0],
                nx * j[i, 1, 1] - ny * j[i, 0, 1],
                nx * j[i, 1, 2] - ny * j[i, 0, 2],
                curvature * beyond[m],
                curvature,
            )
    return energy


COVERAGE = ImageTerm(
    'coverage',
    "Distance of the silhouette's outline from the model's contour.",
    TermSettings(30.0, 1.5, 8.0),
    outline,
    _coverage_inputs,
    add_coverage,
    needs_contour=True,
)
