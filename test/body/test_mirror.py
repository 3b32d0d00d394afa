"""Mirror images of poses."""

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.mirror import mirror, reverse_depth

BODIES = ('human37', 'human34', 'human32')


def drawn(body, count=20, seed=0):
    """Poses within the limits, 3 to 5 m in front of the camera."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(body.lower, -np.pi), np.minimum(body.upper, np.pi)
    poses = rng.uniform(low, high, (count, body.dimension))
    poses[:, :3] = rng.uniform((-1.0, -1.0, 3.0), (1.0, 1.0, 5.0), (count, 3))
    poses[:, 4] = rng.uniform(-1.0, 1.0, count)
    return np.clip(poses, body.lower, body.upper)


def other_side(names):
    swap = {'left': 'right', 'right': 'left'}
    return [
        names.index(
            '_'.join([swap.get(name.split('_')[0], name.split('_')[0]), *name.split('_')[1:]])
        )
        for name in names
    ]


@pytest.mark.parametrize('name', BODIES)
def test_mirror_changes_left_for_right(name):
    body = load_body(name)
    poses = drawn(body)
    joints, images = body.joint_positions(poses), body.joint_positions(mirror(body, poses))
    wanted = joints[:, other_side(body.joint_names)] * [-1.0, 1.0, 1.0]
    assert np.abs(images - wanted).max() < 1e-9
    assert np.abs(mirror(body, mirror(body, poses)) - poses).max() < 1e-12


@pytest.mark.parametrize('name', BODIES)
def test_depth_is_reversed_along_the_ray(name):
    body = load_body(name)
    poses = drawn(body)
    reversed_poses = reverse_depth(body, poses)
    # Some would have to lean further than the limits of the root.
    free = (np.abs(reversed_poses[:, 4:6]) < body.upper[4:6] - 1e-9).all(1)
    assert free.sum() > 10
    joints = body.joint_positions(poses)[free]
    pelvis = joints[:, [body.joint_names.index('pelvis')]]
    ray = pelvis / np.linalg.norm(pelvis, axis=2, keepdims=True)
    offset = joints - pelvis
    wanted = pelvis + offset - 2.0 * (offset * ray).sum(2, keepdims=True) * ray
    found = body.joint_positions(reversed_poses)[free][:, other_side(body.joint_names)]
    assert np.abs(found - wanted).max() < 1e-9
    assert (reversed_poses >= body.lower).all()
    assert (reversed_poses <= body.upper).all()
