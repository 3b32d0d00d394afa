"""Likelihood of image joints: squared distances to the projected joint centres (KJS 2 and 5.1)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.image.observation import Keypoints
from hmt_ros.image.surface import lens_of, project
from hmt_ros.image.terms.accumulation import Tree, add_residual, assemble_pose, tree_of
from hmt_ros.image.terms.robust_kernel import geman_mcclure

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
    precision = np.linalg.inv(keypoints.covariances[seen])
    precision *= keypoints.confidences[seen][:, None, None]
    whitener = np.linalg.cholesky(precision).transpose(0, 2, 1)  # W with W^T W = precision
    joints = _Joints(
        skeleton.joint_segments[which].astype(np.int64),
        skeleton.joint_offsets[which],
        keypoints.pixels[seen],
        np.ascontiguousarray(whitener),
    )
    n, d = frames.count, skeleton.dimension
    value, gradient, hessian = np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
    _add_joints(
        joints, _tree(skeleton), lens_of(camera), float(scale), float(weight), *frames.by_pose(),
        *frames.dofs_by_pose(), value, gradient, hessian,
    )  # fmt: skip
    return value, gradient, hessian


class _Joints(NamedTuple):
    """Keypoints as the compiled code reads them: (P,), (P, 3), (P, 2), (P, 2, 2)."""

    segments: NDArray[np.int64]
    offsets: Array
    pixels: Array
    whiteners: Array


@lru_cache(maxsize=64)
def _tree(skeleton: Skeleton) -> Tree:
    return tree_of(skeleton)


@njit(cache=True, nogil=True, error_model='numpy')
def _add_joints(  # type: ignore[no-untyped-def]
    joints, tree, lens, scale, weight, columns, origins, axes, dof_origins, value, gradient,
    hessian,
):  # fmt: skip
    """Adds energy, gradient and Hessian, pose by pose."""
    count = len(joints.segments)
    wrenches = np.empty((len(tree.parents), 6))
    stiffnesses = np.empty((len(tree.parents), 6, 6))
    pixels, projections = np.empty((1, 2)), np.empty((1, 2, 3))
    for n in range(len(value)):
        wrenches[:] = 0.0
        stiffnesses[:] = 0.0
        for k in range(count):
            s = joints.segments[k]
            x, y, z = origins[n, s, 0], origins[n, s, 1], origins[n, s, 2]
            for i in range(3):
                x += columns[n, s, i, 0] * joints.offsets[k, i]
                y += columns[n, s, i, 1] * joints.offsets[k, i]
                z += columns[n, s, i, 2] * joints.offsets[k, i]
            seen = project(lens, x, y, z, 0, pixels, projections)
            for i in range(2):
                residual, a0, a1, a2 = BEHIND, 0.0, 0.0, 0.0
                if seen:
                    w0, w1 = joints.whiteners[k, i, 0], joints.whiteners[k, i, 1]
                    residual = w0 * (pixels[0, 0] - joints.pixels[k, 0])
                    residual += w1 * (pixels[0, 1] - joints.pixels[k, 1])
                    a0 = w0 * projections[0, 0, 0] + w1 * projections[0, 1, 0]
                    a1 = w0 * projections[0, 0, 1] + w1 * projections[0, 1, 1]
                    a2 = w0 * projections[0, 0, 2] + w1 * projections[0, 1, 2]
                rho, pull, curvature = geman_mcclure(residual, scale, weight)
                value[n] += rho
                add_residual(wrenches, stiffnesses, s, x, y, z, a0, a1, a2, pull, curvature)
        assemble_pose(tree, axes[n], dof_origins[n], wrenches, stiffnesses, gradient[n], hessian[n])
