"""Root position of a predicted posture, from the position and the size of the silhouette.

The shape of a silhouette does not show the depth, but its size relative to the posture does. The
root is moved until the exact projection of the posture's flesh has the bounding box of the
silhouette. The residual r(t) contains the sides of the flesh's box at root t minus the sides of the
silhouette's box. With J = dr/dt, the Gauss-Newton step is

    t <- t - (J' S^-1 J + P^-1)^-1 (J' S^-1 r + P^-1 (t - t_0)),   S = J_x C J_x' + noise

C is the covariance of the predicted posture, and J_x the derivative with respect to the posture, so
an arm of uncertain posture carries little information about the width. P is a wide prior. If the
border of the image cuts the person, that side only shows that the person reaches the border. The
root then depends on the other sides and on P, and its covariance is larger. A person may be larger
or smaller than the body, which scales all distances from the camera by the same factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera
from hmt_ros.body.camera import tangent
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames, forward, point_positions
from hmt_ros.core import elementary
from hmt_ros.experts.descriptor.contour import PersonBlob
from hmt_ros.experts.pose_encoding import PoseEncoding, cross
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import inverse, product, solve

STACKS, SLICES = 9, 12  # of the mesh, whose bounding box is exact to 1 % of the radius of a part
SIZE_SPREAD = 0.06  # relative standard deviation of people's size
CUT_SPREAD = 0.15  # additional deviation for a person who is cut by the border
# Standard deviations of a side of the box: from the outline, px; and from hair, clothes and shoes,
# relative to the longer side of the box.
OUTLINE_SIGMA, CLOTHES_SIGMA = 1.5, 0.02
# Prior standard deviations along and across the line of sight, relative to the distance.
DEPTH_SPREAD, ACROSS_SPREAD = 0.7, 1.0
MAX_STEPS = 10
# Step lengths relative to the depth: iterations end below the first; derivatives of the encoding
# are recomputed above the second; the third is the maximum.
STEP_TOLERANCE, RELINEARISATION_STEP, MAX_STEP = 1e-3, 0.05, 0.4


@dataclass(frozen=True, eq=False)
class RootPlacement:
    """Roots of M postures.

    Attributes:
        roots: (M, 3) in the camera frame, m.
        covariances: (M, 3, 3) for fixed postures, m^2.
        by_targets: (M, 3, D) derivatives of the roots with respect to the targets of the postures.
        jacobians: Derivatives of the encoding at the postures and their roots.
    """

    roots: Array
    covariances: Array
    by_targets: Array
    jacobians: tuple[Array, Array]


def place_roots(
    encoding: PoseEncoding,
    camera: Camera,
    place: PersonBlob,
    targets: Array,
    covariances: Array,
    *,
    size_spread: float = SIZE_SPREAD,
) -> RootPlacement:
    """Place the roots of postures predicted from a silhouette.

    Args:
        targets: (M, D) predicted targets.
        covariances: (M, D, D) covariances of the prediction.
        size_spread: Relative standard deviation of the person's size; 0 if the body has the
            person's lengths.

    Raises:
        ValueError: the body has no flesh.
    """
    body = encoding.body
    if not body.shapes:
        raise ValueError(f'body {body.name} has no flesh: its size in an image is not known')
    mesh = _mesh(body)
    sides = np.array(place.box)
    cut = np.array(place.cut)
    noise = OUTLINE_SIGMA**2 + (CLOTHES_SIGMA * max(sides[2] - sides[0], sides[3] - sides[1])) ** 2
    roots = _first_roots(encoding, camera, sides, targets)
    start, prior = roots.copy(), _prior(roots)
    nearest = 1.05 * body.lower[2]

    def linearised(slopes: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        """r, J and J_x at the roots, and J' S^-1."""
        residual, by_root, by_target = _box_error(
            encoding, mesh, camera, targets, roots, slopes, sides, cut
        )
        spread = product(
            product(by_target, covariances), by_target.transpose(0, 2, 1)
        ) + noise * np.eye(4)
        return residual, by_root, by_target, solve(spread, by_root).transpose(0, 2, 1)

    slopes = encoding.jacobians(targets, roots)
    for _ in range(MAX_STEPS):
        residual, by_root, _, weighted = linearised(slopes)
        pull = product(weighted, residual[..., None]) + product(prior, (roots - start)[..., None])
        step = -solve(product(weighted, by_root) + prior, pull)[..., 0]
        depth = roots[:, 2]
        share = np.linalg.norm(step, axis=1) / depth
        step *= np.minimum(1.0, MAX_STEP / np.maximum(share, 1e-12))[:, None]
        roots = roots + step
        roots[:, 2] = np.maximum(roots[:, 2], nearest)
        if share.max() < STEP_TOLERANCE:
            break
        if share.max() > RELINEARISATION_STEP:
            slopes = encoding.jacobians(targets, roots)
    slopes = encoding.jacobians(targets, roots)
    _, by_root, by_target, weighted = linearised(slopes)
    gain = solve(product(weighted, by_root) + prior, weighted)  # (M, 3, 4)
    left = np.eye(3) - product(gain, by_root)
    own = product(noise * gain, gain.transpose(0, 2, 1))
    own += product(product(left, inverse(prior)), left.transpose(0, 2, 1))
    relative = size_spread**2 + (CUT_SPREAD**2 if cut.any() else 0.0)
    own += relative * roots[:, :, None] * roots[:, None, :]
    return RootPlacement(roots, own, product(-gain, by_target), slopes)


def placed_gaussians(
    encoding: PoseEncoding, targets: Array, covariances: Array, placement: RootPlacement
) -> tuple[Array, Array]:
    """Convert Gaussians over targets and roots to Gaussians over poses, (M, d) and (M, d, d).

    If the posture varies, the root moves so that the projected box still equals the silhouette's
    box.

    Args:
        targets, covariances: (M, D), (M, D, D) Gaussians over the targets of the postures.
    """
    by_target, by_root = placement.jacobians
    whole = by_target + product(by_root, placement.by_targets)
    result = product(product(whole, covariances), whole.transpose(0, 2, 1))
    result += product(product(by_root, placement.covariances), by_root.transpose(0, 2, 1))
    means = encoding.decode(targets, placement.roots)
    return means, 0.5 * (result + result.transpose(0, 2, 1))


@lru_cache(maxsize=8)
def _mesh(body: Body) -> Mesh:
    return body.flesh.mesh(STACKS, SLICES)


def _first_roots(encoding: PoseEncoding, camera: Camera, sides: Array, targets: Array) -> Array:
    """Initial roots (M, 3): on the ray through the box centre, at a depth from the diagonal."""
    left, top, right, bottom = sides
    middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
    ray, first, second = camera.rays(np.array([middle, [left, top], [right, bottom]]))
    angle = elementary.arccos(np.clip(product(first, second), -1.0, 1.0))
    away = np.tile([[0.0, 0.0, 10.0]], (len(targets), 1))
    joints = encoding.body.joint_positions(encoding.decode(targets, away))[..., :2]
    extent = np.linalg.norm(joints.max(1) - joints.min(1), axis=1) + 0.2 * encoding.body.scale
    depth = 0.5 * extent / tangent(0.5 * max(float(angle), 1e-3))
    depth = np.clip(depth, 2.0 * encoding.body.lower[2], 0.9 * encoding.body.upper[2])
    return np.asarray(depth[:, None] * ray / max(float(ray[2]), 0.1))


def _prior(roots: Array) -> Array:
    """Precisions (M, 3, 3) of the prior of the roots."""
    distance = np.linalg.norm(roots, axis=1)
    along = roots / distance[:, None]
    outer = along[:, :, None] * along[:, None, :]
    spread = np.array([DEPTH_SPREAD, ACROSS_SPREAD])[:, None] * distance
    weights = 1.0 / (spread * spread)
    result: Array = weights[0][:, None, None] * outer
    result += weights[1][:, None, None] * (np.eye(3) - outer)
    return result


def _box_error(
    encoding: PoseEncoding,
    mesh: Mesh,
    camera: Camera,
    targets: Array,
    roots: Array,
    slopes: tuple[Array, Array],
    sides: Array,
    cut: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """Sides of the boxes of M postures minus the sides of the silhouette's box, and derivatives.

    `slopes` are the Jacobians of the encoding near these postures and roots.

    Returns:
        residuals (M, 4), derivatives with respect to roots (M, 4, 3) and to targets (M, 4, D).
    """
    poses = encoding.decode(targets, roots)
    by_target, by_root = slopes
    skeleton = encoding.body.skeleton
    points = point_positions(skeleton, poses, mesh.segments, mesh.vertices)  # (M, V, 3)
    points[..., 2] = np.maximum(points[..., 2], 0.05)  # a hand may be behind the camera
    seen = camera.project(points)
    outermost = np.concatenate([seen.argmin(1), seen.argmax(1)], axis=1)  # (M, 4)
    rows = np.arange(len(poses))[:, None]
    chosen = points[rows, outermost]  # (M, 4, 3)
    pixels, by_point = camera.project_with_derivative(chosen.transpose(2, 0, 1))
    coordinate = np.array([0, 1, 0, 1])
    # From pixels (2, M, 4) and by_point (2, 3, M, 4), select the coordinate that each side bounds.
    value = np.stack([pixels[c, :, k] for k, c in enumerate(coordinate)], axis=1)
    slope = np.stack([by_point[c, :, :, k].T for k, c in enumerate(coordinate)], axis=1)
    by_pose = np.einsum(
        'mkc,mkdc->mkd', slope, _by_pose(forward(skeleton, poses), mesh, outermost, chosen)
    )
    residual = value - sides
    # The person reaches the border of the image; how far beyond is unknown.
    outwards = np.array([-1.0, -1.0, 1.0, 1.0])
    unknown = cut & (residual * outwards >= 0)
    residual[unknown] = 0.0
    by_pose[unknown] = 0.0
    return residual, product(by_pose, by_root), product(by_pose, by_target)


def _by_pose(frames: Frames, mesh: Mesh, vertices: Index, points: Array) -> Array:
    """Derivatives (M, 4, d, 3) of points (M, 4, 3), at given vertices, with respect to poses."""
    skeleton = frames.skeleton
    axes, origins = frames.dofs_by_pose()  # (M, d, 3)
    arm = points[:, :, None] - origins[:, None]
    turning = cross(axes[:, None], arm)
    moved = np.where(skeleton.dof_is_rotation[:, None], turning, axes[:, None])
    return moved * skeleton.moves[mesh.segments[vertices]][..., None]
