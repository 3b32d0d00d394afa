"""The bundled bodies: names, symmetry, lengths, stature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward

BODIES = {name: load_body(name) for name in ('human37', 'human34', 'human32')}


@pytest.fixture(params=sorted(BODIES))
def body(request):
    return BODIES[request.param]


def standing(body) -> np.ndarray:
    """An upright pose in front of the camera, every joint at rest."""
    pose = np.zeros((1, body.dimension))
    pose[0, body.skeleton.dof_index(('root_tz',))] = 4.0
    return pose


def mirrored(body, poses: np.ndarray) -> np.ndarray:
    """The poses in a mirror in the plane x = 0 of the camera."""
    result = np.empty_like(poses)
    for i, name in enumerate(body.dof_names):
        other = name
        for side, opposite in (('left_', 'right_'), ('right_', 'left_')):
            if name.startswith(side):
                other = opposite + name.removeprefix(side)
        axis, turns = int(body.skeleton.dof_axes[i]), bool(body.skeleton.dof_is_rotation[i])
        sign = -1.0 if turns == (axis != 0) else 1.0
        result[:, i] = sign * poses[:, body.dof_names.index(other)]
    return result


def test_rates_are_squared_deviations_after_one_second(body):
    deviations = {
        'root_t': 0.25, 'root_': 1.4, 'trunk': 1.2, 'clavicle': 0.3, 'neck': 0.7, 'shoulder': 2.2,
        'elbow': 2.2, 'wrist': 1.2, 'hip': 1.3, 'knee': 1.6, 'ankle': 1.2,
    }  # fmt: skip
    wanted = [next(v for k, v in deviations.items() if k in name) for name in body.dof_names]
    np.testing.assert_allclose(body.rates, np.square(wanted), rtol=1e-15)
    scaled = body.with_stature(1.5)
    assert np.array_equal(scaled.rates, body.rates)
    with pytest.raises(ValueError, match='rates must be'):
        replace(body, rates=body.rates[1:])


def test_a_person_at_rest_stands_upright_and_faces_the_camera(body):
    joints = dict(zip(body.joint_names, body.joint_positions(standing(body))[0]))
    np.testing.assert_allclose(joints['pelvis'], [0, 0, 4], atol=1e-12)
    assert joints['head'][1] < joints['neck'][1] < joints['pelvis'][1]  # y points down
    assert joints['pelvis'][1] < joints['left_knee'][1] < joints['left_ankle'][1]
    assert joints['left_hip'][0] > 0 > joints['right_hip'][0]  # the person's left is our right
    assert joints['left_toe'][2] < joints['left_ankle'][2]  # towards the camera
    lengths = body.segment_lengths
    assert joints['left_hip'][0] - joints['right_hip'][0] == pytest.approx(lengths['hip_width'])
    width = np.linalg.norm(joints['left_shoulder'] - joints['right_shoulder'])
    assert width == pytest.approx(lengths['shoulder_width'])


def test_limits_and_priors_are_symmetric(body):
    for values in (body.lower, body.upper):
        np.testing.assert_array_equal(np.isfinite(values), True)
    ends = np.stack([body.lower, body.upper])
    low, high = np.sort(mirrored(body, ends), axis=0)
    paired = [n.startswith(('left', 'right')) for n in body.dof_names]
    np.testing.assert_allclose(low[paired], body.lower[paired])
    np.testing.assert_allclose(high[paired], body.upper[paired])
    mean = mirrored(body, body.prior_mean[None])[0]
    np.testing.assert_allclose(mean[paired], body.prior_mean[paired], atol=1e-12)
    inside = (body.lower <= body.prior_mean) & (body.prior_mean <= body.upper)
    assert inside[body.skeleton.dof_is_rotation].all()


@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(sorted(BODIES)))
def test_a_mirrored_pose_has_mirrored_joints(seed, name):
    body = BODIES[name]
    poses = np.random.default_rng(seed).uniform(-1.5, 1.5, size=(2, body.dimension))
    joints = body.joint_positions(poses)
    other = body.joint_positions(mirrored(body, poses))
    opposite = [
        n.replace('left', '*').replace('right', 'left').replace('*', 'right')
        for n in body.joint_names
    ]
    expected = joints[:, body.skeleton.joint_index(tuple(opposite))] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(other, expected, atol=1e-9)


def test_smaller_bodies_are_human37_with_joints_held_at_zero(random_poses):
    whole = BODIES['human37']
    for name in ('human34', 'human32'):
        part = BODIES[name]
        poses = random_poses(part, 3, 2)
        same = np.zeros((3, whole.dimension))
        same[:, whole.skeleton.dof_index(part.dof_names)] = poses
        np.testing.assert_allclose(
            part.joint_positions(poses), whole.joint_positions(same), atol=1e-12
        )


def test_stature_is_the_height_of_the_person(body):
    lengths = body.segment_lengths
    upright = ('hip_drop', 'thigh', 'shin', 'trunk', 'neck_to_head')
    assert body.stature == pytest.approx(sum(lengths[n] for n in upright) + body.stature_extra)
    assert 1.6 < body.stature < 1.8
    mesh = body.flesh.mesh()
    points = forward(body.skeleton, standing(body)).points(mesh.segments, mesh.vertices)[..., 0]
    height = points[:, 1].max() - points[:, 1].min()
    assert height == pytest.approx(body.stature, abs=0.08)


@given(stature=st.floats(0.5, 2.5), name=st.sampled_from(sorted(BODIES)))
def test_with_stature_scales_every_joint(stature, name):
    body = BODIES[name]
    other = body.with_stature(stature)
    assert other.stature == pytest.approx(stature)
    assert body.stature != pytest.approx(0.1)
    pose = standing(body)
    factor = stature / body.stature
    centre = pose[0, :3]
    before, after = (b.joint_positions(pose)[0] - centre for b in (body, other))
    np.testing.assert_allclose(after, factor * before, atol=1e-12)
    for small, large in zip(body.flesh.parts, other.flesh.parts):
        np.testing.assert_allclose(large.radii, factor * np.array(small.radii), rtol=0.02)


def test_wrong_lengths_are_refused(body):
    with pytest.raises(KeyError, match=r'no length .*upper_leg.*it has .*thigh'):
        body.with_segment_lengths({'upper_leg': 0.4})
    with pytest.raises(ValueError, match='lengths must be finite'):
        body.with_segment_lengths({'thigh': float('nan')})
    for stature in (0.0, -1.0, float('nan'), float('inf')):
        with pytest.raises(ValueError, match='stature must be a positive number of metres'):
            body.with_stature(stature)
