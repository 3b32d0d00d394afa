"""Likelihood of intensities and of motion along the surface (KJS 2).

The model carries the texture of the last accepted image. The intensity term compares it with the
present image; the motion term compares where the texture has moved with the optical flow, which says
the same to first order but reaches further.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames
from hmt_ros.image.residuals import Energy, robust
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.texture import Textures

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def intensity_energy(
    frames: Frames,
    camera: Camera,
    textures: Textures,
    which: Index,
    intensity: ImageMap,
    *,
    sigma: float,
    scale: float,
    weight: float,
) -> Energy:
    """Energy of the difference in colour between the texture and the image under it.

    Args:
        frames: of N poses.
        camera: that looks.
        textures: of the poses that the N descend from.
        which: (N,) the texture that each pose carries.
        intensity: the blurred image, three channels.
        sigma: standard deviation of a difference in colour, grey levels.
        scale: of the robust kernel, in sigmas.
        weight: total weight of all points.
    """
    segments, points, pixels, projection, each = _project(frames, camera, textures, which, weight)
    at = np.broadcast_to(pixels[:, None], (2, 3, *pixels.shape[1:]))
    value, slope = intensity.sample(at, np.arange(3)[:, None, None])  # (3, Q, N), (2, 3, Q, N)
    error = (value - textures.colours[which].transpose(1, 2, 0)) / sigma
    length = np.sqrt((error * error).sum(0))
    rho, _, curvature = robust(length, scale, each)
    slope = slope / sigma
    gradient = np.einsum('cqn,acqn->aqn', error, slope)
    hessian = np.einsum('acqn,bcqn->abqn', slope, slope)
    return _from_pixels(rho, segments, points, projection, gradient, hessian, curvature)


def motion_energy(
    frames: Frames,
    camera: Camera,
    textures: Textures,
    which: Index,
    flow: ImageMap,
    *,
    sigma: float,
    scale: float,
    weight: float,
) -> Energy:
    """Energy of the difference between the motion of the texture in the image and the optical flow.

    Args:
        frames: of N poses.
        camera: that looks.
        textures: of the poses that the N descend from.
        which: (N,) the texture that each pose carries.
        flow: from the last image to this one, two channels, px.
        sigma: standard deviation of the flow, px; larger displacements have a larger one.
        scale: of the robust kernel, in sigmas.
        weight: total weight of all points.
    """
    segments, points, pixels, projection, each = _project(frames, camera, textures, which, weight)
    at = np.broadcast_to(
        textures.pixels.transpose(1, 0, 2)[:, None], (2, 2, *textures.weights.shape)
    )
    moved, _ = flow.sample(at, np.arange(2)[:, None, None])  # (2, K, Q)
    spread = sigma + 0.15 * np.hypot(moved[0], moved[1])
    target = textures.pixels.transpose(1, 0, 2) + moved
    error = (pixels - target[:, which].transpose(0, 2, 1)) / spread[which].T
    length = np.sqrt((error * error).sum(0))
    rho, _, curvature = robust(length, scale, each)
    per_pixel = 1.0 / spread[which].T
    hessian = np.zeros((2, 2, *length.shape))
    hessian[0, 0] = hessian[1, 1] = per_pixel**2
    return _from_pixels(rho, segments, points, projection, error * per_pixel, hessian, curvature)


def _project(
    frames: Frames, camera: Camera, textures: Textures, which: Index, weight: float
) -> tuple[Index, Array, Array, Array, Array]:
    segments = textures.segments[which].T  # (Q, N)
    local = textures.local[which].transpose(1, 2, 0)
    batch = np.arange(frames.count)
    columns = frames.columns[segments, :, :, batch]  # (Q, N, 3, 3)
    points = np.einsum('qnix,qin->qxn', columns, local)
    points += frames.origins[segments, :, batch].transpose(0, 2, 1)
    pixels, projection = camera.project_with_derivative(points.transpose(1, 0, 2))
    present = textures.weights[which].T * np.isfinite(pixels[0])
    each = weight * present / np.maximum(present.sum(0), 20.0)
    return segments, points, np.nan_to_num(pixels), np.nan_to_num(projection), each


def _from_pixels(
    rho: Array,
    segments: Index,
    points: Array,
    projection: Array,
    gradient: Array,
    hessian: Array,
    curvature: Array,
) -> Energy:
    """An energy given by its gradient and Hessian over pixel positions, as two residuals a point.

    With the Hessian G = L L^T the residuals have the directions of the rows of L^T and the pulls
    L^-1 g, so that both are met exactly.
    """
    eps = 1e-9
    l11 = np.sqrt(hessian[0, 0] + eps)
    l21 = hessian[0, 1] / l11
    l22 = np.sqrt(np.maximum(hessian[1, 1] - l21 * l21, 0.0) + eps)
    first = gradient[0] / l11
    second = (gradient[1] - l21 * first) / l22
    along = l11 * projection[0] + l21 * projection[1]  # (3, Q, N)
    across = l22 * projection[1]
    return Energy(
        rho.sum(0),
        np.tile(segments, (2, 1)),
        np.tile(points, (2, 1, 1)),
        np.concatenate([along.transpose(1, 0, 2), across.transpose(1, 0, 2)]),
        np.concatenate([curvature * first, curvature * second]),
        np.concatenate([curvature, curvature]),
    )
