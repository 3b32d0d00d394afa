"""Likelihood of a silhouette, both ways (KJS 2; Sminchisescu and Triggs, IJRR 2003).

The model explains the silhouette when its contour lies inside, and when the outline of the
silhouette lies on the contour of the model: the first alone would let the model shrink, the second
alone would let limbs stick out.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_ros.image.sampling import sample_distance
from hmt_ros.image.terms.accumulation import add_residual
from hmt_ros.image.terms.robust_kernel import geman_mcclure

# Pixels that opposite directions count like when outline and contour are matched, per unit.
TURN = 12.0
# Along the outline distances up to this, px, cost nothing: the contour's points stand that far
# apart.
SPACING = 8.0


@njit(cache=True, nogil=True)
def add_containment(distance, contour, part_segments, term, each, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
    """Contour points outside the silhouette pay their distance to it; returns the energy.

    Args:
        distance: signed distance to the outline, px, positive outside.
        contour: of one pose.
        part_segments: (B,) segment of each part.
        term: weight, sigma (px) and scale (sigmas) of the term.
        each: weight of one point.
        wrenches, stiffnesses: sums of the segments, added to.
    """
    energy = 0.0
    for i in range(len(contour.parts)):
        if not contour.valid[i]:
            continue
        value, gu, gv = sample_distance(distance, 0, contour.pixels[i, 0], contour.pixels[i, 1])
        if value <= 0.0:
            continue
        rho, pull, curvature = geman_mcclure(value / term.sigma, term.scale, each)
        energy += rho
        j, p = contour.projections, contour.points
        gu, gv = gu / term.sigma, gv / term.sigma
        add_residual(
            wrenches, stiffnesses, part_segments[contour.parts[i]], p[i, 0], p[i, 1], p[i, 2],
            gu * j[i, 0, 0] + gv * j[i, 1, 0], gu * j[i, 0, 1] + gv * j[i, 1, 1],
            gu * j[i, 0, 2] + gv * j[i, 1, 2], pull, curvature,
        )  # fmt: skip
    return energy


@njit(cache=True, nogil=True)
def add_coverage(  # type: ignore[no-untyped-def]
    pixels, normals, contour, part_segments, term, each, explained, costs, wrenches, stiffnesses
):
    """Points on the outline pay their distance to the nearest contour of the model.

    Nearest by position and direction, among contour points that no other part covers.

    Args:
        pixels, normals: (M, 2) samples on the outline of the silhouette.
        contour: of one pose.
        part_segments: (B,) segment of each part.
        term: weight, sigma (px) and scale (sigmas) of the term.
        each: weight of one sample.
        explained: (M,) what each sample costs at most, because something else explains it.
        costs: (M,) what each sample costs, result.
        wrenches, stiffnesses: sums of the segments, added to.
    """
    count = len(contour.parts)
    use = np.empty(count, np.int64)
    used = 0
    for i in range(count):
        if contour.valid[i] and not contour.covered[i]:
            use[used] = i
            used += 1
    if used == 0:  # a pose whose contour is covered everywhere keeps all that exists
        for i in range(count):
            if contour.valid[i]:
                use[used] = i
                used += 1
    us, vs = np.empty(used, np.float32), np.empty(used, np.float32)
    nus, nvs = np.empty(used, np.float32), np.empty(used, np.float32)
    turn = np.float32(TURN)
    for k in range(used):
        i = use[k]
        us[k], vs[k] = contour.pixels[i, 0], contour.pixels[i, 1]
        nus[k], nvs[k] = turn * contour.normals[i, 0], turn * contour.normals[i, 1]
    energy = 0.0
    gaps = np.empty(used, np.float32)
    for m in range(len(pixels)):
        if used == 0:
            costs[m] = min(explained[m], 0.5 * each * term.scale * term.scale)
            energy += costs[m]
            continue
        u, v = np.float32(pixels[m, 0]), np.float32(pixels[m, 1])
        nu, nv = turn * np.float32(normals[m, 0]), turn * np.float32(normals[m, 1])
        for k in range(used):
            du, dv, dnu, dnv = us[k] - u, vs[k] - v, nus[k] - nu, nvs[k] - nv
            gaps[k] = du * du + dv * dv + dnu * dnu + dnv * dnv
        least = gaps[0]
        for k in range(1, used):
            least = min(least, gaps[k])
        nearest = 0
        while gaps[nearest] != least:
            nearest += 1
        i = use[nearest]
        du, dv = contour.pixels[i, 0] - pixels[m, 0], contour.pixels[i, 1] - pixels[m, 1]
        nx, ny = normals[m, 0], normals[m, 1]
        across = (nx * du + ny * dv) / term.sigma
        along = nx * dv - ny * du
        beyond = 0.0
        if along > SPACING:
            beyond = (along - SPACING) / term.sigma
        elif along < -SPACING:
            beyond = (along + SPACING) / term.sigma
        length = np.sqrt(across * across + beyond * beyond)
        rho, _, curvature = geman_mcclure(length, term.scale, each)
        if rho >= explained[m]:
            costs[m] = explained[m]
            energy += costs[m]
            continue
        costs[m] = rho
        energy += rho
        segment = part_segments[contour.parts[i]]
        p, j = contour.points, contour.projections
        nx, ny = nx / term.sigma, ny / term.sigma
        add_residual(
            wrenches, stiffnesses, segment, p[i, 0], p[i, 1], p[i, 2],
            nx * j[i, 0, 0] + ny * j[i, 1, 0], nx * j[i, 0, 1] + ny * j[i, 1, 1],
            nx * j[i, 0, 2] + ny * j[i, 1, 2], curvature * across, curvature,
        )  # fmt: skip
        if beyond != 0.0:
            add_residual(
                wrenches, stiffnesses, segment, p[i, 0], p[i, 1], p[i, 2],
                nx * j[i, 1, 0] - ny * j[i, 0, 0], nx * j[i, 1, 1] - ny * j[i, 0, 1],
                nx * j[i, 1, 2] - ny * j[i, 0, 2], curvature * beyond, curvature,
            )  # fmt: skip
    return energy
