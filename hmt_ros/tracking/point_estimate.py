"""The point estimate: the pose whose joints are nearest to those of the modes.

    x = argmin sum_k w_k sum_j |p_j(x) - p_j(x_k)|     over the modes that face the likelier way (1)

with joints p_j relative to the pelvis. This is the pose of least expected distance: where modes
disagree it is a median, which few wrong modes hardly move, and where they agree a mean, which
has less jitter than each of them. It is found by reweighted least squares, from the weighted mean
of the poses [Weiszfeld 1937]:

    s_kj = w_k / max(|p_j - p_kj|, e),   S_j = sum_k s_kj,   t_j = sum_k s_kj p_kj / S_j         (2)
    x <- x + (sum_j S_j (P_j' P_j + l^2))^-1 sum_j S_j P_j' (t_j - p_j),   P_j = dp_j / dx       (3)

The place of the pelvis is the weighted mean, and so is every variable that moves no joint. Modes
that face the other way are left out, because the mean of two opposite poses is no human pose. Other
images are not used: the modes are filtered, and a second filter would lag.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import left_directions, root_rotation_dofs
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.linear_algebra import product, solve
from hmt_ros.inference.mixture import GaussianMixture

# Number of steps (3): more hardly change the result. Chosen by accuracy on tracked clips.
STEPS = 2
# Distance e of joints below which modes agree, m: the size of their jitter. Chosen by accuracy on
# tracked clips.
AGREED = 0.03
# Lever l of the joints about an axis below which its angle stays that of the mean, m. Chosen.
LEVER = 0.01


def point_estimate(body: Body, posterior: GaussianMixture) -> Array:
    """The pose (d,) of least expected distance, empty without components.

    Args:
        body: of the poses.
        posterior: over the poses.
    """
    if not len(posterior):
        return np.empty(0)
    own = _facing_alike(body, posterior)
    poses, weights = posterior.means[own], posterior.weights[own]
    weights = weights / weights.sum()
    places = body.relative_joints(poses)
    leader = poses[int(weights.argmax())]
    pose = leader + product(weights, _differences(body, poses, leader))
    for _ in range(STEPS):
        pose = np.clip(pose, body.lower, body.upper)
        pose = pose + _step(body, pose, places, weights)
    return np.asarray(np.clip(pose, body.lower, body.upper))


def _facing_alike(body: Body, posterior: GaussianMixture) -> Mask:
    """The components (K,) that face the likelier way, within 90 degrees of its heaviest one."""
    weights = posterior.weights
    if not body.trunk_pairs:
        return np.ones(len(weights), dtype=np.bool_)
    left = left_directions(body, posterior.means)
    alike = product(left, left[int(weights.argmax())]) >= 0
    likelier: Mask = alike if 2.0 * weights[alike].sum() >= weights.sum() else ~alike
    return likelier


def _step(body: Body, pose: Array, places: Array, weights: Array) -> Array:
    """The step (3) from a pose (d,), by the joints (K, J, 3) of the modes and their weights."""
    now, jacobian = body.relative_joints(pose[None])[0], body.joint_jacobians(pose[None])[0]
    offsets = places - now
    away = np.sqrt((offsets * offsets).sum(2))
    shares = weights[:, None] / np.maximum(away, AGREED)  # s_kj
    total = shares.sum(0)
    pulls = (shares[..., None] * offsets).sum(0)  # S_j (t_j - p_j)
    levers = (jacobian - jacobian[:1]).reshape(-1, len(pose))
    each = np.repeat(total, 3)[:, None]
    normal = product(levers.T, each * levers) + LEVER**2 * total.sum() * np.eye(len(pose))
    return np.asarray(solve(normal, product(levers.T, pulls.ravel())))


def _differences(body: Body, poses: Array, reference: Array) -> Array:
    """Poses (N, d) minus a reference pose (d,), with root rotations in [-pi, pi)."""
    result = poses - reference
    root = root_rotation_dofs(body.skeleton)
    result[:, root] = (result[:, root] + np.pi) % (2.0 * np.pi) - np.pi
    return result
