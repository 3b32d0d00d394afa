"""Likelihood of edges: visible contour points lie on image edges of their direction (KJS 2)."""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_ros.image.sampling import sample_distance
from hmt_ros.image.terms.accumulation import add_residual
from hmt_ros.image.terms.robust_kernel import geman_mcclure

# Fewer visible points than this do not make each of them count more.
FEWEST = 20


@njit(cache=True, nogil=True)
def add_edges(edges, contour, part_segments, term, count, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
    """Distances from visible contour points to the nearest edge, normalised; returns the energy.

    Args:
        edges: distance to the nearest edge of each orientation bin, px.
        contour: of one pose.
        part_segments: (B,) segment of each part.
        term: weight, sigma (px) and scale (sigmas) of the term; the scale truncates edges that were
            not found.
        count: number of points that the weight is for; 0: those that are visible.
        wrenches, stiffnesses: sums of the segments, added to.
    """
    bins = edges.values.shape[0]
    if count == 0:
        for i in range(len(contour.parts)):
            if contour.valid[i] and not contour.hidden[i]:
                count += 1
    each = term.weight / max(count, FEWEST)
    energy = 0.0
    for i in range(len(contour.parts)):
        if not contour.valid[i] or contour.hidden[i]:
            continue
        angle = np.arctan2(contour.normals[i, 1], contour.normals[i, 0])
        channel = int(np.round(angle * (bins / np.pi))) % bins
        value, gu, gv = sample_distance(edges, channel, contour.pixels[i, 0], contour.pixels[i, 1])
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
