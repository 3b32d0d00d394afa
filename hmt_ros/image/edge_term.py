"""Likelihood of edges: visible contour points lie on image edges of their direction (KJS 2)."""

from __future__ import annotations

import numpy as np

from hmt_ros.image.observation import orientation_bins
from hmt_ros.image.residuals import Energy, robust
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import Surface


def edge_energy(
    surface: Surface,
    edges: ImageMap,
    *,
    sigma: float,
    scale: float,
    weight: float,
    count: int | None = None,
) -> Energy:
    """Energy of the distances from visible contour points to the nearest edge, normalised along it.

    Args:
        surface: contours of N poses.
        edges: distance to the nearest edge of each orientation, px.
        sigma: standard deviation of an edge, px.
        scale: of the robust kernel, in sigmas; truncates edges that were not found.
        weight: total weight of all points.
        count: number of points that the weight is for; the visible ones when None.
    """
    bins = orientation_bins(np.arctan2(surface.normals[1], surface.normals[0]))
    value, gradient = edges.sample(surface.pixels, bins)
    seen = surface.valid & ~surface.hidden
    residual = np.where(seen, value / sigma, 0.0)
    projection = np.nan_to_num(surface.projection, nan=0.0)
    directions = np.einsum('apn,aipn->pin', gradient / sigma, projection)
    each = np.where(seen, weight / (count or np.maximum(seen.sum(0), 20)), 0.0)
    rho, pull, curvature = robust(residual, scale, each)
    return Energy(
        rho.sum(0),
        surface.contour.segments,
        surface.contour.points,
        directions,
        pull,
        curvature,
        rho,
    )
