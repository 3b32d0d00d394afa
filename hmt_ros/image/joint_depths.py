"""Depths of joints with known pixels from a depth image, for the start of a track.

A joint lies behind the skin at its pixel, at a distance of approximately the flesh's radius there:

    z_j = D(u_j) + r_j +- sigma_j,   sigma_j^2 = (r_j / 2)^2 + DEPTH_SIGMA^2

D is a low quantile of the depths around the pixel, because limbs are thin and the background is
behind them. A robust kernel is used, because depths of an object in front of the joint or of a
neighbouring surface are outliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.core import elementary
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.terms.depth import usable_depths
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Index

# Margin of the window around the pixel of a joint, px, and quantile of the depths in this window.
MASK_MARGIN, DEPTH_QUANTILE = 2, 0.25
# Standard deviation of a joint's depth without the error of the flesh, m.
DEPTH_SIGMA = 0.03
# Width of the Geman-McClure kernel, in standard deviations.
KERNEL_SCALE = 4.0
# Minimum number of trunk points with measured depth to locate a person.
MIN_JOINTS = 3
# Quantile of the depths of trunk points, below the median because the background is farther away,
# and number of iterations.
TRUNK_QUANTILE, ITERATIONS = 0.35, 2


def depths_of(depth: NDArray[np.floating] | None) -> ImageMap | None:
    """A depth image (H, W), m, as an `ImageMap`; None if no pixel was measured."""
    if depth is None:
        return None
    usable = usable_depths(depth)
    return ImageMap(usable[None]) if usable.any() else None


@dataclass(frozen=True, eq=False)
class JointDepths:
    """Depths of some joints from a depth image.

    Attributes:
        joints: (M,) joints of the skeleton.
        depths: (M,) depths along the axis of the camera, m.
        sigma: (M,) standard deviations of the depths, m.
    """

    joints: Index
    depths: Array
    sigma: Array

    def residuals(self, depths: Array) -> tuple[Array, Array, Array]:
        """Energies (M,) of joint depths (M,), m, and the energies' derivatives and curvatures."""
        error = (depths - self.depths) / self.sigma
        shrink = 1.0 / (1.0 + (error / KERNEL_SCALE) ** 2)
        curvature = shrink**2 / self.sigma**2
        return 0.5 * error**2 * shrink, curvature * (depths - self.depths), curvature


def joint_depths(body: Body, keypoints: Keypoints, depths: ImageMap | None) -> JointDepths:
    """Depths of the joints at seen keypoints for which the depth image has measurements."""
    shown = np.flatnonzero(keypoints.seen) if depths is not None else np.zeros(0, np.intp)
    joints = body.skeleton.joint_index([keypoints.names[i] for i in shown])
    radii = _radii(body)[joints] if len(shown) else np.zeros(0)
    skin = np.zeros(0) if depths is None else _depths_at(depths, keypoints.pixels[shown])
    known = skin > 0
    sigma = elementary.hypot(0.5 * radii, DEPTH_SIGMA)
    return JointDepths(joints[known], (skin + radii)[known], sigma[known])


def moved_to_depth(body: Body, camera: Camera, poses: Array, depths: ImageMap | None) -> Array:
    """Moves poses (N, d) along their rays to the measured depths of their trunks.

    A pose with too few measurements does not move.
    """
    names = [name for pair in body.trunk_pairs for name in pair]
    if depths is None or not names:
        return poses
    index = body.skeleton.joint_index(names)
    radii = np.tile(_radii(body)[index], 2)
    result = poses.copy()
    for _ in range(ITERATIONS):
        joints = body.joint_positions(result)[:, index]
        # If a pose is too near, its joints may project beside the person; points nearer the middle
        # do not.
        inside = 0.5 * (joints + joints.mean(1, keepdims=True))
        for pose, points in zip(result, np.concatenate([joints, inside], axis=1), strict=True):
            skin = _depths_at(depths, camera.project(points))
            known = skin > 0
            if known.sum() >= MIN_JOINTS:
                further = np.quantile((skin + radii - points[:, 2])[known], TRUNK_QUANTILE)
                pose[:3] *= max(1.0 + float(further) / pose[2], 0.1)
    return result


def _depths_at(depths: ImageMap, pixels: Array) -> Array:
    """Depths (P,) of the nearest surface around pixels (P, 2), m; 0 where nothing was measured."""
    values = depths.values[0]
    height, width = values.shape
    steps = np.arange(-MASK_MARGIN, MASK_MARGIN + 1)
    # Clip pixels of points that are far outside the image or behind the camera; they stay outside.
    centres = np.clip(np.nan_to_num(pixels, nan=-1e6), -1e6, 1e6)
    columns, rows = (np.rint(centres) - [depths.left, depths.top]).astype(np.intp).T
    rows = (rows[:, None, None] + steps[:, None]).repeat(len(steps), axis=2)
    columns = (columns[:, None, None] + steps).repeat(len(steps), axis=1)
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    near = values[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    near = np.where(inside & (near > 0), near, np.inf).reshape(len(pixels), -1)
    known = np.isfinite(near).sum(1)
    chosen = np.maximum(np.rint(DEPTH_QUANTILE * (known - 1)).astype(np.intp), 0)
    found = np.sort(near, axis=1)[np.arange(len(pixels)), chosen]
    return np.where(known > 0, found, 0.0).astype(np.float64)


def _radii(body: Body) -> Array:
    """Radius (J,) of the flesh at each joint, from the nearest ring of the body at rest."""
    rings, parts = body.flesh.rings, body.flesh.ring_parts
    if not len(parts):
        return np.zeros(len(body.joint_names))
    frames = forward(body.skeleton, np.zeros((1, body.dimension)))
    segments = np.array([part.segment for part in body.flesh.parts])[parts]
    centres = frames.points(segments, rings.centre)[..., 0]
    joints = frames.joints()[..., 0]
    nearest = np.linalg.norm(joints[:, None] - centres, axis=2).argmin(1)
    result: Array = rings.radius[nearest].mean(1)
    return result
