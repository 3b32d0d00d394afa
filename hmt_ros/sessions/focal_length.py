"""Error of the depth of a person due to an uncalibrated focal length.

An image gives the directions of the joints, and the lengths of the body give their distances.
Therefore a focal length that is wrong by a factor 1 + e only moves the person along the optical
axis.

    z ~ f    =>    C = S + (s z)^2 e_z e_z'            e_z: the depth of the root

S is the covariance of a mode at depth z for the assumed focal length, and s is the relative
standard deviation of the focal length. The error is the same in all images, so that more images do
not reduce it. It is therefore added to published covariances, but does not enter any estimate (a
consider covariance, [Schmidt 1966]).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.camera_file import camera_of_view

# Field of view of common cameras along the longer side of the image, degrees, and relative standard
# deviation of their focal lengths, which corresponds to fields of view of 51 to 72 degrees.
USUAL_FOV, USUAL_SIGMA = 60.0, 0.2


def usual_camera(size: tuple[int, int], fov: float = USUAL_FOV) -> Camera:
    """Return a camera with a field of view, degrees, along the longer side of an image, px."""
    width, height = size
    return camera_of_view(size, fov) if width >= height else camera_of_view(size, vertical=fov)


def depth_covariances(poses: Array, sigma: float) -> Array:
    """Return the covariances (K, d, d) of poses (K, d) due to the error of the focal length."""
    depth = np.arange(poses.shape[1]) == 2
    return np.multiply.outer((sigma * poses[:, 2]) ** 2, np.diag(depth).astype(np.float64))


def with_depth_error(mixture: GaussianMixture, sigma: float) -> GaussianMixture:
    """Add the depth error of the focal length to a mixture over poses in the camera frame."""
    if sigma == 0.0:
        return mixture
    added = depth_covariances(mixture.means, sigma)
    return replace(mixture, covariances=mixture.covariances + added)
