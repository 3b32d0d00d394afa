"""Mixtures over whole poses: sizes, exchanged sides, and the energy of depths with keypoints."""

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.body import Camera, load_body
from hmt_ros.image.keypoint_schemes import usual_exchanges
from hmt_ros.image.lifted_poses import HIPS, LiftedPoses, bone_lengths
from hmt_ros.image.terms.keypoints import (
    LIFTED_KERNEL,
    LIFTED_WEIGHT,
    NOT_EXCHANGED,
    Keypoints,
    KeypointTerm,
)
from test.oracles.single_terms import energy_of

JOINTS = (
    'neck', 'head', 'left_shoulder', 'right_shoulder', 'left_elbow', 'right_elbow', 'left_wrist',
    'right_wrist', 'left_hip', 'right_hip', 'left_knee', 'right_knee', 'left_ankle', 'right_ankle',
)  # fmt: skip
BODY = load_body('human37')
CAMERA = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)
# Step of finite differences.
STEP = 1e-6


def pose(seed=0):
    rng = np.random.default_rng(seed)
    found = BODY.prior_mean + 0.4 * rng.normal(size=BODY.dimension)
    found[:6] = 0.2, 0.1, 4.0, 0.5, 0.1, 0.1
    return np.clip(found, BODY.lower, BODY.upper)


def lifted(seed=1, components=3):
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    weights = rng.uniform(0.5, 1.0, components)
    means = 0.3 * rng.normal(size=(components, len(JOINTS), 3))
    spread = rng.uniform(0.05, 0.2, means.shape)
    lengths = 1.07 * bone_lengths(BODY.skeleton, JOINTS)
    return LiftedPoses(JOINTS, np.log(weights / weights.sum()), means, spread, axes, lengths)


def term(poses, exchanges):
    """A term with one keypoint of little weight, and the mixture."""
    pixels = CAMERA.project(BODY.joint_positions(pose()[None])[0][:1])
    one = Keypoints(BODY.joint_names[:1], pixels, 1e12 * np.eye(2)[None], np.ones(1), lifted=poses)
    return KeypointTerm(BODY.skeleton, CAMERA, one, exchanges=exchanges)


def energy(poses: LiftedPoses, x: np.ndarray, exchanges: np.ndarray | None) -> float:
    return float(energies(poses, x, exchanges).value[0])


def energies(poses: LiftedPoses, x: np.ndarray, exchanges: np.ndarray | None):
    return energy_of(term(poses, exchanges), BODY, x, camera=CAMERA)


def density(poses, x):
    """Minus the log density of depths, by the formula on the page."""
    joints = BODY.joint_positions(x[None])[0]
    hips = joints[BODY.skeleton.joint_index(HIPS)].mean(0)
    depth = (joints[BODY.skeleton.joint_index(poses.joints)] - hips) @ poses.axes[2]
    mean, sigma = poses.sized(BODY.skeleton)[:, :, 2], poses.deviations[:, :, 2]
    square = ((depth - mean) / sigma) ** 2
    kernel = 0.5 * square / (1.0 + square / LIFTED_KERNEL**2)
    return -float(logsumexp(poses.log_weights - (kernel + np.log(sigma)).sum(1)))


def test_energy_is_the_log_density_of_depths():
    poses = lifted()
    # Other parts of the term do not depend on the pose.
    found = [energy(poses, pose(i), NOT_EXCHANGED) for i in range(4)]
    wanted = [LIFTED_WEIGHT * density(poses, pose(i)) for i in range(4)]
    assert np.ptp(np.array(found) - wanted) < 1e-8


@pytest.mark.parametrize('exchanges', [NOT_EXCHANGED, usual_exchanges()])
def test_gradient(exchanges):
    poses, x = lifted(), pose()
    gradient, hessian = energies(poses, x, exchanges).derivatives()
    numeric = np.array(
        [
            (energy(poses, x + d, exchanges) - energy(poses, x - d, exchanges)) / (2 * STEP)
            for d in STEP * np.eye(len(x))
        ]
    )
    assert np.allclose(gradient[0], numeric, atol=1e-5 * max(1.0, np.abs(numeric).max()))
    assert np.linalg.eigvalsh(hessian[0]).min() > -1e-9
    assert np.abs(gradient[0, :3]).max() < 1e-6  # depths relative to the hips


def test_hessian_of_one_component_is_that_of_squares():
    one = lifted(components=1)
    sure = LiftedPoses(
        one.joints, one.log_weights, one.means, 1e-2 * one.deviations, one.axes, one.lengths
    )
    x = pose()
    # At the mean itself the Gauss-Newton Hessian is the exact one.
    joints = BODY.joint_positions(x[None])[0]
    hips = joints[BODY.skeleton.joint_index(HIPS)].mean(0)
    relative = (joints[BODY.skeleton.joint_index(JOINTS)] - hips) @ one.axes.T
    at = LiftedPoses(
        JOINTS, one.log_weights, relative[None], sure.deviations, one.axes,
        bone_lengths(BODY.skeleton, JOINTS),
    )  # fmt: skip
    hessian = energies(at, x, NOT_EXCHANGED).derivatives()[1][0]
    step, numeric = 1e-5, []
    for d in step * np.eye(len(x)):
        up, down = (energies(at, x + s * d, NOT_EXCHANGED) for s in (1, -1))
        numeric.append((up.derivatives()[0][0] - down.derivatives()[0][0]) / (2 * step))
    assert np.allclose(hessian, numeric, atol=2e-3 * np.abs(hessian).max())


def test_sizes_keep_directions():
    poses = lifted()
    longer = BODY.with_segment_lengths({k: 1.2 * v for k, v in BODY.segment_lengths.items()})
    first, second = poses.sized(BODY.skeleton), poses.sized(longer.skeleton)
    assert np.allclose(second, 1.2 * first)
    own = bone_lengths(BODY.skeleton, JOINTS)
    knee, hip = JOINTS.index('left_knee'), JOINTS.index('left_hip')
    bone = poses.means[:, knee] - poses.means[:, hip]
    assert np.allclose(first[:, knee] - first[:, hip], bone * own[knee] / poses.lengths[knee])
