"""The likelihood of an image in vectorised numpy, the reference of the compiled kernels.

It implements the same equations as `hmt_ros.image`, with the batch of poses on the last axis and
matrix products if possible. Tests compare values, gradients and Hessians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.core import (
    BEHIND,
    COVER,
    FLOW_SCALE,
    FLOW_SHARE,
    FLOW_SIGMA,
    MIN_FACING,
    MIN_POINTS,
    OUTLINE_SPACING,
    OUTLINE_TURN,
)
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import flesh_table_of
from hmt_ros.image.surface_points import SurfacePoints, coarse_mesh
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.silhouette import Outline
from test.oracles.numpy_contour import occluding_contour
from test.oracles.numpy_kinematics import assemble, segment_sums

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Residuals(NamedTuple):
    """One term for N poses, as M residuals at points of the body.

    Attributes:
        value: (N,) energy.
        segments: (M,) or (M, N) segment of each residual's point.
        points: (M, 3, N) camera frame, m.
        directions: (M, 3, N) derivative of the residual with respect to its point.
        pull, curvature: (M, N) first and second derivative of the energy by the residual.
    """

    value: Array
    segments: Index
    points: Array
    directions: Array
    pull: Array
    curvature: Array


class Energy(NamedTuple):
    """Value (N,), gradient (N, d) and Gauss-Newton Hessian (N, d, d)."""

    value: Array
    gradient: Array
    hessian: Array


def image_energies(
    likelihood: ImageLikelihood,
    poses: Array,
    observation: Observation,
) -> dict[str, Energy]:
    """The image terms by name; arguments as for `ImageLikelihood.energies`."""
    frames = forward(likelihood.body.skeleton, poses)
    found = _terms(likelihood, frames, observation)
    return {name: _assembled(frames, [term]) for name, term in found.items()}


def image_energy(
    likelihood: ImageLikelihood,
    poses: Array,
    observation: Observation,
) -> Energy:
    """The sum of the image terms, assembled once."""
    frames = forward(likelihood.body.skeleton, poses)
    found = _terms(likelihood, frames, observation)
    return _assembled(frames, list(found.values()))


def _terms(
    likelihood: ImageLikelihood,
    frames: Frames,
    observation: Observation,
) -> dict[str, Residuals]:
    body, camera, s = likelihood.body, likelihood.camera, likelihood.settings
    result: dict[str, Residuals] = {}
    surface = project_surface(body, camera, frames)
    blur = observation.magnification * surface.noise
    seen = {k: v for k, v in observation.evidence.items() if getattr(s, k).weight > 0}
    for name, term in (('coverage', coverage), ('edges', edges)):
        if name in seen:
            own, factors = getattr(s, name), np.ones(len(frames.skeleton.parents))
            if observation.beliefs is not None:
                own = replace(own, weight=own.weight * observation.beliefs.of_term(name))
                factors = observation.beliefs.segments.get(name, factors)
            sigma = np.hypot(own.sigma, blur)
            result[name] = term(surface, seen[name], own, sigma, factors[surface.segments])
    return result


def _assembled(frames: Frames, terms: list[Residuals]) -> Energy:
    count = len(frames.skeleton.parents)
    value = np.zeros(frames.count)
    wrenches = np.zeros((count, 6, frames.count))
    stiffnesses = np.zeros((count, 6, 6, frames.count))
    for term in terms:
        segments = term.segments
        points, directions = term.points, term.directions
        pull, curvature = term.pull, term.curvature
        value += term.value
        if segments.ndim == 1:
            force, stiffness = segment_sums(segments, points, directions, pull, curvature, count)
        else:
            force, stiffness = _scattered_sums(term, count)
        wrenches += force
        stiffnesses += stiffness
    return Energy(value, *assemble(frames, wrenches, stiffnesses))


def _scattered_sums(term: Residuals, count: int) -> tuple[Array, Array]:
    """`segment_sums` for residuals whose segments differ between poses."""
    n = term.points.shape[-1]
    a, p = term.directions, term.points
    b = np.concatenate([a, np.cross(p, a, axis=1)], axis=1).transpose(0, 2, 1)  # (M, N, 6)
    owners = (term.segments * n + np.arange(n)).ravel()
    order = np.argsort(owners, kind='stable')
    present, starts = np.unique(owners[order], return_index=True)
    force = (term.pull[..., None] * b).reshape(-1, 6)[order]
    outer = ((term.curvature[..., None] * b)[..., None] * b[..., None, :]).reshape(-1, 36)[order]
    wrenches, stiffnesses = np.zeros((count * n, 6)), np.zeros((count * n, 36))
    wrenches[present] = np.add.reduceat(force, starts)
    stiffnesses[present] = np.add.reduceat(outer, starts)
    return (
        wrenches.reshape(count, n, 6).transpose(0, 2, 1),
        stiffnesses.reshape(count, n, 6, 6).transpose(0, 2, 3, 1),
    )


def geman_mcclure(residual: Array, scale: float, weight: Array | float) -> tuple[Array, ...]:
    """Values, derivatives and curvatures of the robust kernel."""
    square = residual * residual
    shrink = 1.0 / (1.0 + square / (scale * scale))
    curvature = weight * shrink * shrink
    return 0.5 * weight * square * shrink, curvature * residual, curvature


def sample(image_map: ImageMap, pixels: Array, channels: Index | int = 0) -> tuple[Array, Array]:
    """Values (...) and gradients (2, ...) at pixels (2, ...); the nearest value outside."""
    _, h, w = image_map.values.shape
    x, y = pixels[0] - image_map.left, pixels[1] - image_map.top
    cx = np.clip(np.nan_to_num(x), 0.0, w - 1.001)
    cy = np.clip(np.nan_to_num(y), 0.0, h - 1.001)
    column, row = cx.astype(np.intp), cy.astype(np.intp)
    du, dv = cx - column, cy - row
    flat = image_map.values.reshape(-1)
    index = (np.asarray(channels) * h + row) * w + column
    a, b, p, q = flat[index], flat[index + 1], flat[index + w], flat[index + w + 1]
    top, bottom = a + (b - a) * du, p + (q - p) * du
    gradient = np.stack([(b - a) * (1 - dv) + (q - p) * dv, bottom - top])
    gradient[0] *= (x >= 0) & (x <= w - 1)
    gradient[1] *= (y >= 0) & (y <= h - 1)
    return top + (bottom - top) * dv, gradient


def sample_distance(
    image_map: ImageMap, pixels: Array, channels: Index | int = 0
) -> tuple[Array, Array]:
    """`sample` of a distance map, extended outside by the distance to the window."""
    value, gradient = sample(image_map, pixels, channels)
    _, h, w = image_map.values.shape
    for axis, (first, size) in enumerate(((image_map.left, w), (image_map.top, h))):
        at = pixels[axis] - first
        value = value + np.maximum(-at, 0.0) + np.maximum(at - (size - 1), 0.0)
        gradient[axis] = np.where(at < 0, -1.0, np.where(at > size - 1, 1.0, gradient[axis]))
    return value, gradient


@dataclass(frozen=True, eq=False)
class Surface:
    """Occluding contours of N poses in the image: P points.

    Attributes:
        segments: (P,) segment of each point.
        points: (P, 3, N) camera frame, m.
        pixels, projection, normals: (2, P, N), (2, 3, P, N), (2, P, N).
        valid, covered, hidden, noise: (P, N), see `hmt_ros.image.surface.Contour`.
    """

    segments: Index
    points: Array
    pixels: Array
    projection: Array
    normals: Array
    valid: Mask
    covered: Mask
    hidden: Mask
    noise: Array


def project_surface(body: Body, camera: Camera, frames: Frames) -> Surface:
    """Contours of the flesh at the frames of N poses."""
    contour = occluding_contour(body.flesh, frames)
    pixels, projection = camera.project_with_derivative(contour.points.transpose(1, 0, 2))
    valid = contour.exists & np.isfinite(pixels[0])
    # The normal of the contour is perpendicular to the ray: only its image part matters.
    normals = np.stack([contour.normals[:, 0] / camera.fx, contour.normals[:, 1] / camera.fy])
    normals /= np.maximum(np.hypot(normals[0], normals[1]), 1e-12)
    covered, hidden = visibility(body, frames, contour.points, contour.parts)
    deviations = np.tile(flesh_table_of(body).ring_noise, (2, 1))
    noise = np.sqrt(((contour.turns * deviations[..., None]) ** 2).sum(1))
    return Surface(
        contour.segments, contour.points, np.nan_to_num(pixels), np.nan_to_num(projection),
        normals, valid, covered, hidden, noise,
    )  # fmt: skip


def visibility(body: Body, frames: Frames, points: Array, parts: Index) -> tuple[Mask, Mask]:
    """Whether other parts lie on the rays to points (P, 3, N), and in front of them; (P, N)."""
    flesh = body.flesh
    segments = np.array([part.segment for part in flesh.parts])
    radii = COVER * np.array([part.radii for part in flesh.parts])
    centres = frames.points(segments, np.array([part.centre for part in flesh.parts]))
    n, count = frames.count, len(segments)
    scaled = frames.columns[segments] / radii[:, :, None, None]  # (B, 3 axes, 3, N)
    k = np.einsum('bixn,bxn->nbi', scaled, centres)
    shapes = np.ascontiguousarray(scaled.reshape(-1, 3, n).transpose(2, 0, 1))
    m = shapes @ np.ascontiguousarray(points.transpose(2, 1, 0))  # (N, 3B, P)
    m = m.reshape(n, count, 3, -1)
    mm = np.einsum('nbip,nbip->nbp', m, m)
    mk = np.einsum('nbip,nbi->nbp', m, k)
    discriminant = mk * mk - mm * ((k * k).sum(2) - 1.0)[:, :, None]
    through = (discriminant > 0) & (np.arange(count)[:, None] != parts)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    through &= mk + root > 0.0  # parts behind the camera cover nothing
    before = through & (mk - root < (1.0 - BEHIND) * mm)
    return through.any(1).T, before.any(1).T


def coverage(
    surface: Surface, outline: Outline, term: TermSettings, sigma: Array, factors: Array
) -> Residuals:
    """Points on the outline pay their distance to the nearest contour of the model.

    `factors` (P,) are the factors of the contour points.
    """
    match = nearest_contour_points(surface, outline)  # (M, N)
    batch = np.arange(match.shape[1])
    offset = surface.pixels[:, match, batch] - outline.pixels.T[:, :, None]
    nx, ny = outline.normals.T[:, :, None]
    sigma = sigma[match, batch]
    across = (nx * offset[0] + ny * offset[1]) / sigma
    along = nx * offset[1] - ny * offset[0]
    beyond = np.sign(along) * np.maximum(np.abs(along) - OUTLINE_SPACING, 0.0) / sigma
    # One kernel is applied to the norm of the two residuals.
    each = term.weight / max(len(match), 1)
    rho, _, curvature = geman_mcclure(np.hypot(across, beyond), term.scale, each * factors[match])
    # If the whole body is behind the camera, every sample has its maximum cost.
    seen = surface.valid.any(0)
    rho = np.where(seen, rho, 0.5 * each * term.scale**2)
    curvature = np.where(seen, curvature, 0.0)
    projection = surface.projection[:, :, match, batch]  # (2, 3, M, N)
    toward = nx * projection[0] + ny * projection[1]
    sideways = nx * projection[1] - ny * projection[0]
    directions = np.concatenate([toward, sideways], axis=1).transpose(1, 0, 2)
    directions = directions / np.tile(sigma, (2, 1))[:, None]
    return Residuals(
        rho.sum(0),
        np.tile(surface.segments[match], (2, 1)),
        np.tile(surface.points[match, :, batch].transpose(0, 2, 1), (2, 1, 1)),
        directions,
        np.concatenate([curvature * across, curvature * beyond]),
        np.concatenate([curvature, np.where(beyond != 0, curvature, 0.0)]),
    )


def nearest_contour_points(surface: Surface, outline: Outline) -> Index:
    """Index (M, N) of the contour point nearest to each sample, by position and direction.

    |c - u|^2 + t^2 |n_c - n_u|^2, up to what does not depend on u, is one matrix product.
    """
    centre = outline.pixels.mean(0)
    samples = np.concatenate(
        [
            -2.0 * (outline.pixels - centre),
            np.ones((len(outline.pixels), 1)),
            -2.0 * OUTLINE_TURN**2 * outline.normals,
        ],
        axis=1,
    )
    use = surface.valid & ~surface.covered
    # A pose with a fully covered contour uses all existing points.
    use |= surface.valid & ~use.any(0)
    u = np.where(use, surface.pixels - centre[:, None, None], 0.0)
    square = np.where(use, u[0] * u[0] + u[1] * u[1], 1e12)
    features = np.stack([u[0], u[1], square, surface.normals[0], surface.normals[1]])
    features = np.ascontiguousarray(features.transpose(2, 0, 1))  # (N, 5, P)
    return np.ascontiguousarray((samples @ features).argmin(2).T)


def edges(
    surface: Surface, image_map: ImageMap, term: TermSettings, sigma: Array, factors: Array
) -> Residuals:
    """Visible contour points pay their distance to the nearest edge of their direction."""
    bins = image_map.values.shape[0]
    angle = np.arctan2(surface.normals[1], surface.normals[0])
    channels = np.round(angle * (bins / np.pi)).astype(np.intp) % bins
    value, gradient = sample_distance(image_map, surface.pixels, channels)
    seen = surface.valid & ~surface.hidden
    each = np.where(seen, term.weight / np.maximum(seen.sum(0), MIN_POINTS), 0.0)
    residual = np.where(seen, value / sigma, 0.0)
    rho, pull, curvature = geman_mcclure(residual, term.scale, each * factors[:, None])
    directions = _through(gradient / sigma, surface.projection)
    return Residuals(rho.sum(0), surface.segments, surface.points, directions, pull, curvature)


def flow_energy(
    frames: Frames, camera: Camera, points: SurfacePoints, which: Index, flow: ImageMap,
    weight: float,
) -> Energy:  # fmt: skip
    """Energy of the difference between the optical flow and the motion of points (rows (N,))."""
    segments = points.segments[which].T  # (Q, N)
    local = points.local[which].transpose(1, 2, 0)
    batch = np.arange(frames.count)
    columns = frames.columns[segments, :, :, batch]  # (Q, N, 3, 3)
    places = np.einsum('qnix,qin->qxn', columns, local)
    places += frames.origins[segments, :, batch].transpose(0, 2, 1)
    pixels, projection = camera.project_with_derivative(places.transpose(1, 0, 2))
    present = np.arange(len(segments))[:, None] < points.counts[which]
    each = weight / np.maximum(points.counts[which], MIN_POINTS)
    each = np.where(present & np.isfinite(pixels[0]), each, 0.0)
    pixels, projection = np.nan_to_num(pixels), np.nan_to_num(projection)
    start = points.pixels.transpose(2, 0, 1)  # (2, K, Q)
    at = np.broadcast_to(start[:, None], (2, 2, *start.shape[1:]))
    moved, _ = sample(flow, at, np.arange(2)[:, None, None])  # (2, K, Q)
    inverse = 1.0 / (FLOW_SIGMA + FLOW_SHARE * np.hypot(moved[0], moved[1]))[which].T
    error = (pixels - (start + moved)[:, which].transpose(0, 2, 1)) * inverse
    rho, _, curvature = geman_mcclure(np.hypot(error[0], error[1]), FLOW_SCALE, each)
    residuals = _pairs(
        rho, segments, places, projection[0] * inverse, projection[1] * inverse, error[0],
        error[1], curvature,
    )  # fmt: skip
    return _assembled(frames, [residuals])


def _pairs(
    rho: Array, segments: Index, points: Array, along: Array, across: Array, first: Array,
    second: Array, curvature: Array,
) -> Residuals:  # fmt: skip
    """Two residuals per point, with given derivatives (3, Q, N)."""
    return Residuals(
        rho.sum(0),
        np.tile(segments, (2, 1)),
        np.tile(points, (2, 1, 1)),
        np.concatenate([along.transpose(1, 0, 2), across.transpose(1, 0, 2)]),
        np.concatenate([curvature * first, curvature * second]),
        np.concatenate([curvature, curvature]),
    )


def _through(gradient: Array, projection: Array) -> Array:
    """Derivatives (P, 3, N) by the points of residuals with gradients (2, P, N) by the pixels."""
    result: Array = np.einsum('apn,aipn->pin', gradient, projection)
    return result


def seen_points(body: Body, camera: Camera, frames: Frames, points: int = 120) -> SurfacePoints:
    """Points of the surface visible at K poses, as `hmt_ros.image.surface_points.seen_points`."""
    mesh = coarse_mesh(body)
    places = frames.points(mesh.segments, mesh.vertices)
    normals = frames.directions(mesh.segments, mesh.normals)
    distance = np.sqrt((places * places).sum(1))
    facing = -(places * normals).sum(1) > MIN_FACING * distance
    _, hidden = visibility(body, frames, places, mesh.parts)
    pixels = camera.project(places.transpose(0, 2, 1)).transpose(2, 0, 1)  # (2, V, K)
    inside = (pixels[0] >= 0) & (pixels[0] < camera.width)
    inside &= (pixels[1] >= 0) & (pixels[1] < camera.height)
    visible = facing & ~hidden & inside
    k = frames.count
    result = SurfacePoints(
        np.zeros(k, np.int64), np.zeros((k, points), np.int64), np.zeros((k, points, 3)),
        np.zeros((k, points, 2)),
    )  # fmt: skip
    for i in range(k):
        seen = np.flatnonzero(visible[:, i])
        taken = min(len(seen), points)
        chosen = seen[(np.arange(taken) * len(seen)) // max(taken, 1)]
        at = pixels[:, chosen, i]
        result.counts[i] = taken
        result.segments[i, :taken] = mesh.segments[chosen]
        result.local[i, :taken] = mesh.vertices[chosen]
        result.pixels[i, :taken] = at.T
    return result
