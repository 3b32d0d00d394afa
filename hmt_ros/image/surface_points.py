"""Points of the body's surface that a camera sees at a pose, for flow and silhouette."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames
from hmt_ros.image.surface import flesh_table_of, lens_of, mark_visibility, project
from hmt_ros.inference.arrays import Array, Mask

Ints = NDArray[np.int64]

# A surface that faces the camera less than this (cosine) is seen too flat.
FACING = 0.3


class SurfacePoints(NamedTuple):
    """Up to Q points on the visible surface of each of K poses.

    Attributes:
        counts: (K,) points of each pose; the rest of its row is not used.
        segments: (K, Q).
        local: (K, Q, 3) places in the frames of the segments, m.
        pixels: (K, Q, 2) where they are seen.
    """

    counts: Ints
    segments: Ints
    local: Array
    pixels: Array


def seen_points(
    body: Body, camera: Camera, frames: Frames, others: Mask | None = None, points: int = 120
) -> SurfacePoints:
    """Points of the surface visible at K poses.

    They are spread evenly over the visible vertices of a coarse mesh, the same way every time.

    Args:
        body: with flesh.
        camera: that sees it.
        frames: of the K poses.
        others: (H, W) pixels that show or may show somebody else; None: there are none.
        points: at most so many a pose, Q.
    """
    k = frames.count
    mesh = coarse_mesh(body)
    result = SurfacePoints(
        np.zeros(k, np.int64),
        np.zeros((k, points), np.int64),
        np.zeros((k, points, 3)),
        np.zeros((k, points, 2)),
    )
    columns, origins = frames.by_pose()
    flesh, lens = flesh_table_of(body), lens_of(camera)
    hidden = np.zeros((0, 0), np.bool_) if others is None else np.ascontiguousarray(others)
    size = np.array([camera.width, camera.height])
    for i in range(k):
        _see(
            flesh,
            mesh.vertices,
            mesh.normals,
            mesh.segments,
            mesh.parts,
            lens,
            size,
            columns[i],
            origins[i],
            hidden,
            i,
            result,
        )
    return result


def coarse_mesh(body: Body) -> Mesh:
    """The mesh whose vertices are such points."""
    return body.flesh.mesh(stacks=5, slices=10)


@njit(cache=True, nogil=True)
def _see(  # type: ignore[no-untyped-def]
    flesh, vertices, normals, segments, parts, lens, size, columns, origins, others, k, result
):
    count = len(vertices)
    points = np.empty((count, 3))
    pixels = np.empty((count, 2))
    visible = np.empty(count, np.bool_)
    projections = np.empty((count, 2, 3))
    for i in range(count):
        s = segments[i]
        facing, square = 0.0, 0.0
        for a in range(3):
            points[i, a] = origins[s, a]
            normal = 0.0
            for b in range(3):
                points[i, a] += columns[s, b, a] * vertices[i, b]
                normal += columns[s, b, a] * normals[i, b]
            facing -= normal * points[i, a]
            square += points[i, a] * points[i, a]
        visible[i] = facing > FACING * np.sqrt(square)
        if visible[i]:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            visible[i] = project(lens, x, y, z, i, pixels, projections)
        if visible[i]:
            u, v = pixels[i, 0], pixels[i, 1]
            visible[i] = 0.0 <= u < size[0] and 0.0 <= v < size[1]
        if visible[i] and len(others) > 0:
            row = min(int(pixels[i, 1] + 0.5), len(others) - 1)
            column = min(int(pixels[i, 0] + 0.5), others.shape[1] - 1)
            visible[i] = not others[row, column]
    covered, hidden = np.empty(count, np.bool_), np.empty(count, np.bool_)
    everything = np.ones(len(flesh.part_segments), np.bool_)
    mark_visibility(flesh, everything, columns, origins, parts, points, visible, covered, hidden)
    seen = np.flatnonzero(visible & ~hidden)
    room = result.segments.shape[1]
    taken = min(len(seen), room)
    for q in range(taken):
        i = seen[q * len(seen) // taken]
        result.segments[k, q] = segments[i]
        result.local[k, q] = vertices[i]
        result.pixels[k, q] = pixels[i]
    result.counts[k] = taken
