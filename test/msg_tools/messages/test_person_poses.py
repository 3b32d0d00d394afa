"""The pose of a person and its covariance about fixed axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from msg_tools import MessageError
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.person_poses import PERSON_POSE, person_pose, person_pose_message


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


def one(body, **angles):
    """A pose (1, d) 4 m before the camera."""
    pose = body.prior_mean.copy()
    pose[2] = 4.0
    for name, value in angles.items():
        pose[body.dof_names.index(name)] = value
    return pose[None]


def joint(body, poses, name):
    return body.joint_positions(poses)[0, body.joint_names.index(name)]


def test_axes_are_forward_left_and_up(body):
    poses = one(body, root_z=0.7, root_y=0.2, root_x=-0.3)
    found = person_pose(body, GaussianMixture([1.0], poses, 1e-4 * np.eye(37)[None]))
    left = joint(body, poses, 'left_hip') - joint(body, poses, 'right_hip')
    np.testing.assert_allclose(found.rotation[:, 1], left / np.linalg.norm(left), atol=1e-9)
    toes = joint(body, poses, 'left_toe') - joint(body, poses, 'left_ankle')
    assert found.rotation[:, 0] @ toes / np.linalg.norm(toes) > 0.9
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(found.position, joint(body, poses, 'pelvis'), atol=1e-9)


def test_covariance_is_that_of_samples(body):
    """The covariance of the rotation about the camera's axes, and that with the position."""
    rng = np.random.default_rng(0)
    poses = one(body, root_z=1.2, root_y=0.5, root_x=0.4)
    root = rng.normal(size=(37, 37)) * 0.01
    mixture = GaussianMixture([1.0], poses, (root @ root.T + 1e-8 * np.eye(37))[None])
    found = person_pose(body, mixture)
    away = []
    for sample in mixture.sample(4000, rng):
        alone = person_pose(body, GaussianMixture([1.0], sample[None], mixture.covariances))
        turn = Rotation.from_matrix(alone.rotation @ found.rotation.T).as_rotvec()
        away.append(np.concatenate([alone.position - found.position, turn]))
    sampled = np.cov(np.transpose(away))
    scale = np.sqrt(np.outer(np.diagonal(sampled), np.diagonal(sampled)))
    np.testing.assert_allclose(found.covariance / scale, sampled / scale, atol=0.1)


def test_components_that_disagree_widen_it(body):
    means = np.concatenate([one(body), one(body, root_tz=4.4, root_z=0.3)])
    tight = np.tile(1e-6 * np.eye(37), (2, 1, 1))
    found = person_pose(body, GaussianMixture([0.75, 0.25], means, tight))
    np.testing.assert_allclose(found.position, joint(body, means, 'pelvis'), atol=1e-9)
    np.testing.assert_allclose(found.covariance[2, 2], 0.25 * 0.4**2, rtol=1e-3)
    assert np.trace(found.covariance[3:, 3:]) == pytest.approx(0.25 * 0.3**2, rel=1e-3)


def test_in_another_frame(body):
    turn = Rotation.from_euler('zyx', [0.3, 1.0, -0.5]).as_matrix()
    poses = one(body, root_z=1.2)
    found = person_pose(body, GaussianMixture([1.0], poses, np.diag(np.arange(1.0, 38.0))[None]))
    there = found.seen_from(turn, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(there.position, turn @ found.position + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(there.rotation, turn @ found.rotation)
    np.testing.assert_allclose(
        there.covariance[:3, 3:], turn @ found.covariance[:3, 3:] @ turn.T, atol=1e-12
    )
    np.testing.assert_allclose(
        np.linalg.eigvalsh(there.covariance), np.linalg.eigvalsh(found.covariance), rtol=1e-9
    )


def test_message(body, messages):
    found = person_pose(body, GaussianMixture([1.0], one(body), 1e-4 * np.eye(37)[None]))
    message = person_pose_message(messages, found, 1_700_000_000_000_000_007, 'odom')
    back = deserialise(serialise(message), PERSON_POSE)
    assert (back.header.frame_id, back.header.stamp.nanosec) == ('odom', 7)
    q = back.pose.pose.orientation
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(turned, found.rotation, atol=1e-9)
    np.testing.assert_array_equal(back.pose.covariance.reshape(6, 6), found.covariance)
    with pytest.raises(MessageError, match='person_pose has values that are not finite'):
        person_pose_message(messages, found._replace(position=np.full(3, np.nan)), 0, 'odom')
    nobody = GaussianMixture(np.empty(0), np.empty((0, 37)), np.empty((0, 37, 37)))
    with pytest.raises(MessageError, match='without components has no pose'):
        person_pose(body, nobody)
