"""Mirror images of poses: left-right, and in depth, which silhouettes do not show.

A body is left-right symmetric. If it is mirrored in the plane through the pelvis perpendicular to
the line of sight, its silhouette stays the same, apart from perspective: a person who approaches
looks like a person who walks away. The joint angles of the result are those of the left-right
mirrored pose, so they lie within the limits, too.

Angles without limits are equal modulo a whole turn. The heading of a turning person can pass 180
degrees, and two estimates of one heading may differ by a turn. Whole turns must be removed before
poses are compared variable by variable.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import ROOT_ANGLES, Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.skeleton import Skeleton, other_side
from hmt_ros.core import elementary, face_back, point_left
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.linear_algebra import product, solve
from hmt_ros.inference.mixture import GaussianMixture

arctan2 = elementary.arctan2

# Maximum sine of the angle between a person's front and the image plane in a side view.
MAX_SIDEWAYS_SINE = 0.12
# Axes of the root's rotations, in the order in which they act.
ROOT_AXES = 'zyx'
TURN = 2.0 * np.pi
# Fraction of the limit below which a root angle is far from limits and singularities.
CLEARANCE_RATIO = 0.85
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def mirror(body: Body, poses: ArrayLike) -> Array:
    """Left-right mirror images of poses (N, d): x in the camera frame changes its sign."""
    q = np.array(poses, dtype=np.float64, ndmin=2)
    order, signs = mirror_order(body.skeleton)
    result: Array = q[:, order] * signs
    return result


def mirror_order(skeleton: Skeleton) -> tuple[Index, Array]:
    """Order (d,) and signs (d,): the mirror image of a pose q (d,) is q[order] * signs."""
    order = skeleton.dof_index(tuple(other_side(name) for name in skeleton.dof_names))
    along_x = skeleton.dof_axes == 0
    signs = np.where(along_x == skeleton.dof_is_rotation, 1.0, -1.0)
    return np.asarray(order, dtype=np.intp), signs


def reverse_depth(body: Body, poses: ArrayLike) -> Array:
    """Mirror poses (N, d) in the plane through the pelvis perpendicular to the line of sight.

    Args:
        body: body whose root turns about z, y and x.
        poses: (N, d) poses with the pelvis in front of the camera.

    Raises:
        ValueError: the root of the body has other rotations.
    """
    q = np.array(poses, dtype=np.float64, ndmin=2)
    skeleton = body.skeleton
    dofs = root_rotation_dofs(skeleton)
    frames = forward(skeleton, q)
    pelvis = frames.joints()[skeleton.joint_index(('pelvis',))[0]].T
    ray = pelvis / np.sqrt((pelvis * pelvis).sum(1, keepdims=True))
    across = np.eye(3) - 2.0 * ray[:, :, None] * ray[:, None, :]
    result = mirror(body, q)
    result[:, :3] = q[:, :3]
    left_for_right = np.diag([-1.0, 1.0, 1.0])
    turned = product(product(across, root_rotations(body, q)), left_for_right)
    result[:, dofs] = root_angles(body, turned)
    return np.clip(result, body.lower, body.upper)


@lru_cache(maxsize=16)
def root_rotation_dofs(skeleton: Skeleton) -> Index:
    """The rotations of the root, about z, y and x in this order.

    Raises:
        ValueError: the root has other rotations.
    """
    own, axes = rotations_of(skeleton, 0)
    if axes != ROOT_AXES:
        raise ValueError(f'the root of {skeleton.name} turns about {axes!r}, wanted {ROOT_AXES!r}')
    return np.array(own, dtype=np.intp)


def rotations_of(skeleton: Skeleton, segment: int) -> tuple[list[int], str]:
    """The rotational degrees of freedom of a segment, and their axes, such as 'zyx'."""
    own = [j for j in skeleton.segment_dofs[segment] if skeleton.dof_is_rotation[j]]
    return own, ''.join('xyz'[skeleton.dof_axes[j]] for j in own)


def root_rotations(body: Body, poses: Array) -> Array:
    """Rotations (N, 3, 3) from the pelvis to the camera frame."""
    result: Array = forward(body.skeleton, poses).columns[0].transpose(2, 1, 0)
    return result


def root_angles(body: Body, rotations: Array) -> Array:
    """Angles (N, 3) about z, y, x of the root for rotations (N, 3, 3); |y| stays below its limit.

    The angle about z is between -pi and pi.
    """
    r = product(body.skeleton.mounts[0].T, rotations)
    y = arctan2(-r[:, 2, 0], elementary.hypot(r[:, 2, 1], r[:, 2, 2]))
    limits = root_rotation_dofs(body.skeleton)[1]
    y = np.clip(y, body.lower[limits], body.upper[limits])
    z, x = arctan2(r[:, 1, 0], r[:, 0, 0]), arctan2(r[:, 2, 1], r[:, 2, 2])
    return np.stack([z, y, x], axis=1)


def turned(
    body: Body, poses: Array, to: Body, rotation: Array | None = None, turn: float = 0.0
) -> Array:
    """Rotate the roots of poses (N, d) and convert the poses to a new level of the body.

    Args:
        body: body of the poses.
        poses: (N, d).
        to: the same body, with the level of the result.
        rotation: (3, 3) rotation of the roots, camera frame; None for no rotation.
        turn: approximate rotation about z, rad; it selects the whole turns of the result.
    """
    root, rotations = root_rotation_dofs(body.skeleton), root_rotations(body, poses)
    angles = root_angles(to, rotations if rotation is None else product(rotation, rotations))
    # Select the whole turns nearest to the previous angle.
    offset_of_turns = poses[:, root[0]] + turn - angles[:, 0]
    angles[:, 0] += TURN * np.round(offset_of_turns / TURN)
    result = poses.copy()
    result[:, root] = angles
    return result


def turn_jacobians(
    body: Body, before: Array, to: Body, after: Array, rotation: Array | None = None
) -> Array:
    """Derivatives (N, d, d) of `turned` at poses `before` (N, d); its results are `after`."""
    root = root_rotation_dofs(body.skeleton)
    # The columns are the rotation axes of the angles.
    old, new = (
        forward(one.skeleton, poses).axes[root].transpose(2, 1, 0)
        for one, poses in ((body, before), (to, after))
    )
    result = np.tile(np.eye(body.dimension), (len(before), 1, 1))
    moved = old if rotation is None else product(rotation, old)
    result[np.ix_(np.arange(len(before)), root, root)] = solve(new, moved)
    return result


def relevelled(body: Body, mixture: GaussianMixture, to: Body) -> GaussianMixture:
    """Convert a mixture over poses of a body to a new level of the body."""
    if np.array_equal(body.level, to.level):
        return mixture
    means = turned(body, mixture.means, to)
    jacobians = turn_jacobians(body, mixture.means, to, means)
    covariances = propagated(jacobians, mixture.covariances)
    return GaussianMixture(mixture.weights, means, covariances)


def clear_level(body: Body, pose: Array) -> Array:
    """Return a level (3, 3) at which the root angles of a pose (d,) are far from their limits.

    The body's own level is returned if it suffices, otherwise that level rotated by quarter turns.
    """
    best, least = body.level, CLEARANCE_RATIO
    if not {*ROOT_ANGLES} <= {*body.dof_names}:
        return best
    limits = root_rotation_dofs(body.skeleton)[1:]
    upright = np.eye(3)
    for turn in (upright, QUARTER_TURN, product(QUARTER_TURN, QUARTER_TURN), QUARTER_TURN.T):
        level: Array = product(turn, body.level)
        angles = turned(body, pose[None], body.levelled(level))[0, limits]
        share = float(np.abs(angles / body.upper[limits]).max())
        if share < least:
            best, least = level, share
            if turn is upright:
                break
    return best


def propagated(jacobians: Array, covariances: Array) -> Array:
    """Covariances J S J' (N, n, n), from Jacobians J (N, n, m) and covariances S (N, m, m)."""
    result: Array = product(product(jacobians, covariances), jacobians.swapaxes(1, 2))
    return 0.5 * (result + result.swapaxes(1, 2))


class Trunk(NamedTuple):
    """The left and the right joints (L,) of the trunk, for the core."""

    left: Index
    right: Index


@lru_cache(maxsize=16)
def trunk_of(body: Body) -> Trunk:
    """Return the trunk joints, which show where a person faces.

    Raises:
        ValueError: the body has neither shoulders nor hips.
    """
    if not body.trunk_pairs:
        raise ValueError(f'body {body.name} has neither shoulders nor hips: it faces nowhere')
    return Trunk(*(body.skeleton.joint_index(x) for x in zip(*body.trunk_pairs, strict=True)))


def left_directions(body: Body, poses: Array) -> Array:
    """Unit vectors (N, 3) towards the persons' left in poses (N, d), camera frame.

    Raises:
        ValueError: the body has neither shoulders nor hips.
    """
    result = np.empty((len(poses), 3))
    point_left(trunk_of(body), body.joint_positions(poses), result)
    return result


def faces_back(body: Body, joints: Array, reference: Array) -> Mask:
    """Whether persons with joints (N, J, 3) and a reference (J, 3) face different directions.

    True if the directions differ by more than 90 degrees, or if one person clearly faces the camera
    and the other faces away. In a side view, a turn may continue in either direction.

    Raises:
        ValueError: the body has neither shoulders nor hips.
    """
    (neck,) = body.skeleton.joint_index(('neck',))
    result = np.empty(len(joints), dtype=np.bool_)
    face_back(trunk_of(body), joints, reference, neck, MAX_SIDEWAYS_SINE, result)
    return result


def endless(body: Body) -> Mask:
    """Return which variables (d,) are angles whose limits are at least a whole turn apart."""
    return np.asarray(body.skeleton.dof_is_rotation & (body.upper - body.lower >= TURN))


def free_limits(body: Body) -> tuple[Array, Array]:
    """Return limits (d,) of poses in any frame; root position and full turns are unlimited."""
    free = endless(body)
    free[:3] = True
    return np.where(free, -np.inf, body.lower), np.where(free, np.inf, body.upper)


def without_turns(body: Body, poses: Array, before: Array) -> Array:
    """Shift angles of poses (K, d) by whole turns towards the nearest of the poses `before` (L, d).

    The nearest pose has the smallest mean distance between joints relative to the first joint,
    which does not depend on whole turns.
    """
    joints, known = (body.relative_joints(x) for x in (poses, before))
    apart = joints[:, None] - known
    nearest = np.sqrt((apart * apart).sum(3)).mean(2).argmin(1)
    turns = np.round((before[nearest] - poses) / TURN)
    return np.asarray(poses + TURN * np.where(endless(body), turns, 0.0))
