"""Keypoints: distances of projected joint centres from where joints were seen (KJS 2 and 5.1).

    E(x) = sum_k c_k w sum_a rho([W_k (u_k(x) - p_k)]_a),      W_k' W_k = S_k^-1

u_k projects the joint of keypoint k, which was seen at p_k with covariance S_k; a confidence c_k
below 1 divides the precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.image.surface import lens_of, project
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.residuals import add_residual, assemble_pose, geman_mcclure, tree_of
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy

KEYPOINTS = TermSettings(1.0, 1.0, 5.0)
# A joint behind the camera errs by this much, in standard deviations.
BEHIND = 1e3


@dataclass(frozen=True)
class Keypoints:
    """Image positions of joints, from any 2D detector or by hand.

    Attributes:
        names: (n,) joints of the body.
        pixels: (n, 2) column and row, px; NaN where a joint was not seen.
        covariances: (n, 2, 2) px^2.
        confidences: (n,) from 0, ignore, to 1, sure.
        positions: (n, 3) of a detector that lifts, m, along the axes of the camera from an origin
            that all share; NaN where there is none. None: it does not lift.
    """

    names: tuple[str, ...]
    pixels: Array
    covariances: Array
    confidences: Array
    positions: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.pixels.shape, self.covariances.shape, self.confidences.shape)
        if shapes != ((n, 2), (n, 2, 2), (n,)):
            raise ValueError(f'{n} keypoints with arrays of shapes {shapes}')
        if self.positions is not None and self.positions.shape != (n, 3):
            raise ValueError(f'{n} keypoints with positions of shape {self.positions.shape}')

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,) joints that have a position."""
        return np.asarray(np.isfinite(self.pixels).all(1), dtype=np.bool_)

    def __getitem__(self, which: Index) -> Keypoints:
        """Some of them."""
        names = tuple(self.names[i] for i in which)
        positions = None if self.positions is None else self.positions[which]
        return Keypoints(
            names, self.pixels[which], self.covariances[which], self.confidences[which], positions
        )

    def named_for(self, body: Body) -> tuple[Keypoints, list[str]]:
        """Those that are joints of a body, under the body's names, and the names of the others."""
        names = [body.keypoint_aliases.get(name, name) for name in self.names]
        strange = [name for name in names if name not in body.joint_names]
        # A joint that a detector names twice counts once.
        first = {name: i for i, name in reversed([*enumerate(names)]) if name not in strange}
        which = np.array(sorted(first.values()), dtype=np.intp)
        kept = self[which]
        return replace(kept, names=tuple(names[i] for i in which)), strange


@dataclass(frozen=True, eq=False)
class KeypointTerm:
    """Minus the log-likelihood of keypoints; a `FrameTerm`.

    Keypoints that were not seen (NaN) or have no confidence do not count.

    Attributes:
        skeleton, camera: who is seen by what.
        keypoints: that were seen.
        settings: weight w, factor on the standard deviations, and scale of the kernel; inf: least
            squares.

    Raises:
        KeyError: a keypoint that is not a joint of the body.
    """

    skeleton: Skeleton
    camera: Camera
    keypoints: Keypoints
    settings: TermSettings = KEYPOINTS

    def energy(
        self, frames: Frames, _rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `hmt_ros.body.pose_terms.FrameTerm`."""
        n, d = frames.count, self.skeleton.dimension
        poses = n if derivatives else 0
        value, gradient, hessian = np.zeros(n), np.zeros((poses, d)), np.zeros((poses, d, d))
        s = self.settings
        _add_joints(
            self._joints, tree_of(self.skeleton), lens_of(self.camera), float(s.scale),
            float(s.weight / s.sigma**2), *frames.by_pose(), *frames.dofs_by_pose(), value,
            gradient, hessian,
        )  # fmt: skip
        return Energy(value, gradient, hessian) if derivatives else Energy(value)

    def residuals(self, frames: Frames) -> tuple[Index, Array, Array, Array, Array]:
        """The residuals at the frames of one pose.

        Returns:
            (M,) joint of the skeleton, (M, 3) its position, (M, 3) derivative of the residual by
            the position, (M,) derivative and (M,) curvature of the energy by the residual; two
            residuals a keypoint. Joints behind the camera have none.
        """
        k, seen = self.keypoints, self._counted
        names = [name for name, ok in zip(k.names, seen, strict=True) if ok]
        joints = self.skeleton.joint_index(names)
        points = frames.joints()[joints, :, 0]
        pixels, projection = self.camera.project_with_derivative(points.T)
        shown = np.flatnonzero(np.isfinite(pixels).all(0))
        whiteners = self._joints.whiteners[shown]
        error = np.einsum('kab,kb->ka', whiteners, pixels.T[shown] - self._joints.pixels[shown])
        by_point = np.einsum('kab,bik->kai', whiteners, projection[..., shown])
        s = self.settings
        shrink = 1.0 / (1.0 + error**2 / s.scale**2)
        curvature = s.weight / s.sigma**2 * shrink**2
        return (
            np.repeat(joints[shown], 2),
            np.repeat(points[shown], 2, axis=0),
            by_point.reshape(-1, 3),
            (curvature * error).reshape(-1),
            curvature.reshape(-1),
        )

    @property
    def _counted(self) -> NDArray[np.bool_]:
        k = self.keypoints
        return np.asarray(k.seen & (k.confidences > 0), dtype=np.bool_)

    @cached_property
    def _joints(self) -> _Joints:
        k, skeleton = self.keypoints, self.skeleton
        seen = self._counted
        which = skeleton.joint_index([name for name, ok in zip(k.names, seen, strict=True) if ok])
        precision = np.linalg.inv(k.covariances[seen])
        precision *= k.confidences[seen][:, None, None]
        whitener = np.linalg.cholesky(precision).transpose(0, 2, 1)
        return _Joints(
            skeleton.joint_segments[which].astype(np.int64),
            skeleton.joint_offsets[which],
            k.pixels[seen],
            np.ascontiguousarray(whitener),
        )


class _Joints(NamedTuple):
    """Keypoints as the compiled code reads them: (P,), (P, 3), (P, 2), (P, 2, 2)."""

    segments: NDArray[np.int64]
    offsets: Array
    pixels: Array
    whiteners: Array


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
        if len(hessian) > 0:
            assemble_pose(
                tree, axes[n], dof_origins[n], wrenches, stiffnesses, gradient[n], hessian[n]
            )
