"""Mixtures in a fixed frame, and their smoothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import load_body
from hmt_ros.body.mirror import root_rotations
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions import smoother_session
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.fixed_frame import OPTICAL_TO_BODY, FixedFrame, upright
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.track_messages import TOPICS
from hmt_ros.sessions.track_start import prepare_start
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.sessions.transform_buffer import TF, Transform
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.keep_out import KeepOutState, keep_out_of
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
    pose_mixture_of,
)
from msg_tools.messages.states import transforms_message


def camera_at(index):
    """Pose in odom of a camera that moves around the person, nods, and rolls a little."""
    turn = Rotation.from_euler('zyx', [0.25 * index, 0.1 * np.sin(index), 0.05]).as_matrix()
    return Transform(turn @ OPTICAL_TO_BODY, np.array([-3.0 + 0.4 * index, 0.2 * index, 1.2]))


def transforms(stamp, index):
    camera = camera_at(index)
    return transforms_message(
        RosbagsMessages(), ['odom'], ['lens'], camera.rotation[None],
        camera.translation[None], stamp,
    )  # fmt: skip


@pytest.fixture
def session(stub_tracker, subject_file, outputs):
    def make(**values):
        values = {
            'subject_file': str(subject_file),
            'fixed_frame': 'odom',
            'publish_in_fixed_frame': True,
            **values,
        }
        return TrackingSession(with_values(FilterParameters(), values), outputs.append)

    return make


@pytest.fixture(scope='module')
def mixture(body):
    rng = np.random.default_rng(1)
    means = np.tile(body.prior_mean, (3, 1))
    means[:, :3] = [[0.1, -0.2, 3.0], [0.4, 0.0, 4.0], [-0.3, 0.1, 3.5]]
    means[:, 3:6] = [[0.4, 0.2, -0.1], [3.0, -0.3, 0.2], [-2.0, 0.1, 0.3]]
    root = rng.normal(size=(3, 37, 37)) * 1e-3
    return GaussianMixture([0.5, 0.3, 0.2], means, root @ root.swapaxes(1, 2) + 1e-8 * np.eye(37))


def test_poses_are_carried_over_exactly(body, mixture):
    fixed = FixedFrame('odom', camera_at(2))
    velocities = np.random.default_rng(2).normal(size=(3, 37))
    found, moved = fixed.placed(body, mixture, velocities)
    joints = fixed.motion.points(body.joint_positions(mixture.means))
    np.testing.assert_allclose(body.joint_positions(found.means), joints, atol=1e-9)
    # Positions in odom agree with those in the camera frame.
    camera = fixed.camera
    seen = body.joint_positions(mixture.means) @ camera.rotation.T + camera.translation
    np.testing.assert_allclose(
        body.joint_positions(found.means) @ OPTICAL_TO_BODY.T, seen, atol=1e-9
    )
    turn = fixed.motion.rotation
    before, after = body.joint_jacobians(mixture.means), body.joint_jacobians(found.means)
    # Velocities and covariances of the joints rotate with the frame.
    speeds = np.einsum('kjad,kd->kja', before, velocities) @ turn.T
    np.testing.assert_allclose(np.einsum('kjad,kd->kja', after, moved), speeds, atol=1e-9)
    wide = np.einsum('kjad,kde,kjbe->kjab', before, mixture.covariances, before)
    np.testing.assert_allclose(
        np.einsum('kjad,kde,kjbe->kjab', after, found.covariances, after),
        turn @ wide @ turn.T,
        atol=1e-12,
    )
    assert np.array_equal(found.weights, mixture.weights)


@pytest.mark.parametrize('heading', np.arange(0.0, 360.0, 75.0))
def test_somebody_who_stands_is_far_from_the_poles(body, heading):
    """For all directions of person and camera."""
    pose = np.tile(body.prior_mean, (1, 1))
    pose[:, 2], pose[:, 3] = 4.0, np.radians(heading)
    one = GaussianMixture([1.0], pose, 1e-4 * np.eye(37)[None])
    for yaw in (0.0, 90.0, 200.0):
        turn = Rotation.from_euler('z', yaw, degrees=True).as_matrix() @ OPTICAL_TO_BODY
        found, _ = FixedFrame('odom', Transform(turn, np.zeros(3))).placed(body, one)
        assert abs(found.means[0, 4]) < 0.1
        sigmas = np.sqrt(np.diagonal(found.covariances[0]))
        assert sigmas.max() < 0.011


def test_a_camera_that_turns_round_gives_no_jump(body):
    """The angle about z is continuous over whole turns, for both facings."""
    pose = np.tile(body.prior_mean, (2, 1))
    pose[:, 2], pose[:, 3] = 4.0, [0.5, 0.5 + np.pi]
    both = GaussianMixture([0.6, 0.4], pose, np.tile(1e-4 * np.eye(37), (2, 1, 1)))
    turn, found = 0.0, []
    for yaw in np.linspace(0.0, 3.0 * np.pi, 40):
        rotation = Rotation.from_euler('z', yaw).as_matrix() @ OPTICAL_TO_BODY
        fixed = FixedFrame('odom', Transform(rotation, np.zeros(3)), turn)
        found.append(fixed.placed(body, both)[0].means[:, 3])
        turn = fixed.turn_of(body, pose[0])
    steps = np.diff(found, axis=0)
    np.testing.assert_allclose(np.abs(steps), 3.0 * np.pi / 39, atol=1e-9)


@pytest.mark.parametrize('up', [[0.0, -1.0, 0.0], [0.1, -0.9, -0.3], [0.0, 0.0, -1.0]])
def test_upright(up):
    up = np.array(up) / np.linalg.norm(up)
    found = upright(up)
    np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    np.testing.assert_allclose(found[:, 2], up)
    # Forward is the viewing direction, or the image's upper edge if the camera looks down.
    assert found[:, 0] @ ([0, 0, 1] if abs(up[1]) > 0.1 else [0, -1, 0]) > 0.9


def read(outputs, topic):
    return [deserialise(o.data, TOPICS[topic].msgtype) for o in outputs if o.topic == topic]


def rotation_of(transform):
    q = transform.transform.rotation
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()


def track(one, small_camera, indices=(0, 1, 2)):
    one.take(CAMERA_INFO, small_camera.info())
    for index in indices:
        one.take(TF, transforms(small_camera.stamp(index), index))
        one.take(IMAGE, small_camera.image(index))


def test_messages_in_the_fixed_frame(session, small_camera, outputs, body):
    plain = []
    track(session(publish_in_fixed_frame=False), small_camera)
    plain, outputs[:] = list(outputs), []
    track(session(), small_camera)
    for topic in ('pose_mixture', 'likelihood_mixture'):
        for index, (seen, found) in enumerate(
            zip(read(plain, topic), read(outputs, topic), strict=True)
        ):
            seen, found = pose_mixture_of(seen), pose_mixture_of(found)
            assert (seen.frame_id, found.frame_id) == ('lens', 'odom_optical')
            camera = camera_at(index)
            joints = seen.joint_positions @ camera.rotation.T + camera.translation
            np.testing.assert_allclose(found.joint_positions @ OPTICAL_TO_BODY.T, joints, atol=1e-9)
            assert np.array_equal(found.identities, seen.identities)
            assert found.state is TrackState.TRACKING
    for index, (seen, found) in enumerate(
        zip(read(plain, 'person_pose'), read(outputs, 'person_pose'), strict=True)
    ):
        assert (seen.header.frame_id, found.header.frame_id) == ('lens', 'odom')
        camera = camera_at(index)
        place, there = (
            np.array([m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z])
            for m in (seen, found)
        )
        np.testing.assert_allclose(there, camera.rotation @ place + camera.translation, atol=1e-9)
    marker = read(outputs, 'markers')[-1].markers[0]
    assert marker.header.frame_id == 'odom'
    # Transforms connect odom to the frame of the mixtures.
    (leads,) = [
        t for t in read(outputs, '/tf')[-1].transforms if t.child_frame_id == 'odom_optical'
    ]
    assert leads.header.frame_id == 'odom'
    np.testing.assert_allclose(rotation_of(leads), OPTICAL_TO_BODY, atol=1e-12)


def test_what_has_no_place_is_not_published(session, small_camera, outputs):
    one = session(input_timeout=0.05)
    track(one, small_camera, (0,))
    outputs.clear()
    handled = [one.take(IMAGE, small_camera.image(index)) for index in (1, 2)]
    texts = [text for each in handled for text in each.faults]
    assert any('its place in fixed_frame' in text for text in texts)
    assert {output.topic for output in outputs} == {'keep_out', 'keep_out_markers'}
    # The person continues from the last known position.
    states = [keep_out_of(message).state for message in read(outputs, 'keep_out')]
    assert set(states) == {KeepOutState.LOST}


def test_a_name_is_needed():
    with pytest.raises(ValueError, match='publish_in_fixed_frame needs the name of fixed_frame'):
        replace(FilterParameters(), publish_in_fixed_frame=True)


def test_no_track_starts_from_a_mixture_in_the_fixed_frame(session, small_camera, outputs):
    one = session()
    track(one, small_camera, (0,))
    (mixture,) = read(outputs, 'pose_mixture')
    with pytest.raises(ValueError, match='frame odom_optical, which does not move: wanted that of'):
        prepare_start(one.parameters, mixture)
    mixture.header.frame_id = 'lens'
    assert prepare_start(one.parameters, mixture).initial is not None


def test_the_smoother_smooths_a_person_before_a_camera_that_moves(
    outputs, monkeypatch, random_walk
):
    """A person at rest in the room is estimated at rest, also behind the origin of odom."""
    monkeypatch.setattr(smoother_session, 'motion_prior', random_walk)
    body = load_body('human37')
    stands = np.tile(body.prior_mean, (1, 1))
    stands[:, 2], stands[:, 3] = -2.0, 2.0
    rng = np.random.default_rng(0)
    speeds = {}
    for in_room in (True, False):
        one = SmootherSession(SmootherParameters(fixed_lag=0.3), outputs.append)
        outputs.clear()
        for index in range(8):
            fixed = FixedFrame('odom', camera_at(index))
            back = fixed.motion
            away = type(back)(back.rotation.T, -back.rotation.T @ back.translation)
            seen = away.free_poses(body, stands)
            sigma = np.full(37, 1e-3)
            sigma[:3] = 0.03
            seen = seen + rng.normal(size=(1, 37)) * sigma * (np.arange(37) < 3)
            noisy = GaussianMixture([1.0], seen, np.diag(sigma**2)[None])
            frame = 'lens'
            if in_room:
                (noisy, _), frame = fixed.placed(body, noisy), fixed.optical
            content = PoseMixture.of_body(
                body, noisy, MixtureKind.LIKELIHOOD, 10**18 + index * 10**8, frame,
                error_share=1.0, error_time=0.0,
            )  # fmt: skip
            one.take(MIXTURE, pose_mixture_message(RosbagsMessages(), content))
        one.finish()
        found = [
            pose_mixture_of(deserialise(o.data, 'hmt_msgs/msg/PoseMixture'))
            for o in outputs
            if o.topic == 'smoothed_pose_mixture'
        ]
        pelvis = body.joint_names.index('pelvis')
        velocities = [c.joint_velocities[0, pelvis] for c in found]
        speeds[in_room] = float(np.linalg.norm(np.mean(velocities, axis=0)))
        if in_room:
            places = np.array([c.joint_positions[0, pelvis] for c in found])
            wanted = body.joint_positions(stands)[0, pelvis]
            assert np.linalg.norm(places - wanted, axis=1).max() < 0.12
            turned = root_rotations(body, np.array([c.means[0] for c in found]))
            np.testing.assert_allclose(turned, np.broadcast_to(turned[0], turned.shape), atol=0.01)
    # The camera moves at more than a metre per second.
    assert speeds[True] < 0.25 < 1.0 < speeds[False]
