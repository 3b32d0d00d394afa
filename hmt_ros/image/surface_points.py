"""Points of the body's surface that are visible at a pose, for flow and silhouette."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames
from hmt_ros.core import see_points
from hmt_ros.image.surface import flesh_table_of
from hmt_ros.inference.arrays import Array, Mask

Ints = NDArray[np.int64]


class SurfacePoints(NamedTuple):
    """Up to Q points on the visible surface of each of K poses.

    Attributes:
        counts: (K,) number of points of each pose; later entries in the pose's row are unused.
        segments: (K, Q) segments on which the points lie.
        local: (K, Q, 3) positions of the points in the frames of the segments, m.
        pixels: (K, Q, 2) projections of the points, px.
    """

    counts: Ints
    segments: Ints
    local: Array
    pixels: Array


def seen_points(
    body: Body, camera: Camera, frames: Frames, others: Mask | None = None, points: int = 120
) -> SurfacePoints:
    """Points of the surface visible at K poses.

    The points are spread evenly over the visible vertices of a coarse mesh; nothing is random.

    Args:
        body: body with flesh.
        camera: camera that sees the body.
        frames: frames of the K poses.
        others: (H, W) pixels that show or possibly show other people; None if missing.
        points: maximum number Q of points per pose.
    """
    k = frames.count
    mesh = coarse_mesh(body)
    result = SurfacePoints(
        np.zeros(k, np.int64),
        np.zeros((k, points), np.int64),
        np.zeros((k, points, 3)),
        np.zeros((k, points, 2)),
    )
    hidden = np.zeros((0, 0), np.bool_) if others is None else np.ascontiguousarray(others)
    see_points(
        flesh_table_of(body),
        (mesh.vertices, mesh.normals, mesh.segments, mesh.parts),
        (camera.lens, (camera.width, camera.height), hidden),
        *frames.by_pose(),
        *result,
    )
    return result


def coarse_mesh(body: Body) -> Mesh:
    """The coarse mesh of a body, whose vertices are candidate points."""
    return body.flesh.mesh(stacks=5, slices=10)
