"""Likelihood of image joints: squared distances to the projected joint centres (KJS 2 and 5.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, assemble, segment_sums
from hmt_ros.image.observation import Keypoints

Array = NDArray[np.float64]

# A joint behind the camera errs by this much, in standard deviations.
BEHIND = 1e3


def joint_energy(
    frames: Frames, camera: Camera, keypoints: Keypoints, *, scale: float, weight: float
) -> tuple[Array, Array, Array]:
    """Energy (N,), gradient (N, d) and Gauss-Newton Hessian (N, d, d) of keypoints.

    Residuals are whitened by the covariances of the keypoints, with one Geman-McClure kernel an
    axis. Keypoints that were not seen (NaN) or have no confidence do not count; a confidence below
    1 divides the precision.

    Args:
        frames: of N poses.
        camera: that looks.
        keypoints: the joints.
        scale: of the kernel, in standard deviations; inf: least squares.
        weight: factor on the energy.

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
    residual = np.einsum('jab,bjn->ajn', whitener, error).reshape(-1, frames.count)
    directions = np.einsum('jab,bijn->ajin', whitener, projection).reshape(-1, 3, frames.count)
    behind = ~np.isfinite(residual)
    residual = np.where(behind, BEHIND, residual)
    directions = np.where(behind[:, None], 0.0, directions)
    square = residual * residual
    shrink = 1.0 / (1.0 + square / (scale * scale))
    curvature = weight * shrink * shrink
    sums = segment_sums(
        np.tile(segments, 2),
        np.tile(points, (2, 1, 1)),
        directions,
        curvature * residual,
        curvature,
        len(skeleton.parents),
    )
    return 0.5 * weight * (square * shrink).sum(0), *assemble(frames, *sums)
