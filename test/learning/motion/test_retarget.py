"""Retargeting: exact if the body can follow, close for recorded people, always within limits."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.motion_file import Motion, read_motion, read_skeleton
from hmt_learning.motion.retarget import body_from_motion, retarget
from hmt_ros.body import load_body
from hmt_ros.body.limb_angles import limb_angles

HUMAN = load_body('human37')
PAIRED = ('hip', 'knee', 'ankle', 'shoulder', 'elbow', 'wrist')
MAIN = ('neck', *(f'{side}_{joint}' for side in ('left', 'right') for joint in PAIRED))

# A camera 4 m from the origin, which looks along the world's y axis.
ROTATION = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
CAMERA = (ROTATION, np.array([0.0, 1.0, 4.0]))


def moving(body, frames: int = 40, seed: int = 0, bent: float = 0.6) -> np.ndarray:
    """Smooth poses well inside the limits, with bent elbows and knees."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 2 * np.pi, frames)[:, None]
    lower, upper = np.maximum(body.lower, -1.0), np.minimum(body.upper, 1.0)
    swing = 0.25 * (upper - lower) * np.sin(t + rng.uniform(0, 6, body.dimension))
    poses = 0.5 * (lower + upper) + swing
    poses[:, :6] = 0.0
    poses[:, 0] = 0.3 * np.sin(t[:, 0])
    poses[:, 2] = 4.0
    poses[:, 3] = np.linspace(2.0, 2.0 + 3 * np.pi, frames)  # one and a half turns
    for i, name in enumerate(body.dof_names):
        if name.endswith('clavicle_y'):
            poses[:, i] = 0.0  # they would blur the width of the shoulders
        if name.endswith('elbow'):
            poses[:, i] = bent + 0.3 * np.sin(t[:, 0])
        if name.endswith('knee'):
            poses[:, i] = -bent - 0.3 * np.sin(t[:, 0] + 1)
    return poses


def as_motion(body, poses: np.ndarray, fps: float = 30.0) -> Motion:
    """Poses of a body model as a recorded motion; its world is the camera frame, y down."""
    return Motion('own', body, poses, fps, np.eye(3), 1.0)


@pytest.mark.parametrize('name', ['human37', 'human34', 'human32'])
def test_a_body_follows_its_own_motion(name):
    body = load_body(name).with_segment_lengths({'thigh': 0.44, 'forearm': 0.26, 'trunk': 0.40})
    poses = moving(body)
    motion = as_motion(body, poses)
    measured = body_from_motion(motion, load_body(name))
    for length, value in body.segment_lengths.items():
        assert measured.segment_lengths[length] == pytest.approx(value, abs=1e-9)
    result = retarget(motion, body, (np.eye(3), np.zeros(3)))
    error = np.linalg.norm(body.joint_positions(result) - body.joint_positions(poses), axis=2)
    assert np.median(error) < 0.001
    assert error.max() < 0.006
    assert (result >= body.lower).all()
    assert (result <= body.upper).all()
    # The angles themselves are recovered, without whole turns.
    rotations = body.skeleton.dof_is_rotation
    off = (result - poses)[:, rotations]
    off -= 2 * np.pi * np.round(np.median(off, axis=0) / (2 * np.pi))
    assert np.degrees(np.abs(off)).max() < 6.0
    assert np.median(np.degrees(np.abs(off))) < 0.5


def test_closed_form_alone_is_exact_up_to_the_clavicles():
    body = load_body('human34')
    poses = moving(body)
    joints = body.joint_positions(poses)
    place = dict(zip(body.joint_names, np.moveaxis(joints, 1, 0)))
    start = limb_angles(body.skeleton, place, 30.0)
    rigid = [body.dof_names.index(n) for n in ('root_tx', 'root_ty', 'root_tz')]
    np.testing.assert_allclose(start[:, rigid], poses[:, rigid], atol=1e-9)
    error = np.linalg.norm(body.joint_positions(start) - joints, axis=2)
    assert np.median(error) < 0.02
    assert error.max() < 0.12  # the trunk is found from hips, neck and shoulders together


def test_root_turns_on_without_a_jump():
    body = HUMAN
    poses = moving(body, frames=80)
    result = retarget(as_motion(body, poses), body, (np.eye(3), np.zeros(3)))
    yaw = result[:, body.dof_names.index('root_z')]
    assert np.ptp(yaw) == pytest.approx(3 * np.pi, abs=0.05)
    assert np.abs(np.diff(yaw)).max() < 0.3


@pytest.mark.parametrize(
    ('name', 'median', 'most'),
    [
        ('train/cmu_02_01_walk.bvh', 0.004, 0.016),
        ('train/cmu_run_a.bvh', 0.004, 0.019),
        ('train/cmu_02_03_run.bvh', 0.004, 0.025),  # rotated rest frames, hands of no length
        ('train/cmu_131_04_dance.amc', 0.006, 0.012),
        ('train/cmu_60_12_salsa.bvh', 0.004, 0.020),  # hips above the pelvis
        ('train/cmu_12_01_walk.bvh', 0.008, 0.030),
    ],
)
def test_recorded_people_are_followed_closely(name, median, most, mocap):
    motion = read_motion(mocap / name)
    motion = motion.part(0, 200, 2)
    body = body_from_motion(motion, HUMAN)
    pelvis = motion.joint_positions(['pelvis'])[:, 0]
    translation = -ROTATION @ pelvis.mean(0) + [0, 0, 5.0 + np.ptp(pelvis[:, 1])]
    poses = retarget(motion, body, (ROTATION, translation))
    wanted = motion.joint_positions(MAIN) @ ROTATION.T + translation
    error = np.linalg.norm(
        body.joint_positions(poses)[:, body.skeleton.joint_index(MAIN)] - wanted, axis=2
    )
    assert np.median(error) < median
    assert np.quantile(error, 0.95) < most
    assert (poses >= body.lower).all()
    assert (poses <= body.upper).all()
    assert (poses[:, 2] > 0).all()
    angles = poses[:, body.skeleton.dof_is_rotation]
    # Fast limbs turn by a few hundred degrees a second; a flip would be thousands.
    assert np.degrees(np.abs(np.diff(angles, axis=0))).max() * motion.fps < 1500
    again = retarget(motion, body, (ROTATION, translation))
    np.testing.assert_array_equal(poses, again)


def test_skeletons_and_bodies_that_do_not_fit_are_refused(tmp_path):
    path = tmp_path / 'rod.bvh'
    path.write_text(
        'HIERARCHY\nROOT rod\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n'
        'End Site\n{\nOFFSET 0 1 0\n}\n}\n'
        'MOTION\nFrames: 1\nFrame Time: 0.1\n0\n'
    )
    rod = read_motion(path)
    with pytest.raises(ValueError, match=r'rod lacks joints .*pelvis.*names are known'):
        retarget(rod, HUMAN, CAMERA)
    with pytest.raises(ValueError, match='rod lacks joints'):
        body_from_motion(rod, HUMAN)
    motion = as_motion(HUMAN, moving(HUMAN)[:2])
    with pytest.raises(ValueError, match=r'rod has no lengths .*thigh.* like human37'):
        body_from_motion(motion, read_skeleton(path))
