from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import Body, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.experts.pose_encoding import PoseEncoding, ray_rotations


@pytest.fixture(scope='module')
def encoding() -> PoseEncoding:
    return PoseEncoding(load_body('human37'))


def random_poses(body: Body, n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = rng.uniform(np.maximum(body.lower, -3), np.minimum(body.upper, 3), (n, body.dimension))
    poses[:, :3] = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 6.0], (n, 3))
    poses[:, 4] *= 0.8
    return poses


def test_decoding_gives_the_pose_back(encoding: PoseEncoding) -> None:
    poses = random_poses(encoding.body, 50, 0)
    back = encoding.decode(encoding.encode(poses), poses[:, :3])
    joints, again = (encoding.body.joint_positions(x) for x in (poses, back))
    np.testing.assert_allclose(again, joints, atol=1e-12)


def test_a_person_off_the_axis_has_the_target_of_one_on_it(encoding: PoseEncoding) -> None:
    body = encoding.body
    pose = random_poses(body, 1, 1)
    pose[0, :3] = [0.0, 0.0, 4.0]
    target = encoding.encode(pose)
    aside = np.array([[1.6, -0.7, 3.0]])
    moved = encoding.decode(target, aside)
    turn = ray_rotations(aside)[0]
    relative = body.joint_positions(pose)[0] - pose[0, :3]
    np.testing.assert_allclose(
        body.joint_positions(moved)[0] - aside[0], relative @ turn.T, atol=1e-12
    )
    np.testing.assert_allclose(encoding.encode(moved), target, atol=1e-12)


def test_a_target_is_that_of_an_upright_camera(encoding: PoseEncoding) -> None:
    poses = random_poses(encoding.body, 5, 4)
    level = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    there = PoseEncoding(encoding.body.levelled(level))
    moved = poses.copy()
    moved[:, :3] = poses[:, :3] @ level.T
    targets = encoding.encode(poses)
    np.testing.assert_allclose(there.encode(moved), targets, atol=1e-12)
    np.testing.assert_allclose(there.decode(targets, moved[:, :3]), moved, atol=1e-9)
    # Derivatives by roots and poses rotate with the camera.
    for name, given in (('jacobians', (targets, poses[:, :3])), ('encoding_jacobians', (poses,))):
        upright = getattr(encoding, name)(*given)
        turned = getattr(there, name)(*given[:-1], moved if len(given) == 1 else moved[:, :3])
        if name == 'encoding_jacobians':
            np.testing.assert_allclose(turned[:, :, :3] @ level, upright[:, :, :3], atol=1e-9)
            np.testing.assert_allclose(turned[:, :, 3:], upright[:, :, 3:], atol=1e-9)
        else:
            np.testing.assert_allclose(turned[0], upright[0], atol=1e-9)
            np.testing.assert_allclose(turned[1][:, 3:] @ level, upright[1][:, 3:], atol=1e-9)


def test_the_ray_frame_looks_at_the_point() -> None:
    points = np.array([[1.0, -2.0, 3.0], [0.0, 0.0, 1.0]])
    rotations = ray_rotations(points)
    np.testing.assert_allclose(
        rotations[:, :, 2], points / np.linalg.norm(points, axis=1)[:, None], atol=1e-15
    )
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (2, 1, 1)), atol=1e-15
    )


def test_headings_around_the_turn_have_near_targets(encoding: PoseEncoding) -> None:
    poses = np.tile(random_poses(encoding.body, 1, 2), (2, 1))
    poses[:, 3] = np.pi - 0.01, -np.pi + 0.01
    first, second = encoding.encode(poses)
    assert np.abs(first - second).max() < 0.03


def test_axes_that_are_not_perpendicular_become_a_rotation(encoding: PoseEncoding) -> None:
    rng = np.random.default_rng(3)
    targets = encoding.encode(random_poses(encoding.body, 20, 3))
    targets[:, :6] += 0.2 * rng.normal(size=(20, 6))
    roots = np.tile([[0.3, 0.2, 4.0]], (20, 1))
    frames = forward(encoding.body.skeleton, encoding.decode(targets, roots))
    front = frames.columns[0, 1].T
    wanted = targets[:, :3] / np.linalg.norm(targets[:, :3], axis=1)[:, None]
    np.testing.assert_allclose(front @ ray_rotations(roots)[0], wanted, atol=1e-9)


def test_joint_angles_stay_within_the_limits(encoding: PoseEncoding) -> None:
    targets = encoding.encode(random_poses(encoding.body, 1, 4))
    targets[:, 6:] = 9.0
    pose = encoding.decode(targets, np.array([[0.0, 0.0, 3.0]]))[0]
    np.testing.assert_array_equal(pose[6:], encoding.body.upper[6:])


def test_jacobians_are_those_of_decoding(encoding: PoseEncoding) -> None:
    body = encoding.body
    poses = random_poses(body, 6, 5)
    targets, roots = encoding.encode(poses), poses[:, :3]
    targets[:, 6:] = np.clip(targets[:, 6:], body.lower[6:] + 0.01, body.upper[6:] - 0.01)
    targets[:, :6] += 0.1 * np.random.default_rng(0).normal(size=(6, 6))
    by_target, by_root = encoding.jacobians(targets, roots)
    h = 1e-6
    for j in range(encoding.size):
        step = h * np.eye(encoding.size)[j]
        numeric = encoding.decode(targets + step, roots) - encoding.decode(targets - step, roots)
        np.testing.assert_allclose(by_target[:, :, j], numeric / (2 * h), atol=2e-6)
    for j in range(3):
        step = h * np.eye(3)[j]
        numeric = encoding.decode(targets, roots + step) - encoding.decode(targets, roots - step)
        np.testing.assert_allclose(by_root[:, :, j], numeric / (2 * h), atol=2e-6)


def test_jacobian_of_encoding(encoding: PoseEncoding) -> None:
    poses = random_poses(encoding.body, 3, 6)
    h = 1e-6
    numeric = np.stack(
        [
            (encoding.encode(poses + h * e) - encoding.encode(poses - h * e)) / (2 * h)
            for e in np.eye(encoding.size)
        ],
        axis=2,
    )
    np.testing.assert_allclose(encoding.encoding_jacobians(poses), numeric, atol=1e-7)


def test_a_gaussian_is_decoded_as_its_samples_are(encoding: PoseEncoding) -> None:
    rng = np.random.default_rng(7)
    pose = 0.4 * random_poses(encoding.body, 1, 7)
    pose[0, :3] = [0.4, 0.1, 4.0]
    pose[:, 6:] = 0.5 * (encoding.body.lower + encoding.body.upper)[6:]
    mean = encoding.encode(pose)[0]
    a = 0.004 * rng.normal(size=(encoding.size, encoding.size))
    covariance, root_covariance = a @ a.T, np.diag([1e-4, 1e-4, 9e-4])
    by_target, by_root = (x[0] for x in encoding.jacobians(mean[None], pose[:, :3]))
    spread = by_target @ covariance @ by_target.T + by_root @ root_covariance @ by_root.T
    found = encoding.decode(mean[None], pose[:, :3])[0]
    targets = rng.multivariate_normal(mean, covariance, 20000)
    roots = rng.multivariate_normal(pose[0, :3], root_covariance, 20000)
    samples = encoding.decode(targets, roots)
    np.testing.assert_allclose(found, pose[0], atol=1e-9)
    np.testing.assert_allclose(samples.mean(0), found, atol=3e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), samples.std(0), rtol=0.03)


def test_a_body_with_another_root_is_refused() -> None:
    from dataclasses import replace

    body = load_body('human37')
    names = ('root_a', *body.skeleton.dof_names[1:])
    with pytest.raises(ValueError, match='root_a'):
        PoseEncoding(replace(body, skeleton=replace(body.skeleton, dof_names=names)))


def test_a_root_at_the_camera_is_refused(encoding: PoseEncoding) -> None:
    with pytest.raises(ValueError, match='before the camera'):
        encoding.encode(np.zeros((1, encoding.size)))
