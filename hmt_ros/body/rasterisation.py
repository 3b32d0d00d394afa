"""Rasterisation of a body's flesh: the triangles of its mesh that face a camera, and silhouettes.

Triangles are cut into spans of pixels, all in numpy over whole arrays. A pixel belongs to a
triangle when its centre lies inside; neighbouring triangles share no pixel and leave no gap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import forward
from hmt_ros.inference.arrays import Array, Index, Mask

STACKS, SLICES = 13, 18  # mesh of a part; its outline is exact to 2 % of its radius
MIN_AREA = 1e-6  # px^2, twice the area of a triangle; smaller triangles cover no pixel centre
BATCH_SIZE = 16  # number of poses whose silhouettes are drawn together


def render_silhouettes(body: Body, poses: ArrayLike, camera: Camera) -> Mask:
    """Silhouettes (N, H, W) of a body at poses (N, d).

    Raises:
        ValueError: the body has no flesh, or the poses have a wrong shape.
    """
    poses = np.asarray(poses, dtype=np.float64)
    mesh = mesh_of(body)
    result = np.zeros((len(poses), camera.height, camera.width), dtype=bool)
    for start in range(0, len(poses), BATCH_SIZE):
        frames = forward(body.skeleton, poses[start : start + BATCH_SIZE])
        points = frames.points(mesh.segments, mesh.vertices)
        pixels = fill(project(mesh, points, camera), camera.height, camera.width).pixels
        result[start : start + BATCH_SIZE].reshape(-1)[pixels] = True
    return result


@dataclass(frozen=True, eq=False)
class Triangles:
    """F triangles that face the camera."""

    images: Index  # (F,) index of the image
    corners: Index  # (3, F) vertices
    u: Array  # (3, F) px
    v: Array  # (3, F) px
    inverse_depth: Array  # (3, F) 1 / z of the corners, 1/m


@dataclass(frozen=True, eq=False)
class Filled:
    """M pairs of a pixel and a triangle that contains its centre."""

    pixels: Index  # (M,) index into all images, row by row
    rows: Index
    columns: Index
    triangles: Index


@lru_cache(maxsize=8)
def mesh_of(body: Body) -> Mesh:
    """Return the triangles of the flesh, with outward normals."""
    if not body.shapes:
        raise ValueError(f'body {body.name} has no flesh: it can not be drawn')
    mesh = body.flesh.mesh(STACKS, SLICES)
    # The order of corners decides which triangles face the camera, so make it match the normals.
    a, b, c = mesh.vertices[mesh.triangles.T]
    inwards = np.einsum('fx,fx->f', np.cross(b - a, c - a), mesh.normals[mesh.triangles[:, 0]]) < 0
    triangles = np.where(inwards[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    return replace(mesh, triangles=triangles)


@lru_cache(maxsize=8)
def _field_of_view(camera: Camera) -> Array:
    """Bounds [[low, high], [low, high]] of x / z and of y / z of points in the image."""
    u, v = np.linspace(-0.5, camera.width - 0.5, 33), np.linspace(-0.5, camera.height - 0.5, 33)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1))
    slopes = (rays[..., :2] / rays[..., 2:]).reshape(-1, 2)
    low, high = slopes.min(0), slopes.max(0)
    margin = 0.05 * (high - low)
    return np.stack([low - margin, high + margin], axis=1)


def project(mesh: Mesh, points: Array, camera: Camera) -> Triangles:
    """Return triangles that face the camera and may be visible, for vertices (V, 3, N)."""
    p = np.ascontiguousarray(points.transpose(1, 0, 2))
    (u, v), _ = camera.project_with_derivative(p, derivative=False)
    a, b, c = mesh.triangles.T
    # Triangles that are counter-clockwise from outside are clockwise in the image, because v points
    # down. A corner behind the camera is NaN, and the triangle is left out.
    area = (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])
    visible = area < -MIN_AREA
    # Far outside the image, a distortion model may map points back into it.
    (left, right), (top, bottom) = _field_of_view(camera)
    x, y, z = p
    sides = (x < left * z, x > right * z, y < top * z, y > bottom * z)
    for side in sides:
        if side.any():
            visible &= ~(side[a] & side[b] & side[c])
    triangle, image = np.nonzero(visible)
    corners = np.ascontiguousarray(mesh.triangles[triangle].T)
    return Triangles(image, corners, u[corners, image], v[corners, image], 1.0 / z[corners, image])


def fill(triangles: Triangles, height: int, width: int) -> Filled:
    """All pixels whose centres lie in triangles, including triangles hidden by others."""
    # Sort corners from top to bottom, so that both triangles at an edge compute the same positions
    # and each pixel belongs to only one of them.
    order = np.argsort(triangles.v, axis=0, kind='stable')
    u0, u1, u2 = np.take_along_axis(triangles.u, order, axis=0)
    v0, v1, v2 = np.take_along_axis(triangles.v, order, axis=0)
    rows, which = _ranges(_first(v0, height), _first(v2, height))
    with np.errstate(divide='ignore', invalid='ignore'):  # horizontal edges are not used
        upper, lower, long = (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1), (u2 - u0) / (v2 - v0)
    below = rows >= v1[which]
    one = u0[which] + long[which] * (rows - v0[which])
    two = np.where(below, u1[which], u0[which])
    two += np.where(below, lower[which], upper[which]) * (
        rows - np.where(below, v1[which], v0[which])
    )
    start, stop = _first(np.minimum(one, two), width), _first(np.maximum(one, two), width)
    columns, span = _ranges(start, stop)
    first = (triangles.images[which] * height + rows) * width
    return Filled(first[span] + columns, rows[span], columns, which[span])


def _first(places: Array, size: int) -> Index:
    """Round places up to integers, clipped to the image."""
    return np.clip(np.ceil(places), 0, size).astype(np.intp)


def _ranges(start: Index, stop: Index) -> tuple[Index, Index]:
    """Return all integers of the ranges [start, stop), and the range of each."""
    count = np.maximum(stop - start, 0)
    which = np.repeat(np.arange(len(start)), count)
    first = start - (np.cumsum(count) - count)
    return np.arange(len(which)) + first[which], which
