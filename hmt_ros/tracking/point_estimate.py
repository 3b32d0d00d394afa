"""Point estimate: the pose with the least expected joint distance from the modes.

    x = argmin sum_k w_k sum_j |p_j(x) - p_j(x_k)|     over the modes that face the likelier way (1)

with joints p_j relative to the pelvis. If modes disagree, this is a median, which a few wrong modes
hardly move; if they agree, it is a mean, which has less jitter than each mode. Reweighted least
squares find it, starting at the weighted mean of the poses [Weiszfeld 1937]:

    s_kj = w_k / max(|p_j - p_kj|, e),   S_j = sum_k s_kj,   t_j = sum_k s_kj p_kj / S_j         (2)
    x <- x + (sum_j S_j (P_j' P_j + l^2))^-1 sum_j S_j P_j' (t_j - p_j),   P_j = dp_j / dx       (3)

The position of the pelvis and all variables that move no joint are weighted means. Modes that face
the other way are left out, because the mean of two opposite poses is no human pose. Other images
are not used: the modes are already filtered, and a second filter would add a delay.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import left_directions, root_rotation_dofs
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.linear_algebra import product, solve
from hmt_ros.inference.mixture import GaussianMixture

# Number of steps (3); more steps hardly change the result. Chosen by accuracy on tracked clips.
MAX_STEPS = 2
# Distance e of joints below which modes agree, m: the amplitude of jitter. Chosen by accuracy on
# tracked clips.
AGREEMENT_DISTANCE = 0.03
# Lever arm l of joints about an axis, m, below which the angle stays at the weighted mean. Chosen.
MIN_LEVER = 0.01


def point_estimate(body: Body, posterior: GaussianMixture) -> Array:
    """Pose (d,) with the least expected joint distance; empty without components.

    Args:
        body: body of the poses.
        posterior: mixture over the poses.
    """
    if not len(posterior):
        return np.empty(0)
    own = _facing_alike(body, posterior)
    poses, weights = posterior.means[own], posterior.weights[own]
    weights = weights / weights.sum()
    places = body.relative_joints(poses)
    leader = poses[int(weights.argmax())]
    pose = leader + product(weights, _differences(body, poses, leader))
    for _ in range(MAX_STEPS):
        pose = np.clip(pose, body.lower, body.upper)
        pose = pose + _step(body, pose, places, weights)
    return np.asarray(np.clip(pose, body.lower, body.upper))


def _facing_alike(body: Body, posterior: GaussianMixture) -> Mask:
    """Selects the components (K,) that face in the more likely of two opposite directions."""
    weights = posterior.weights
    if not body.trunk_pairs:
        return np.ones(len(weights), dtype=np.bool_)
    left = left_directions(body, posterior.means)
    alike = product(left, left[int(weights.argmax())]) >= 0
    likelier: Mask = alike if 2.0 * weights[alike].sum() >= weights.sum() else ~alike
    return likelier


def _step(body: Body, pose: Array, places: Array, weights: Array) -> Array:
    """Step (3) from a pose (d,), given joints (K, J, 3) and weights (K,) of the modes."""
    now, jacobian = body.relative_joints(pose[None])[0], body.joint_jacobians(pose[None])[0]
    offsets = places - now
    away = np.sqrt((offsets * offsets).sum(2))
    shares = weights[:, None] / np.maximum(away, AGREEMENT_DISTANCE)  # s_kj
    total = shares.sum(0)
    pulls = (shares[..., None] * offsets).sum(0)  # S_j (t_j - p_j)
    levers = (jacobian - jacobian[:1]).reshape(-1, len(pose))
    each = np.repeat(total, 3)[:, None]
    normal = product(levers.T, each * levers) + MIN_LEVER**2 * total.sum() * np.eye(len(pose))
    return np.asarray(solve(normal, product(levers.T, pulls.ravel())))


def _differences(body: Body, poses: Array, reference: Array) -> Array:
    """Differences of poses (N, d) from a reference (d,), with root rotations in [-pi, pi)."""
    result = poses - reference
    root = root_rotation_dofs(body.skeleton)
    result[:, root] = (result[:, root] + np.pi) % (2.0 * np.pi) - np.pi
    return result
