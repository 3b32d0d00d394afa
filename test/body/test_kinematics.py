"""Kinematics and Jacobians compared with Pinocchio, finite differences and dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_learning.motion.motion_file import read_skeleton
from hmt_ros.body import Body, load_body
from hmt_ros.body.kinematics import (
    directed_derivatives,
    forward,
    joint_length_jacobians,
    point_energy,
    point_jacobians,
)
from test.oracles.numpy_kinematics import assemble, segment_sums

BODIES = {name: load_body(name) for name in ('human37', 'human34', 'human32')}
STEP = 1e-6

# Another order of angles, a sliding inner joint, and a root with its translations last.
SLIDING = """HIERARCHY
ROOT base
{
  OFFSET 0 0 0
  CHANNELS 6 Yrotation Xrotation Zrotation Zposition Xposition Yposition
  JOINT slider
  {
    OFFSET 0.1 0.5 -0.2
    CHANNELS 3 Xposition Zrotation Yrotation
    JOINT plain
    {
      OFFSET 0 0.3 0
      CHANNELS 0
      End Site
      {
        OFFSET 0.05 0.2 0
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.05
10 20 30 0.1 0.2 0.3 0.01 40 50
20 30 40 0.2 0.3 0.4 0.02 50 60
"""


@pytest.fixture(scope='module')
def sliding_body(tmp_path_factory) -> Body:
    path = tmp_path_factory.mktemp('motion') / 'sliding.bvh'
    path.write_text(SLIDING)
    return read_skeleton(path, unit_to_m=1.0)


@pytest.fixture(scope='module', params=[*BODIES, 'sliding', 'mocap'])
def body(request) -> Body:
    if request.param == 'sliding':
        return request.getfixturevalue('sliding_body')
    if request.param == 'mocap':
        folder = request.getfixturevalue('mocap')
        return read_skeleton(folder / 'train' / 'cmu_07_05_slowwalk.asf')
    return BODIES[request.param]


def pinocchio_model(body: Body):
    """The skeleton as a Pinocchio model, and joint and placement of each segment."""
    pin = pytest.importorskip('pinocchio')
    kinds = {
        (0, True): pin.JointModelRX, (1, True): pin.JointModelRY, (2, True): pin.JointModelRZ,
        (0, False): pin.JointModelPX, (1, False): pin.JointModelPY, (2, False): pin.JointModelPZ,
    }  # fmt: skip
    s = body.skeleton
    model = pin.Model()
    at = []
    for i, parent in enumerate(s.parents):
        joint, place = at[parent] if parent >= 0 else (0, pin.SE3.Identity())
        place = place * pin.SE3(np.eye(3), s.offsets[i])
        mounted = False
        for dof in s.segment_dofs[i]:
            if s.dof_is_rotation[dof] and not mounted:
                place, mounted = place * pin.SE3(s.mounts[i], np.zeros(3)), True
            kind = kinds[int(s.dof_axes[dof]), bool(s.dof_is_rotation[dof])]()
            joint = model.addJoint(joint, kind, place, s.dof_names[dof])
            place = pin.SE3.Identity()
        if not mounted:
            place = place * pin.SE3(s.mounts[i], np.zeros(3))
        at.append((joint, place))
    return pin, model, at


def test_joints_and_jacobians_equal_pinocchio(body, random_poses):
    pin, model, at = pinocchio_model(body)
    data = model.createData()
    s = body.skeleton
    poses = random_poses(body, 5, 1)
    joints, jacobians = body.joint_positions(poses), body.joint_jacobians(poses)
    for q, own, own_jacobian in zip(poses, joints, jacobians):
        pin.computeJointJacobians(model, data, q)
        for j, segment in enumerate(s.joint_segments):
            joint, place = at[segment]
            local = place.act(s.joint_offsets[j])
            np.testing.assert_allclose(own[j], data.oMi[joint].act(local), atol=1e-9)
            twist = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            arm = data.oMi[joint].rotation @ local
            expected = twist[:3] - pin.skew(arm) @ twist[3:]
            np.testing.assert_allclose(own_jacobian[j], expected, atol=1e-9)


def test_jacobians_equal_central_differences(body, random_poses):
    poses = random_poses(body, 3, 2)
    jacobians = body.joint_jacobians(poses)
    for k in range(body.dimension):
        step = np.zeros(body.dimension)
        step[k] = STEP
        difference = body.joint_positions(poses + step) - body.joint_positions(poses - step)
        np.testing.assert_allclose(jacobians[..., k], difference / (2 * STEP), atol=1e-8)


def test_length_jacobians_equal_central_differences(body, random_poses):
    poses = random_poses(body, 3, 3)
    jacobians = joint_length_jacobians(body.skeleton, poses)
    assert jacobians.shape == (3, len(body.joint_names), 3, len(body.segment_lengths))
    for k, (name, length) in enumerate(body.segment_lengths.items()):
        more, less = (body.with_segment_lengths({name: length + x}) for x in (STEP, -STEP))
        difference = more.joint_positions(poses) - less.joint_positions(poses)
        np.testing.assert_allclose(jacobians[..., k], difference / (2 * STEP), atol=1e-8)


def random_points(body: Body, poses: np.ndarray, per_segment: int, seed: int):
    rng = np.random.default_rng(seed)
    segments = np.repeat(np.arange(len(body.skeleton.parents)), per_segment)
    rng.shuffle(segments)
    frames = forward(body.skeleton, poses)
    points = frames.points(segments, rng.normal(0, 0.2, (len(segments), 3)))
    return rng, segments, frames, points


def pose_by_pose(points):
    return np.ascontiguousarray(points.transpose(2, 0, 1))


def test_assembled_gradient_and_hessian_equal_the_dense_ones(body, random_poses):
    poses = random_poses(body, 4, 4)
    rng, segments, frames, points = random_points(body, poses, 3, 5)
    directions = rng.normal(size=points.shape)
    pull = rng.normal(size=(len(segments), len(poses)))
    curvature = rng.uniform(0, 2, size=pull.shape)
    sums = segment_sums(segments, points, directions, pull, curvature, len(body.skeleton.parents))
    gradient, hessian = assemble(frames, *sums)
    jacobian = point_jacobians(frames, segments, pose_by_pose(points))
    along = np.einsum('npid,pin->npd', jacobian, directions)  # derivative of each residual
    expected = np.einsum('npd,pn->nd', along, pull)
    dense = np.einsum('npd,pn,npe->nde', along, curvature, along)
    np.testing.assert_allclose(gradient, expected, atol=1e-10)
    np.testing.assert_allclose(hessian, dense, atol=1e-10)
    assert np.linalg.eigvalsh(hessian).min() > -1e-9


def test_energy_of_points_equals_the_dense_one(body, random_poses):
    poses = random_poses(body, 4, 6)
    rng = np.random.default_rng(7)
    segments = rng.integers(len(body.skeleton.parents), size=9)
    local = rng.normal(0, 0.2, (9, 3))
    targets, across = rng.normal(size=(4, 9, 3)), rng.normal(size=(4, 9, 2, 3))
    frames = forward(body.skeleton, poses)
    value, gradient, hessian = point_energy(frames, segments, local, targets, across)
    places = frames.places(segments, local)
    residuals = np.einsum('npri,npi->npr', across, places - targets)
    slopes = across @ point_jacobians(frames, segments, places)
    np.testing.assert_allclose(value, 0.5 * np.square(residuals).sum((1, 2)), rtol=1e-12)
    np.testing.assert_allclose(gradient, np.einsum('npr,nprd->nd', residuals, slopes), atol=1e-10)
    dense = np.einsum('nprd,npre->nde', slopes, slopes)
    np.testing.assert_allclose(hessian, dense, atol=1e-10)
    with pytest.raises(ValueError, match='across'):
        point_energy(frames, segments, local, targets, across[:, :5])


def test_point_jacobians_equal_central_differences(body, random_poses):
    poses = random_poses(body, 2, 8)
    rng = np.random.default_rng(9)
    segments = np.arange(len(body.skeleton.parents))
    local = rng.normal(0, 0.2, (len(segments), 3))
    frames = forward(body.skeleton, poses)
    jacobian = point_jacobians(frames, segments, frames.places(segments, local))
    for k in range(body.dimension):
        step = np.zeros(body.dimension)
        step[k] = STEP
        ahead, behind = (
            forward(body.skeleton, poses + x).places(segments, local) for x in (step, -step)
        )
        np.testing.assert_allclose(jacobian[..., k], (ahead - behind) / (2 * STEP), atol=1e-8)


def test_directed_derivatives_equal_the_jacobians(body, random_poses):
    rng, segments, frames, points = random_points(body, random_poses(body, 1, 11), 3, 12)
    directions = rng.normal(size=(len(segments), 3))
    found = directed_derivatives(frames, segments, points[..., 0], directions)
    jacobian = point_jacobians(frames, segments, pose_by_pose(points))[0]
    np.testing.assert_allclose(found, np.einsum('mid,mi->md', jacobian, directions), atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(sorted(BODIES)))
def test_a_pose_moves_no_point_within_its_segment(seed, name):
    """Frames are right-handed and orthonormal, and bones keep their lengths, at any angles."""
    body = BODIES[name]
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-10, 10, size=(2, body.dimension))
    rotations = forward(body.skeleton, poses).rotations()
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(2, 3), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)
    joints = body.joint_positions(poses)
    lengths = body.segment_lengths
    for side in ('left', 'right'):
        for bone, a, b in (
            ('thigh', 'hip', 'knee'), ('shin', 'knee', 'ankle'), ('foot', 'ankle', 'toe'),
            ('upper_arm', 'shoulder', 'elbow'), ('forearm', 'elbow', 'wrist'),
            ('hand', 'wrist', 'hand'),
        ):  # fmt: skip
            i, j = body.skeleton.joint_index((f'{side}_{a}', f'{side}_{b}'))
            span = np.linalg.norm(joints[:, i] - joints[:, j], axis=1)
            np.testing.assert_allclose(span, lengths[bone], atol=1e-9)


@pytest.mark.parametrize(
    ('poses', 'message'),
    [
        (np.zeros(37), r'shape \(N, 37\), saw \(37,\)'),
        (np.zeros((2, 36)), r'shape \(N, 37\), saw \(2, 36\)'),
        (np.full((1, 37), np.nan), 'finite'),
        (np.full((1, 37), np.inf), 'finite'),
    ],
)
def test_wrong_poses_are_refused(poses, message):
    with pytest.raises(ValueError, match=message):
        BODIES['human37'].joint_positions(poses)
