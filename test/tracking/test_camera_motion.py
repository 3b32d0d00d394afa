"""A moving camera: transformed states, and tracks that do not depend on the motion."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_ros.body import Body, load_body
from hmt_ros.body.camera_pose import CameraPose
from hmt_ros.body.kinematics import forward, point_energy
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.energy import Derivatives, Energy
from hmt_ros.tracking import GroundSettings, KnownGround, Tracker, TrackerSettings
from hmt_ros.tracking.camera_motion import CameraMotion, CameraPath
from hmt_ros.tracking.classes import ways, weigh_ways
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import Modes, new_hypotheses
from hmt_ros.tracking.prediction import dynamics_of, predicted_states
from hmt_ros.tracking.settings import MAX_EXTRAPOLATION_TIME
from hmt_ros.tracking.weighting import TransitionPrior

FRAME = 100_000_000  # ns
UP = np.array([0.0, -1.0, 0.0])
NO_IMAGE = LikelihoodSettings.of_terms(keypoints=LikelihoodSettings().keypoints)


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def walking(body):
    """Poses (20, d) in the frame of a fixed camera, 10 Hz."""
    return procedural_motion('walk', body, 2.0, 10.0, 1)


def drive(t, pitch=0.0):
    """Pose of a camera that moves sideways at 0.8 m/s and turns by 20 degrees per second."""
    turn = Rotation.from_euler('yx', [-20.0 * t, pitch], degrees=True).as_matrix()
    return CameraPose.of([0.8 * t, -0.1 * t, 0.05 * np.sin(t)], turn)


def motion_of(t, pitch=0.0):
    found = CameraMotion.between(CameraPose.of(np.zeros(3), np.eye(3)), drive(t, pitch))
    assert found is not None
    return found


def modes_of(body, poses, seed=0):
    """Modes with velocities and full covariances of states."""
    k, d = poses.shape
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(k, 2 * d, 2 * d)) * 0.05 / np.sqrt(d)
    states = root @ root.transpose(0, 2, 1) + 1e-5 * np.eye(2 * d)
    velocities = rng.normal(size=(k, d))
    own = np.ascontiguousarray(states[:, :d, :d])
    return replace(
        Modes.blank(*poses.shape),
        **vars(new_hypotheses(poses, np.zeros(k))),
        velocities=velocities,
        covariances=own,
        filtered=own,
        state_covariances=states,
    )


# Transformed states.


@pytest.mark.parametrize('pitch', [0.0, 25.0])
def test_joints_of_carried_poses_stand_where_they_stood(body, walking, pitch):
    motion = motion_of(0.7, pitch)
    before, after = body.joint_positions(walking), motion.poses(body, walking)
    np.testing.assert_allclose(body.joint_positions(after), motion.points(before), atol=1e-9)
    # Angles do not jump by a whole turn.
    assert np.abs(after - walking)[:, 3].max() < 1.0


@pytest.mark.parametrize('pitch', [0.0, 25.0])
def test_jacobians_are_the_derivatives(body, walking, pitch):
    motion, poses, step = motion_of(0.7, pitch), walking[:3], 1e-6
    found = motion.jacobians(body, poses, motion.poses(body, poses))
    for j in range(body.dimension):
        moved = [poses + sign * step * np.eye(body.dimension)[j] for sign in (1.0, -1.0)]
        high, low = (motion.poses(body, x) for x in moved)
        np.testing.assert_allclose(found[:, :, j], (high - low) / (2 * step), atol=1e-6)


def test_carrying_and_predicting_commute(body, walking):
    """For a level camera that turns about the vertical, the dynamics are those of the world."""
    modes, motion = modes_of(body, walking[:3]), motion_of(0.3)
    dynamics = dynamics_of(body, 'learned')

    def predicted(x):
        states = predicted_states(x, x.state_covariances, body, dynamics, 0.1)
        d = body.dimension
        return replace(
            x,
            poses=states.poses,
            velocities=states.means[:, d:],
            state_covariances=states.covariances,
        )

    first = predicted(motion.modes(body, modes))
    other = motion.modes(body, predicted(modes))
    for name in ('poses', 'velocities', 'state_covariances'):
        np.testing.assert_allclose(getattr(first, name), getattr(other, name), atol=1e-7)
    # Without the transformation the prediction differs.
    assert np.abs(first.poses - predicted(modes).poses).max() > 0.1


def test_feet_rest_before_a_moving_camera(body):
    """A standing person stands; without the camera's motion the feet would slide."""
    standing = np.repeat(
        procedural_motion('reach', body, 0.1, 10.0, 1)[:1], 15, axis=0
    )  # fmt: skip
    found = []
    for carried in (True, False):
        rested, estimator = None, GroundEstimator(KnownGround(UP, 1.0))
        estimator.still = True
        before = drive(0.0)
        for t, pose in enumerate(standing):
            now = drive(0.1 * t)
            seen = CameraMotion.between(drive(0.0), now)
            modes = modes_of(body, pose[None] if seen is None else seen.poses(body, pose[None]))
            modes = replace(modes, velocities=np.zeros_like(modes.velocities))
            step = CameraMotion.between(before, now)
            if step is not None and carried:
                rested = step.modes(body, rested)
                estimator.carry(step)
            rested = estimator.with_contacts(body, modes, rested, 0.1)
            estimator.update(body, modes, 1.0, 0.1)
            before = now
        found.append(max(estimator.by_foot(rested).values()))
    assert found[0] > 0.8
    assert found[1] < 0.3


def test_ways_to_face_are_carried(body):
    """Front or back view is determined again; the evidence so far is unchanged."""
    poses = np.tile(body.prior_mean, (3, 1))
    poses[:, 2] = 4.0
    heading = body.dof_names.index('root_z')
    poses[:, heading] += np.radians([30.0, 210.0, -30.0])
    odds = np.array([3.0, -3.0, 3.0])
    joints = body.joint_positions(poses)
    modes = replace(modes_of(body, poses), back=ways(body, joints, joints[0]), facing=odds)
    assert modes.back.tolist() == [False, True, False]
    for degrees, back in ((90.0, [False, True, True]), (20.0, [False, True, False])):
        # Around the person: one of two modes in front view changes to the back view.
        around = Rotation.from_euler('y', degrees, degrees=True).as_matrix()
        place = np.array([0.0, 0.0, 4.0])
        still = CameraPose.of(np.zeros(3), np.eye(3))
        motion = CameraMotion.between(still, CameraPose.of(place - around @ place, around))
        carried = motion.modes(body, modes)
        assert carried.back.tolist() == back
        assert np.array_equal(carried.facing, odds)
        # An image without information does not change the weights of the two facings.
        found = []
        for some in (modes[:2], carried[:2]):
            nothing = np.zeros(2)
            transitions = np.full((2, 2), -20.0)
            transition_prior = TransitionPrior(body, some.poses, nothing, 0.1)
            found.append(
                weigh_ways(
                    some, transition_prior, transition_prior.joints, transitions, nothing, nothing,
                    np.ones(2, dtype=np.bool_),
                )[:2]
            )  # fmt: skip
        np.testing.assert_allclose(found[1], found[0])
        assert 2.0 < found[0][0][0] - found[0][0][1] < 3.0


# The path of the camera.


def test_a_path_interpolates_and_goes_on():
    path, poses = CameraPath(), [drive(0.1 * i) for i in range(12)]

    def check(found, a, b, atol):
        wanted = CameraMotion.between(a, b)
        assert found is not None
        assert wanted is not None
        np.testing.assert_allclose(found.rotation, wanted.rotation, atol=atol)
        np.testing.assert_allclose(found.translation, wanted.translation, atol=atol)

    assert path.advance(0, None) is None
    assert not path.known
    assert path.advance(FRAME, poses[1]) is None
    check(path.advance(2 * FRAME, poses[2]), poses[1], poses[2], 1e-12)
    # Two images without a pose: extrapolated, up to the acceleration.
    for i in (3, 4):
        check(path.advance(i * FRAME, None), poses[i - 1], poses[i], 2e-3)
        assert path.known
    # An extrapolation does not affect the next given pose.
    check(path.advance(5 * FRAME, poses[5]), poses[4], poses[5], 2e-3)
    # A pose between two images is not used.
    check(path.advance(6 * FRAME, poses[6]), poses[5], poses[6], 1e-12)
    for i in range(7, 11):
        path.advance(i * FRAME, None)
    assert path.known
    assert path.advance(int((6 + 10 * MAX_EXTRAPOLATION_TIME) * FRAME) + FRAME, None) is None
    assert not path.known


@pytest.mark.parametrize(
    ('position', 'rotation', 'why'),
    [
        ([0.0, np.nan, 0.0], np.eye(3), 'three finite numbers'),
        ([0.0, 0.0], np.eye(3), 'three finite numbers'),
        (np.zeros(3), np.eye(2), 'rotation matrix'),
        (np.zeros(3), np.full((3, 3), np.nan), 'rotation matrix'),
        (np.zeros(3), 1.1 * np.eye(3), 'rotation matrix'),
        (np.zeros(3), np.diag([1.0, 1.0, -1.0]), 'rotation matrix'),
    ],
)
def test_what_is_no_pose(body, camera, position, rotation, why):
    with pytest.raises(ValueError, match=why):
        Tracker(body, camera).set_camera(position, rotation)


# Tracks.


@dataclass
class Places:
    """Joints of one person as a measurement in three dimensions: a `FrameTerm`."""

    body: Body
    targets: np.ndarray
    sigma: float = 0.01

    def energy(self, frames, rows, *, derivatives=Derivatives.POSITIVE):
        skeleton, n = self.body.skeleton, frames.count
        targets = np.repeat(self.targets[None], n, axis=0)
        across = np.broadcast_to(np.eye(3) / self.sigma, (*targets.shape, 3))
        found = point_energy(
            frames, skeleton.joint_segments, skeleton.joint_offsets, targets, across
        )
        return Energy(*found) if derivatives else Energy(found[0])


@pytest.fixture(scope='module')
def track(body, camera, walking):
    """Function (pose of the camera by time) -> a tracker of joint positions, and its results.

    The measurements are taken in the fixed frame, so that they do not depend on the camera.
    """

    def run(path, *, told, background=None, frames=10):
        black = np.zeros((camera.height, camera.width, 3), np.uint8)
        settings = TrackerSettings(
            max_hypotheses=1, candidates=2, likelihood=NO_IMAGE, flow_weight=0.0,
            estimate_shape=False, ground=GroundSettings(0.0, 0.0), iterations=12,
        )  # fmt: skip
        term = Places(body, np.zeros((1, 3)))
        tracker = Tracker(body, camera, settings, background, extra=[term])
        start = path(0.0)
        began = CameraMotion.between(drive(0.0), start)
        first = walking[:1] if began is None else began.poses(body, walking[:1])
        covariance = 1e-2 * np.eye(body.dimension)[None]
        tracker.reset(GaussianMixture(np.ones(1), first, covariance))
        found = []
        for t in range(frames):
            pose = path(0.1 * t)
            joints = body.joint_positions(walking[t : t + 1])[0]
            term.targets = (joints - pose.position) @ pose.rotation
            if told:
                tracker.set_camera(pose.position, pose.rotation)
            posterior, likelihood = tracker.step(black, t * FRAME)
            found.append(
                (posterior, likelihood, tracker.estimate.modes, tracker.estimate.point_estimate)
            )
        return tracker, found

    return run


def still(t):
    return drive(0.0)


def in_bytes(found):
    return [
        array.tobytes()
        for posterior, likelihood, modes, point in found
        for array in (
            *(x for m in (posterior, likelihood) for x in (m.weights, m.means, m.covariances)),
            modes.velocities,
            modes.state_covariances,
            point,
        )
    ]


def test_a_told_camera_that_stands_still_changes_no_bit(track, camera):
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    silent, told = (
        track(still, told=told, background=BackgroundModel.from_image(black))
        for told in (False, True)
    )
    assert in_bytes(silent[1]) == in_bytes(told[1])
    assert silent[0].estimate.contacts == told[0].estimate.contacts


def test_what_a_moving_camera_sees_is_what_a_still_one_sees(body, track):
    """Poses, velocities and covariances are those of the fixed camera, in another frame."""
    _, moving = track(drive, told=True)
    _, resting = track(still, told=False)
    _, untold = track(drive, told=False)
    gaps, slips = [], []
    for t in range(1, 10):
        motion = motion_of(0.1 * t)
        wanted = motion.modes(body, resting[t][2][np.zeros(1, dtype=np.intp)])
        found = moving[t][2]
        np.testing.assert_allclose(found.poses[0], wanted.poses[0], atol=2e-3)
        np.testing.assert_allclose(found.velocities[0], wanted.velocities[0], atol=2e-2)
        np.testing.assert_allclose(
            found.state_covariances[0], wanted.state_covariances[0], atol=2e-3
        )
        pelvis = [body.joint_positions(x[None])[0, 0] for x in (moving[t][3], resting[t][3])]
        gaps.append(np.linalg.norm(pelvis[0] - motion.points(pelvis[1])))
        slips.append(np.linalg.norm(untold[t][2].velocities[0, :3] - wanted.velocities[0, :3]))
    assert max(gaps) < 2e-3
    # Without the camera's pose its motion is taken for the person's.
    assert np.mean(slips[4:]) > 0.5


def test_frames_of_a_pose_are_the_carried_ones(body, walking):
    motion = motion_of(0.4, 10.0)
    one = forward(body.skeleton, walking[:2])
    other = forward(body.skeleton, motion.poses(body, walking[:2]))
    np.testing.assert_allclose(other.rotations(), motion.rotation @ one.rotations(), atol=1e-9)
