"""Where the root of a predicted posture is, from the place and the size of the silhouette.

The look of a silhouette says nothing of depth; its size against that of the posture does. The root
is moved until the flesh of the posture, projected exactly, has the box of the silhouette:

    r(t) = sides of the box of the flesh at root t, minus those seen,
    t <- t - (J' S^-1 J + P^-1)^-1 (J' S^-1 r + P^-1 (t - t_0)),   S = J_x C J_x' + noise,

Gauss-Newton with J = dr/dt. C is the covariance of the predicted posture: an arm that may as well
hang says little about the width. P is wide. A side at which the border of the image cuts the
person only says that the person reaches it; the root then depends more on the other sides and on
P, and its covariance is widened. The person may be larger or smaller than the body, which stretches
all distances from the camera alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.experts.descriptor.silhouette_descriptor import PlaceAndSize
from hmt_ros.experts.pose_encoding import PoseEncoding

Array = NDArray[np.float64]
Index = NDArray[np.intp]

STACKS, SLICES = 9, 12  # of the mesh whose box is taken: within 1 % of the radius of a part
SIZE_SPREAD = 0.06  # relative, of persons' sizes against the body's
CUT_SPREAD = 0.15  # the same, of what the rest of a person says who is cut
# Of a side of the box: noise of the outline, px, and what hair, clothes and shoes add, as a share
# of the longer side of the box.
OUTLINE_SIGMA, CLOTHES = 1.5, 0.02
# Relative deviation of the depth, and of the place across in units of depth, before the box counts.
DEPTH_SPREAD, ACROSS_SPREAD = 0.7, 1.0
STEPS = 10
DONE = 1e-3  # relative to the depth
TURNED = 0.05  # share of the depth: a step that turns the line of sight this far, as an angle
LONGEST_STEP = 0.4  # shares of the depth


@dataclass(frozen=True, eq=False)
class RootPlacement:
    """Places of the roots of M postures.

    Attributes:
        roots: (M, 3) camera frame, m.
        covariances: (M, 3, 3) with the postures as they are, m^2.
        by_targets: (M, 3, D) derivatives of the roots by the targets of the postures.
        misfits: (M,) root mean squared distance between the sides of the boxes, px; of sides that
            are cut what is missing.
        cut: whether the border of the image cuts the person, so that the depth is a guess at best.
        jacobians: of the encoding at the postures and their roots.
    """

    roots: Array
    covariances: Array
    by_targets: Array
    misfits: Array
    cut: bool
    jacobians: tuple[Array, Array]


def place_roots(
    encoding: PoseEncoding,
    camera: Camera,
    place: PlaceAndSize,
    targets: Array,
    covariances: Array,
    *,
    size_spread: float = SIZE_SPREAD,
) -> RootPlacement:
    """Places of the roots of postures that a silhouette may be of.

    Args:
        encoding: of the body, with flesh.
        camera: that saw the silhouette.
        place: of the silhouette.
        targets: (M, D) predicted.
        covariances: (M, D, D) of the prediction.
        size_spread: relative standard deviation of the person's size; 0 where the lengths of the
            body are those of the person.

    Raises:
        ValueError: a body without flesh.
    """
    body = encoding.body
    if not body.shapes:
        raise ValueError(f'body {body.name} has no flesh: its size in an image is not known')
    mesh = _mesh(body)
    sides = np.array(place.box)
    cut = np.array(place.cut)
    noise = OUTLINE_SIGMA**2 + (CLOTHES * max(sides[2] - sides[0], sides[3] - sides[1])) ** 2
    roots = _first_roots(encoding, camera, sides, targets)
    start, prior = roots.copy(), _prior(roots)
    nearest = 1.05 * body.lower[2]
    slopes = encoding.jacobians(targets, roots)
    for _ in range(STEPS):
        residual, by_root, by_target = _box_error(
            encoding, mesh, camera, targets, roots, slopes, sides, cut
        )
        spread = by_target @ covariances @ by_target.transpose(0, 2, 1) + noise * np.eye(4)
        weighted = np.linalg.solve(spread, by_root).transpose(0, 2, 1)
        precision = weighted @ by_root + prior
        pull = weighted @ residual[..., None] + prior @ (roots - start)[..., None]
        step = -np.linalg.solve(precision, pull)[..., 0]
        depth = roots[:, 2]
        share = np.linalg.norm(step, axis=1) / depth
        step *= np.minimum(1.0, LONGEST_STEP / np.maximum(share, 1e-12))[:, None]
        roots = roots + step
        roots[:, 2] = np.maximum(roots[:, 2], nearest)
        if share.max() < DONE:
            break
        if share.max() > TURNED:
            slopes = encoding.jacobians(targets, roots)
    slopes = encoding.jacobians(targets, roots)
    residual, by_root, by_target = _box_error(
        encoding, mesh, camera, targets, roots, slopes, sides, cut
    )
    spread = by_target @ covariances @ by_target.transpose(0, 2, 1) + noise * np.eye(4)
    weighted = np.linalg.solve(spread, by_root).transpose(0, 2, 1)
    gain = np.linalg.solve(weighted @ by_root + prior, weighted)  # (M, 3, 4)
    left = np.eye(3) - gain @ by_root
    own = noise * gain @ gain.transpose(0, 2, 1)
    own += left @ np.linalg.inv(prior) @ left.transpose(0, 2, 1)
    relative = size_spread**2 + (CUT_SPREAD**2 if cut.any() else 0.0)
    own += relative * roots[:, :, None] * roots[:, None, :]
    misfits = np.sqrt((residual**2).mean(1))
    return RootPlacement(roots, own, -gain @ by_target, misfits, bool(cut.any()), slopes)


def placed_gaussians(
    encoding: PoseEncoding, targets: Array, covariances: Array, placement: RootPlacement
) -> tuple[Array, Array]:
    """Gaussians over poses, (M, d) and (M, d, d), of postures that were placed.

    The root follows the posture: another posture would be placed where its box is the one seen.

    Args:
        encoding: of the body.
        targets, covariances: (M, D), (M, D, D) of the postures.
        placement: of the same postures.
    """
    by_target, by_root = placement.jacobians
    whole = by_target + by_root @ placement.by_targets
    result = whole @ covariances @ whole.transpose(0, 2, 1)
    result += by_root @ placement.covariances @ by_root.transpose(0, 2, 1)
    means = encoding.decode(targets, placement.roots)
    return means, 0.5 * (result + result.transpose(0, 2, 1))


@lru_cache(maxsize=8)
def _mesh(body: Body) -> Mesh:
    return body.flesh.mesh(STACKS, SLICES)


def _first_roots(encoding: PoseEncoding, camera: Camera, sides: Array, targets: Array) -> Array:
    """Roots (M, 3) where the middle of the box is, as far as its diagonal says."""
    left, top, right, bottom = sides
    middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
    ray, first, second = camera.rays(np.array([middle, [left, top], [right, bottom]]))
    angle = np.arccos(np.clip(first @ second, -1.0, 1.0))
    away = np.tile([[0.0, 0.0, 10.0]], (len(targets), 1))
    joints = encoding.body.joint_positions(encoding.decode(targets, away))[..., :2]
    extent = np.linalg.norm(joints.max(1) - joints.min(1), axis=1) + 0.2 * encoding.body.scale
    depth = 0.5 * extent / np.tan(0.5 * max(float(angle), 1e-3))
    depth = np.clip(depth, 2.0 * encoding.body.lower[2], 0.9 * encoding.body.upper[2])
    result: Array = depth[:, None] * ray / max(float(ray[2]), 0.1)
    return result


def _prior(roots: Array) -> Array:
    """Precisions (M, 3, 3) of the places before the box is compared."""
    distance = np.linalg.norm(roots, axis=1)
    along = roots / distance[:, None]
    outer = along[:, :, None] * along[:, None, :]
    weights = (np.array([DEPTH_SPREAD, ACROSS_SPREAD])[:, None] * distance) ** -2.0
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
    """Sides of the boxes of M postures minus those seen (M, 4), and their derivatives.

    `slopes` are the Jacobians of the encoding about there.

    Returns:
        residuals (M, 4), by the roots (M, 4, 3), by the targets (M, 4, D).
    """
    poses = encoding.decode(targets, roots)
    by_target, by_root = slopes
    frames = forward(encoding.body.skeleton, poses)
    points = frames.points(mesh.segments, mesh.vertices)  # (V, 3, M)
    points[:, 2] = np.maximum(points[:, 2], 0.05)  # a hand behind the camera is at its plane
    u, v = camera.project_with_derivative(points.transpose(1, 0, 2), derivative=False)[0]
    outermost = np.stack([u.argmin(0), v.argmin(0), u.argmax(0), v.argmax(0)], axis=1)  # (M, 4)
    rows = np.arange(len(poses))[:, None]
    chosen = points[outermost, :, rows]  # (M, 4, 3)
    pixels, by_point = camera.project_with_derivative(chosen.transpose(2, 0, 1))
    coordinate = np.array([0, 1, 0, 1])
    # pixels (2, M, 4) and by_point (2, 3, M, 4), of the coordinate that the side bounds
    value = np.stack([pixels[c, :, k] for k, c in enumerate(coordinate)], axis=1)
    slope = np.stack([by_point[c, :, :, k].T for k, c in enumerate(coordinate)], axis=1)
    by_pose = np.einsum('mkc,mkdc->mkd', slope, _by_pose(frames, mesh, outermost, chosen))
    residual = value - sides
    # Where the image ends the person reaches it, and how far beyond is not known.
    outwards = np.array([-1.0, -1.0, 1.0, 1.0])
    unknown = cut & (residual * outwards >= 0)
    residual[unknown] = 0.0
    by_pose[unknown] = 0.0
    return residual, by_pose @ by_root, by_pose @ by_target


def _by_pose(frames: Frames, mesh: Mesh, vertices: Index, points: Array) -> Array:
    """Derivatives (M, 4, d, 3) of points (M, 4, 3) on the segments of vertices, by their poses."""
    skeleton = frames.skeleton
    axes, origins = frames.dofs_by_pose()  # (M, d, 3)
    arm = points[:, :, None] - origins[:, None]
    x, y, z = np.moveaxis(axes[:, None], -1, 0)
    u, v, w = np.moveaxis(arm, -1, 0)
    turning = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
    moved = np.where(skeleton.dof_is_rotation[:, None], turning, axes[:, None])
    result: Array = moved * skeleton.moves[mesh.segments[vertices]][..., None]
    return result
