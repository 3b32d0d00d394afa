import numpy as np
import pytest

from hmt_learning.motion.limb_motions import (
    ahead,
    arm_posture,
    sole,
)
from hmt_learning.motion.procedural_motion import (
    PROCEDURAL_MOTIONS,
    procedural_motion,
)
from hmt_learning.motion.self_intersection import self_intersection_energy
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward

VIEW = Viewpoint()
FPS = 20.0
CASES = [
    (name, model, stature, seed)
    for name in sorted(PROCEDURAL_MOTIONS)
    for model, stature, seed in (('human37', 1.7, 0), ('human34', 1.95, 1), ('human32', 1.5, 2))
]


@pytest.fixture(scope='module', params=CASES, ids=lambda case: '-'.join(map(str, case[:2])))
def motion(request):
    """Name, body, poses, and joints in the world frame."""
    name, model, stature, seed = request.param
    body = load_body(model).with_stature(stature)
    poses = procedural_motion(name, body, 4.0, FPS, seed)
    return name, body, poses, VIEW.to_world(body.joint_positions(poses))


def of(body, joints, name):
    return joints[:, body.skeleton.joint_index((name,))[0]]


def test_within_the_limits_of_the_joints(motion):
    _, body, poses, _ = motion
    assert poses.shape == (80, body.dimension)
    assert np.all(poses >= body.lower)
    assert np.all(poses <= body.upper)


def test_continuous(motion):
    _, _, poses, joints = motion
    assert np.linalg.norm(np.diff(joints, axis=0), axis=2).max() * FPS < 6.0  # m/s
    assert np.abs(np.diff(poses[:, 3:], axis=0)).max() * FPS < 12.0  # rad/s


def test_stands_on_the_floor(motion):
    _, body, poses, joints = motion
    mesh = body.flesh.mesh()
    points = forward(body.skeleton, poses).points(mesh.segments, mesh.vertices)
    lowest = VIEW.to_world(points.transpose(2, 0, 1))[..., 2].min(1)
    assert np.abs(lowest).max() < 0.03
    # At least one foot is at rest; the other may turn about its toe.
    speeds = [
        np.linalg.norm(np.diff(of(body, joints, f'{side}_toe'), axis=0), axis=1) * FPS
        for side in ('left', 'right')
    ]
    assert np.minimum(*speeds).max() < 0.25
    assert np.median(np.minimum(*speeds)) < 0.01


def test_no_part_runs_through_another(motion):
    _, body, poses, _ = motion
    energy = self_intersection_energy(body, poses, sigma=1.0)
    # The part of the overlap that exceeds the tolerance of 2 cm.
    assert np.sqrt(2 * energy.max()) < 0.015


@pytest.mark.parametrize('name', sorted(PROCEDURAL_MOTIONS))
def test_the_rate_only_samples_the_motion(name):
    body = load_body('human37')
    slow = procedural_motion(name, body, 2.0, 10, 4)
    fast = procedural_motion(name, body, 2.0, 30, 4)
    assert np.abs(fast[::3] - slow).max() < 1e-6
    assert np.array_equal(slow, procedural_motion(name, load_body('human37'), 2.0, 10, 4))
    assert np.abs(slow - procedural_motion(name, body, 2.0, 10, 5)).max() > 0.1


@pytest.mark.parametrize('name', sorted(PROCEDURAL_MOTIONS))
def test_the_viewpoint_moves_the_camera_only(name):
    body = load_body('human37')
    tilted = Viewpoint(distance=4.0, height=2.5, pitch=0.4)
    level = VIEW.to_world(body.joint_positions(procedural_motion(name, body, 1.0, 10, 1)))
    poses = procedural_motion(name, body, 1.0, 10, 1, viewpoint=tilted)
    assert np.abs(tilted.to_world(body.joint_positions(poses)) - level).max() < 2e-3


@pytest.mark.parametrize('heading', [0.0, 1.2, -2.0])
def test_walks_where_it_is_to_go(heading):
    body = load_body('human37')
    joints = VIEW.to_world(
        body.joint_positions(procedural_motion('walk', body, 3.0, 20, 0, heading=heading))
    )
    pelvis = of(body, joints, 'pelvis')[:, :2]
    gone = pelvis[-1] - pelvis[0]
    forwards = ahead(heading)
    assert gone @ forwards / np.linalg.norm(gone) > 0.999
    assert 0.8 < np.linalg.norm(gone) / 2.95 < 1.4  # m/s
    assert np.abs(pelvis[[0, -1]].mean(0)).max() < 0.1
    # The person faces the walking direction: the left hip is on the left.
    across = (of(body, joints, 'right_hip') - of(body, joints, 'left_hip'))[:, :2]
    assert np.all(across @ ahead(heading - np.pi / 2) > 0.15)

    # Arm and leg of a side swing in opposite directions.
    def swing(joint, base):
        away = (of(body, joints, joint) - of(body, joints, base))[:, :2] @ forwards
        return away - away.mean()

    for side in ('left', 'right'):
        leg = swing(f'{side}_ankle', 'pelvis')
        arm = swing(f'{side}_wrist', 'neck')
        assert np.corrcoef(leg, arm)[0, 1] < -0.9
    legs = np.corrcoef(swing('left_ankle', 'pelvis'), swing('right_ankle', 'pelvis'))
    assert legs[0, 1] < -0.8
    # The pelvis rises and falls, by a few cm, twice a stride.
    height = of(body, joints, 'pelvis')[:, 2]
    assert 0.01 < np.ptp(height) < 0.07


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (('swim', 1.0, 10), r"no motion 'swim': wanted one of \['dance', 'reach', 'walk'\]"),
        (('walk', 0.0, 10), 'one frame at least'),
        (('walk', 1.0, -10), 'one frame at least'),
        (('walk', np.nan, 10), 'one frame at least'),
    ],
)
def test_bad_arguments(arguments, message):
    name, duration, fps = arguments
    with pytest.raises(ValueError, match=message):
        procedural_motion(name, load_body('human32'), duration, fps)


def test_arm_posture_points_where_it_is_to():
    body = load_body('human37')
    upper = np.array([[-0.3, 0.4, -0.87], [0.6, 0.7, 0.39]])
    fore = np.array([[0.1, 0.99, 0.1], [0.2, 0.5, 0.84]])
    upper /= np.linalg.norm(upper, axis=1, keepdims=True)
    fore /= np.linalg.norm(fore, axis=1, keepdims=True)
    pose = np.zeros((1, body.dimension))
    for name, angle in arm_posture(body, upper, fore).items():
        pose[0, body.dof_names.index(name)] = angle
    joints = VIEW.to_world(body.joint_positions(pose))
    for k, side in enumerate(('left', 'right')):
        shoulder, elbow, wrist = (
            of(body, joints, f'{side}_{x}')[0] for x in ('shoulder', 'elbow', 'wrist')
        )
        assert np.allclose((elbow - shoulder) / 0.285, upper[k], atol=0.01)
        assert np.allclose((wrist - elbow) / 0.230, fore[k], atol=0.01)
    with pytest.raises(ValueError, match='miss a posture'):
        arm_posture(body, upper * [[1, 1, 1], [-1, -1, 1]], -fore)


def test_viewpoint():
    view = Viewpoint(distance=5.0, height=1.5, pitch=0.3)
    points = np.random.default_rng(0).normal(size=(7, 3))
    assert np.allclose(view.to_world(view.to_camera(points)), points)
    assert np.allclose(view.rotation @ view.rotation.T, np.eye(3))
    assert np.isclose(np.linalg.det(view.rotation), 1.0)
    assert np.allclose(view.to_camera([0.0, 5.0, 1.5]), 0.0)  # the camera itself
    # Points at the camera's height are above the middle of the image, as it looks down.
    assert np.isclose(view.to_camera([0.0, 0.0, 1.5])[1], -5.0 * np.sin(0.3))
    # A person at rest is upright and faces the camera, with the left side on the image's right.
    body = load_body('human37')
    pose = np.zeros((1, body.dimension))
    pose[0, :3] = Viewpoint().to_camera([0.0, 0.0, 1.0])
    joints = Viewpoint().to_world(body.joint_positions(pose))
    assert np.allclose(of(body, joints, 'pelvis'), [0, 0, 1.0])
    assert of(body, joints, 'head')[0, 2] > 1.5
    assert of(body, joints, 'left_toe')[0, 1] > 0.1
    assert of(body, joints, 'left_hip')[0, 0] < 0 < of(body, joints, 'right_hip')[0, 0]
    assert 0.02 < sole(body) < 0.06
    with pytest.raises(ValueError, match='pitch'):
        Viewpoint(pitch=2.0)
