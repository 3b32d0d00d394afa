"""Likelihood of image joints: squared distances to the projected joint centres (KJS 2 and 5.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames
from hmt_ros.image.observation import Keypoints
from hmt_ros.image.residuals import Energy, robust

Array = NDArray[np.float64]


def joint_energy(
    frames: Frames,
    camera: Camera,
    keypoints: Keypoints,
    *,
    scale: float = np.inf,
    weight: float = 1.0,
) -> Energy:
    """Energy of keypoints: residuals whitened by their covariances, one robust kernel a keypoint axis.

    Keypoints that were not seen (NaN) or have no confidence do not count; a confidence below 1
    divides the covariance.

    Raises:
        KeyError: a keypoint that is not a joint of the body.
    """
    skeleton = frames.skeleton
    seen = np.isfinite(keypoints.pixels).all(1) & (keypoints.confidences > 0)
    names = [name for name, ok in zip(keypoints.names, seen, strict=True) if ok]
    which = skeleton.joint_index(names)
    segments = skeleton.joint_segments[which]
    points = frames.points(segments, skeleton.joint_offsets[which])
    pixels, projection = camera.project_with_derivative(points.transpose(1, 0, 2))
    precision = np.linalg.inv(keypoints.covariances[seen])
    precision *= keypoints.confidences[seen][:, None, None]
    whitener = np.linalg.cholesky(precision).transpose(0, 2, 1)  # W with W^T W = precision
    error = pixels - keypoints.pixels[seen].T[:, :, None]
    residual = np.einsum('jab,bjn->ajn', whitener, error)
    directions = np.einsum('jab,bijn->ajin', whitener, projection)
    behind = ~np.isfinite(residual)
    residual = np.where(behind, 1e3, residual).reshape(-1, frames.count)
    directions = np.where(behind[:, :, None], 0.0, directions).reshape(-1, 3, frames.count)
    rho, pull, curvature = robust(residual, scale, weight)
    return Energy(
        rho.sum(0), np.tile(segments, 2), np.tile(points, (2, 1, 1)), directions, pull, curvature
    )
