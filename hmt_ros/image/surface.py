"""The body's occluding contour in the image, and which parts of it can be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Contour, occluding_contour
from hmt_ros.body.kinematics import Frames

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Parts are grown by this factor when they hide others: superquadrics are fatter than ellipsoids.
COVER = 1.04
# A point this much behind the front of another part, relative to its distance, is hidden by it.
HIDDEN = 0.004


@dataclass(frozen=True, eq=False)
class Surface:
    """Occluding contours of N poses in the image.

    Attributes:
        contour: in space.
        pixels: (2, P, N); NaN behind the camera.
        projection: (2, 3, P, N) derivative of the pixels with respect to the points.
        normals: (2, P, N) unit vectors out of the body, in the image.
        valid: (P, N) the contour exists there and lies in front of the camera.
        covered: (P, N) another part lies on the same ray, before or behind.
        hidden: (P, N) another part lies on the same ray, before.
    """

    contour: Contour
    pixels: Array
    projection: Array
    normals: Array
    valid: Mask
    covered: Mask
    hidden: Mask


def project_surface(body: Body, camera: Camera, frames: Frames) -> Surface:
    """Contours of the body's flesh at the frames of N poses."""
    contour = occluding_contour(body.flesh, frames)
    pixels, projection = camera.project_with_derivative(contour.points.transpose(1, 0, 2))
    valid = contour.exists & np.isfinite(pixels[0])
    # The normal of the contour is perpendicular to the ray: only its image part matters.
    normals = np.stack([contour.normals[:, 0] / camera.fx, contour.normals[:, 1] / camera.fy])
    normals /= np.maximum(np.hypot(normals[0], normals[1]), 1e-12)
    covered, hidden = visibility(body, frames, contour.points, contour.parts)
    return Surface(contour, pixels, projection, normals, valid, covered, hidden)


def visibility(body: Body, frames: Frames, points: Array, parts: Index) -> tuple[Mask, Mask]:
    """Whether other parts lie on the rays to points, and whether before them.

    Every part counts as its ellipsoid |A (x - c)| = 1. On the ray t p it is entered at
    t = (m.k - sqrt((m.k)^2 - m.m (k.k - 1))) / m.m with m = A p, k = A c.

    Args:
        body: the body.
        frames: of N poses.
        points: (P, 3, N) camera frame, m.
        parts: (P,) part that each point belongs to, which does not hide it.

    Returns:
        covered (P, N) and hidden (P, N).
    """
    flesh = body.flesh
    segments = np.array([p.segment for p in flesh.parts])
    radii = COVER * np.array([p.radii for p in flesh.parts])
    centres = np.array([p.centre for p in flesh.parts])
    n = frames.count
    where = frames.points(segments, centres)  # (S, 3, N)
    scaled = frames.columns[segments] / radii[:, :, None, None]  # (S, 3 axes, 3, N)
    k = np.einsum('sixn,sxn->nsi', scaled, where)
    shape = np.ascontiguousarray(scaled.reshape(-1, 3, n).transpose(2, 0, 1))
    m = shape @ np.ascontiguousarray(points.transpose(2, 1, 0))  # (N, 3S, P)
    m = m.reshape(n, len(segments), 3, -1)
    mm = m[:, :, 0] ** 2
    mm += m[:, :, 1] ** 2
    mm += m[:, :, 2] ** 2
    mk = m[:, :, 0] * k[:, :, 0, None]
    mk += m[:, :, 1] * k[:, :, 1, None]
    mk += m[:, :, 2] * k[:, :, 2, None]
    outside = (k * k).sum(2)[:, :, None] - 1.0
    discriminant = mk * mk - mm * outside
    own = np.arange(len(segments))[:, None] == parts
    through = (discriminant > 0) & ~own
    root = np.sqrt(np.maximum(discriminant, 0.0))
    before = through & (mk - root < (1.0 - HIDDEN) * mm)
    return through.any(1).T, before.any(1).T
