"""A focal length that is not calibrated, and the error of all depths that follows from it.

An image gives the directions of the joints, and lengths of the body their distance: a focal length
that is wrong by the factor 1 + e moves the person along the optical axis, and nothing else.

    z ~ f    =>    C = S + (s z)^2 e_z e_z'            e_z: the depth of the root

S is the covariance of a mode at depth z with the focal length as it is, s the relative standard
deviation of the focal length. It errs alike in all images, so that no number of them lessens it: it
is added to what is published, and enters no estimate (a consider covariance, [Schmidt 1966]).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.camera_file import camera_of_view

# Field of view of a common camera along the longer side of its images, degrees, and the relative
# standard deviation of the focal lengths of cameras that people use: 51 to 72 degrees.
USUAL_FOV, USUAL_SIGMA = 60.0, 0.2


def usual_camera(size: tuple[int, int], fov: float = USUAL_FOV) -> Camera:
    """A camera with a field of view, degrees, along the longer side of images of a size, px."""
    width, height = size
    return camera_of_view(size, fov) if width >= height else camera_of_view(size, vertical=fov)


def depth_covariances(poses: Array, sigma: float) -> Array:
    """Covariances (K, d, d) of poses (K, d) by the focal length, see the head of this file."""
    depth = np.arange(poses.shape[1]) == 2
    return np.multiply.outer((sigma * poses[:, 2]) ** 2, np.diag(depth).astype(np.float64))


def with_depth_error(mixture: GaussianMixture, sigma: float) -> GaussianMixture:
    """A mixture over poses in the frame of the camera, whose depths err with the focal length."""
    if sigma == 0.0:
        return mixture
    added = depth_covariances(mixture.means, sigma)
    return replace(mixture, covariances=mixture.covariances + added)
