"""Texture of the body's surface, taken from an image at a pose and looked up at another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import visibility

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# A surface that faces the camera less than this (cosine) is seen too flat to carry a texture.
FACING = 0.3


@dataclass(frozen=True, eq=False)
class Textures:
    """Q points on the visible surface of each of K poses.

    Attributes:
        segments: (K, Q).
        local: (K, Q, 3) places in the frames of the segments, m.
        pixels: (K, 2, Q) where they were seen.
        colours: (K, 3, Q) what was seen there.
        weights: (K, Q) 1, or 0 for points that are missing.
    """

    segments: Index
    local: Array
    pixels: Array
    colours: Array
    weights: Array

    def __len__(self) -> int:
        return len(self.segments)

    def __getitem__(self, index: Index) -> Textures:
        return Textures(
            self.segments[index],
            self.local[index],
            self.pixels[index],
            self.colours[index],
            self.weights[index],
        )


def capture_textures(
    body: Body, camera: Camera, frames: Frames, intensity: ImageMap, points: int = 120
) -> Textures:
    """Textures of the surface visible at K poses.

    The points are spread evenly over the visible vertices of a coarse mesh, the same way every time.
    """
    mesh = body.flesh.mesh(stacks=5, slices=10)
    places = frames.points(mesh.segments, mesh.vertices)
    normals = frames.directions(mesh.segments, mesh.normals)
    distance = np.sqrt((places * places).sum(1))
    facing = -(places * normals).sum(1) > FACING * distance
    _, hidden = visibility(body, frames, places, mesh.parts)
    pixels = camera.project(places.transpose(0, 2, 1)).transpose(2, 0, 1)  # (2, V, K)
    inside = (pixels[0] >= 0) & (pixels[0] < camera.width)
    inside &= (pixels[1] >= 0) & (pixels[1] < camera.height)
    visible = facing & ~hidden & inside
    k = frames.count
    chosen = np.zeros((k, points), dtype=np.intp)
    weights = np.zeros((k, points))
    for i in range(k):
        seen = np.flatnonzero(visible[:, i])
        if len(seen) > points:
            seen = seen[(np.arange(points) * len(seen)) // points]
        chosen[i, : len(seen)] = seen
        weights[i, : len(seen)] = 1.0
    rows = np.arange(k)[:, None]
    uv = np.nan_to_num(pixels.transpose(2, 0, 1)[rows, :, chosen].transpose(0, 2, 1))
    at = np.broadcast_to(uv[:, None], (k, 3, *uv.shape[1:])).transpose(2, 0, 1, 3)
    colours, _ = intensity.sample(at, np.arange(3)[:, None])
    return Textures(mesh.segments[chosen], mesh.vertices[chosen], uv, colours, weights)
