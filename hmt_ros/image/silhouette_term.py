"""Likelihood of a silhouette, both ways (method of Sminchisescu and Triggs).

The model explains the silhouette when its contour lies inside, and when the outline of the silhouette
lies on the contour of the model: the first alone would let the model shrink, the second alone would let
limbs stick out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.observation import Outline
from hmt_ros.image.residuals import Energy, robust
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import Surface

Array = NDArray[np.float64]


def containment_energy(
    surface: Surface,
    distance: ImageMap,
    *,
    sigma: float,
    scale: float,
    weight: float,
    count: int | None = None,
) -> Energy:
    """Contour points outside the silhouette pay their distance to it.

    Args:
        surface: contours of N poses.
        distance: signed distance to the outline, px.
        sigma: standard deviation of the outline, px.
        scale: of the robust kernel, in sigmas.
        weight: total weight of all points.
        count: number of points that the weight is for; all of the surface when None.
    """
    value, gradient = distance.sample(surface.pixels)
    out = surface.valid & (value > 0)
    residual = np.where(out, value / sigma, 0.0)
    directions = np.einsum('apn,aipn->pin', gradient / sigma, _safe(surface.projection))
    each = weight / (count or len(residual))
    rho, pull, curvature = robust(residual, scale, each)
    return Energy(
        rho.sum(0),
        surface.contour.segments,
        surface.contour.points,
        directions,
        pull,
        np.where(out, curvature, 0.0),
        rho,
    )


def coverage_energy(
    surface: Surface,
    outline: Outline,
    *,
    sigma: float,
    scale: float,
    weight: float,
    spacing: float = 8.0,
    explained: Array | None = None,
) -> Energy:
    """Points on the outline pay their distance to the nearest contour of the model.

    Nearest by position and direction. Along the outline distances up to the spacing of the contour's
    points cost nothing.

    Args:
        surface: contours of N poses.
        outline: M samples on the outline of the silhouette.
        sigma: standard deviation of the outline, px.
        scale: of the robust kernel, in sigmas.
        weight: total weight of all samples.
        spacing: of neighbouring contour points, px.
        explained: (M, N) what each sample costs at most, because other parts explain it.
    """
    n = surface.pixels.shape[2]
    match = _nearest_contour_points(surface, outline)  # (M, N)
    batch = np.arange(n)
    u = surface.pixels[:, match, batch]
    offset = u - outline.pixels[:, :, None]
    nx, ny = outline.normals[:, :, None]
    across = nx * offset[0] + ny * offset[1]
    along = nx * offset[1] - ny * offset[0]
    beyond = np.sign(along) * np.maximum(np.abs(along) - spacing, 0.0)
    square = (across * across + beyond * beyond) / (sigma * sigma)
    # One kernel on the length of the two residuals together.
    rho, _, curvature = robust(np.sqrt(square), scale, weight / max(len(match), 1))
    if explained is not None:
        curvature = np.where(rho < explained, curvature, 0.0)
        rho = np.minimum(rho, explained)
    projection = surface.projection[:, :, match, batch]  # (2, 3, M, N)
    toward = nx * projection[0] + ny * projection[1]
    sideways = nx * projection[1] - ny * projection[0]
    directions = np.concatenate([toward.transpose(1, 0, 2), sideways.transpose(1, 0, 2)]) / sigma
    residual = np.concatenate([across, beyond]) / sigma
    both = np.concatenate([curvature, curvature])
    used = np.concatenate([np.ones_like(beyond), (beyond != 0).astype(float)])
    return Energy(
        rho.sum(0),
        np.tile(surface.contour.segments[match], (2, 1)),
        np.tile(surface.contour.points[match, :, batch].transpose(0, 2, 1), (2, 1, 1)),
        directions,
        both * residual,
        both * used,
        rho,
    )


def _nearest_contour_points(surface: Surface, outline: Outline) -> NDArray[np.intp]:
    """Index (M, N) of the contour point nearest to each sample of the outline.

    The distance |c - u|^2 + t^2 |n_c - n_u|^2, up to what does not depend on u, is one matrix product.
    """
    turn = 12.0  # px that opposite directions count like, per unit of difference
    c = outline.pixels.mean(1, keepdims=True) if outline.pixels.size else np.zeros((2, 1))
    samples = np.concatenate(
        [
            -2.0 * (outline.pixels - c),
            np.ones((1, outline.pixels.shape[1])),
            -2 * turn**2 * outline.normals,
        ]
    ).astype(np.float32)
    use = surface.valid & ~surface.covered
    # A pose whose contour is hidden everywhere keeps all that exists.
    use |= surface.valid & ~use.any(0)
    u = np.where(use, surface.pixels - c[:, :, None], 0.0)
    square = np.where(use, u[0] * u[0] + u[1] * u[1], 1e9)
    features = np.stack([u[0], u[1], square, surface.normals[0], surface.normals[1]])
    features = np.ascontiguousarray(features.transpose(2, 0, 1), dtype=np.float32)  # (N, 5, P)
    return np.ascontiguousarray((samples.T @ features).argmin(2).T)


def _safe(projection: Array) -> Array:
    return np.nan_to_num(projection, nan=0.0)
