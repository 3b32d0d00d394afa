"""Root angles with a camera on its side: the level of a body, and poses at another level."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import load_body
from hmt_ros.body.camera import roll
from hmt_ros.body.mirror import (
    relevelled,
    root_rotations,
    turn_jacobians,
    turned,
)
from hmt_ros.body.pose_prior import LEARNED, pose_prior
from hmt_ros.inference import GaussianMixture

BODY = load_body('human37')


def rolled(degrees: float) -> np.ndarray:
    return Rotation.from_rotvec([0.0, 0.0, np.radians(degrees)]).as_matrix()


def facing(count: int = 8) -> np.ndarray:
    """Poses (N, d) of standing people who face in all directions."""
    poses = np.tile(BODY.prior_mean, (count, 1))
    poses[:, :3] = [0.2, -0.3, 4.0]
    poses[:, 3] = np.linspace(0.1, 2.0 * np.pi, count)
    poses[:, 4], poses[:, 5] = 0.1, -0.2
    return poses


@pytest.mark.parametrize('degrees', [0.0, 15.0, 90.0, 180.0, -90.0])
def test_a_roll_is_that_of_the_vertical(degrees):
    pitched = np.array([0.0, -np.cos(0.4), -np.sin(0.4)])
    assert roll(rolled(degrees) @ pitched) == pytest.approx(rolled(degrees))
    both = roll(np.stack([rolled(degrees) @ pitched, np.zeros(3)]))
    assert both == pytest.approx(np.stack([rolled(degrees), np.eye(3)]))


@pytest.mark.parametrize('degrees', [15.0, 90.0, 180.0])
def test_people_before_a_turned_camera_have_the_angles_of_an_upright_one(degrees):
    turn, poses = rolled(degrees), facing()
    seen = poses.copy()
    seen[:, :3] = poses[:, :3] @ turn.T
    there = BODY.levelled(turn).joint_positions(seen)
    assert there == pytest.approx(BODY.joint_positions(poses) @ turn.T)
    assert BODY.levelled(turn).levelled(np.eye(3)).skeleton.mounts == pytest.approx(
        BODY.skeleton.mounts
    )
    assert BODY.levelled(np.eye(3)) is BODY
    # The prior of the limbs is still found for the body.
    assert pose_prior(BODY.levelled(turn), LEARNED, 1.0) is not None


@pytest.mark.parametrize('degrees', [15.0, 60.0, 180.0])
def test_poses_at_another_level_have_the_same_joints(degrees):
    level, poses = BODY.levelled(rolled(degrees)), facing()
    found = turned(level, poses, BODY)
    assert BODY.joint_positions(found) == pytest.approx(level.joint_positions(poses), abs=1e-9)
    # Derivatives against differences.
    jacobians, step = turn_jacobians(level, poses, BODY, found), 1e-6
    for j in range(3, 7):
        moved = poses.copy()
        moved[:, j] += step
        slope = (turned(level, moved, BODY) - found) / step
        assert slope == pytest.approx(jacobians[:, :, j], abs=1e-4)


@pytest.mark.parametrize('degrees', [15.0, 90.0, 180.0])
def test_a_mixture_at_another_level_says_the_same_of_joints(degrees):
    level, poses = BODY.levelled(rolled(degrees)), facing(5)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, BODY.dimension, BODY.dimension))
    mixture = GaussianMixture(np.full(5, 0.2), poses, 1e-4 * root @ root.transpose(0, 2, 1))
    other = relevelled(level, mixture, BODY)
    for body, one in ((level, mixture), (BODY, other)):
        slopes = body.joint_jacobians(one.means)
        spread = np.einsum('njad,nde,njbe->njab', slopes, one.covariances, slopes)
        if body is level:
            wanted = spread
    assert spread == pytest.approx(wanted, abs=1e-9)
    assert relevelled(level, mixture, level) is mixture


def test_turns_go_on_from_those_before():
    poses = facing()
    poses[:, 3] += 4.0 * np.pi
    found = turned(BODY, poses, BODY.levelled(rolled(15.0)))
    assert np.abs(found[:, 3] - poses[:, 3]).max() < np.pi
    assert root_rotations(BODY.levelled(rolled(15.0)), found) == pytest.approx(
        root_rotations(BODY, poses)
    )
