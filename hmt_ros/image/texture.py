"""Texture of the body's surface, taken from an image at a pose and looked up at another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames
from hmt_ros.image.sampling import ImageMap, sample
from hmt_ros.image.surface import flesh_table_of, lens_of, mark_visibility, project
from hmt_ros.inference.arrays import Array

Ints = NDArray[np.int64]

# A surface that faces the camera less than this (cosine) is seen too flat to carry a texture.
FACING = 0.3


class Textures(NamedTuple):
    """Up to Q points on the visible surface of each of K poses.

    Attributes:
        counts: (K,) points of each pose; the rest of its row is not used.
        segments: (K, Q).
        local: (K, Q, 3) places in the frames of the segments, m.
        pixels: (K, Q, 2) where they were seen.
        colours: (K, Q, 3) what was seen there.
    """

    counts: Ints
    segments: Ints
    local: Array
    pixels: Array
    colours: Array


def with_swapped_sides(
    textures: Textures, row: int, left: Sequence[int], right: Sequence[int]
) -> Textures:
    """The textures and one row more: that of a pose, had two limbs been taken for each other.

    Args:
        textures: of K poses.
        row: of the pose.
        left, right: segments of the limbs, in the same order; their frames mirror each other.
    """
    mirror = np.arange(1 + max(int(textures.segments.max(initial=0)), *left, *right))
    mirror[list(left)], mirror[list(right)] = right, left
    segments = mirror[textures.segments[row]]
    local = textures.local[row].copy()
    local[segments != textures.segments[row], 0] *= -1.0
    added = (
        textures.counts[row], segments, local, textures.pixels[row], textures.colours[row]
    )  # fmt: skip
    return Textures(*(np.concatenate([a, b[None]]) for a, b in zip(textures, added, strict=True)))


def no_textures() -> Textures:
    """Textures of no pose."""
    return Textures(
        np.zeros(0, np.int64), np.zeros((0, 1), np.int64), np.zeros((0, 1, 3)),
        np.zeros((0, 1, 2)), np.zeros((0, 1, 3)),
    )  # fmt: skip


def capture_textures(
    body: Body, camera: Camera, frames: Frames, intensity: ImageMap, points: int = 120
) -> Textures:
    """Textures of the surface visible at K poses.

    The points are spread evenly over the visible vertices of a coarse mesh, the same way every
    time.

    Args:
        body: with flesh.
        camera: that took the image.
        frames: of the K poses.
        intensity: the blurred image, three channels.
        points: at most so many a pose, Q.
    """
    k = frames.count
    mesh = coarse_mesh(body)
    result = Textures(
        np.zeros(k, np.int64), np.zeros((k, points), np.int64), np.zeros((k, points, 3)),
        np.zeros((k, points, 2)), np.zeros((k, points, 3)),
    )  # fmt: skip
    columns, origins = frames.by_pose()
    flesh, lens = flesh_table_of(body), lens_of(camera)
    size = np.array([camera.width, camera.height])
    for i in range(k):
        _capture(
            flesh, mesh.vertices, mesh.normals, mesh.segments, mesh.parts, lens, size,
            columns[i], origins[i], intensity, i, result,
        )  # fmt: skip
    return result


def coarse_mesh(body: Body) -> Mesh:
    """The mesh whose vertices carry the texture."""
    return body.flesh.mesh(stacks=5, slices=10)


@njit(cache=True, nogil=True)
def _capture(  # type: ignore[no-untyped-def]
    flesh, vertices, normals, segments, parts, lens, size, columns, origins, intensity, k, result
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
        if visible[i]:
            # Somebody else is there.
            visible[i] = not np.isnan(sample(intensity, 0, pixels[i, 0], pixels[i, 1])[0])
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
        for c in range(3):
            result.colours[k, q, c] = sample(intensity, c, pixels[i, 0], pixels[i, 1])[0]
    result.counts[k] = taken
