import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.sessions.camera_session import WaitingImage
from hmt_ros.sessions.overlay import draw_modes, draw_notes
from hmt_ros.sessions.track_messages import TOPICS, TrackedImage, track_messages
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.tracking import Status
from hmt_ros.tracking.ground import Ground
from msg_tools import MessageError
from msg_tools.messages.cdr import serialise
from msg_tools.messages.ground import ground_of
from msg_tools.messages.images import decode_image
from msg_tools.messages.pose_mixtures import MixtureKind, pose_mixture_of

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
STAMP = 1_700_000_000_123_456_789


def poses_of(body, count):
    poses = np.tile(body.prior_mean, (count, 1))
    poses[:, :3] = [0.0, 0.0, 4.0]
    poses[:, 0] = np.linspace(-0.5, 0.5, count)
    return poses


@pytest.fixture
def track(body):
    rng = np.random.default_rng(0)
    poses = poses_of(body, 3)
    root = rng.normal(size=(3, body.dimension, body.dimension))
    covariances = root @ root.transpose(0, 2, 1) / body.dimension + 0.1 * np.eye(body.dimension)
    covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    posterior = GaussianMixture(np.array([0.5, 0.3, 0.2]), poses, covariances)
    estimate = SimpleNamespace(
        body=body,
        status=Status.TRACKING,
        existence_probability=0.75,
        reason='',
        published=SimpleNamespace(
            log_likelihoods=np.array([-3.0, -2.0, -1.0]), identities=np.arange(1, 4)
        ),
        likelihood=SimpleNamespace(
            values=np.array([-2.5, -1.5]),
            errors=CueErrors(0.25, 0.125),
            shape_covariance=0.01 * np.eye(body.dimension),
            identities=np.array([3, 1]),
            posterior_weights=np.array([0.25, 0.75]),
            origins=np.array([[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]]),
            ancestors=np.array([1, 4, 2]),
            ancestry_stamp=STAMP - 1,
        ),
        point_estimate=poses[1],
        ground=Ground(np.array([0.0, -0.8, -0.6]), 0.05, 1.5, 0.1),
        contacts={'left_foot': 0.75, 'right_foot': 0.25},
        velocities=None,
        vertical=None,
        # A value above 1 by a rounding error.
        validity=SimpleNamespace(shown={'depth': 0.25, 'track': 1.0 + 1e-15}),
    )
    tracker = SimpleNamespace(
        camera=CAMERA,
        settings=SimpleNamespace(max_hypotheses=8),
        track_id=1,
        estimate=estimate,
    )
    return TrackedImage(
        WaitingImage(np.full((240, 320, 3), 200, np.uint8), STAMP, 'lens'),
        tracker,
        posterior,
        GaussianMixture(np.array([0.6, 0.4]), poses[:2], covariances[:2]),
        FilterParameters(),
        'anna/',
        starts=True,
        describe=True,
    )


def changed(track, **of_estimate):
    """The track with another estimate."""
    estimate = SimpleNamespace(**{**vars(track.tracker.estimate), **of_estimate})
    tracker = SimpleNamespace(**{**vars(track.tracker), 'estimate': estimate})
    return replace(track, tracker=tracker)


def draw(body, poses, weights, count, image):
    joints = body.joint_positions(poses)
    return draw_modes(image, CAMERA, joints, body.skeleton.bones, weights, count)


def made(track):
    found = dict(track_messages(track, lambda topic: True))
    assert [topic for topic in TOPICS if topic in found] == list(found)
    for topic, message in found.items():
        assert message.__msgtype__ == TOPICS[topic].msgtype
        assert len(serialise(message)) > 0
    return found


def test_mixtures(track, body):
    found = made(track)
    for topic, mixture, kind in (
        ('pose_mixture', track.posterior, MixtureKind.POSTERIOR),
        ('likelihood_mixture', track.likelihood, MixtureKind.LIKELIHOOD),
    ):
        content = pose_mixture_of(found[topic], body.dof_names, body.joint_names)
        assert content.mixture == mixture
        assert (content.kind, content.stamp_ns, content.frame_id) == (kind, STAMP, 'lens')
        assert np.array_equal(content.joint_positions, body.joint_positions(mixture.means))
        assert not np.any(content.degrees_of_freedom)
    assert np.array_equal(
        [c.log_likelihood for c in found['pose_mixture'].components], [-3.0, -2.0, -1.0]
    )
    assert np.array_equal(
        [c.log_likelihood for c in found['likelihood_mixture'].components], [-2.5, -1.5]
    )
    # The likelihood is undiscounted, and contains its error model.
    likelihood, posterior = found['likelihood_mixture'], found['pose_mixture']
    assert (likelihood.error_share, likelihood.error_time) == (0.25, 0.125)
    assert np.isnan([posterior.error_share, posterior.error_time]).all()
    # It contains the covariance of the error common to all images.
    shape = track.tracker.estimate.likelihood.shape_covariance.reshape(-1)
    assert np.array_equal(likelihood.shape_covariance, shape)
    assert len(posterior.shape_covariance) == 0
    # It contains the chain of the modes at its components.
    of_posterior, of_likelihood = (pose_mixture_of(x) for x in (posterior, likelihood))
    assert of_likelihood.identities.tolist() == [3, 1]
    assert of_likelihood.posterior_weights.tolist() == [0.25, 0.75]
    assert of_likelihood.ancestry.tolist() == [[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]]
    assert of_likelihood.ancestry_ids.tolist() == [1, 4, 2]
    assert of_likelihood.ancestry_stamp_ns == STAMP - 1
    assert (of_posterior.posterior_weights, of_posterior.ancestry) == (None, None)
    # The posterior contains the reliabilities of the cues.
    assert (posterior.cue_names, list(posterior.cue_probabilities)) == (
        ['depth', 'track'],
        [0.25, 1.0],
    )
    assert (likelihood.cue_names, len(likelihood.cue_probabilities)) == ([], 0)


def test_joint_states_are_those_of_the_point_estimate(track, body):
    state = made(track)['human_joint_states']
    assert tuple(state.name) == body.dof_names
    assert np.array_equal(state.position, track.tracker.estimate.point_estimate)


def test_transforms_lead_from_the_camera_to_the_segments(track, body):
    frames = forward(body.skeleton, track.tracker.estimate.point_estimate[None])
    transforms = {t.child_frame_id: t for t in made(track)['/tf'].transforms}
    for index, name in enumerate(body.skeleton.segment_names):
        transform = transforms[f'anna/{name}']
        assert transform.header.frame_id == 'lens'
        t, q = transform.transform.translation, transform.transform.rotation
        assert np.array_equal([t.x, t.y, t.z], frames.origins[index, :, 0])
        x, y, z, w = q.x, q.y, q.z, q.w
        third = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
        assert np.allclose(third, frames.rotations()[0, index, :, 2], atol=1e-12)


def joints_of(urdf):
    """Root of a URDF, and (name, parent, child, type, origin, axis) of its joints in order."""
    robot = ET.fromstring(urdf)
    found = []
    for joint in robot.findall('joint'):
        origin = np.eye(4)
        element = joint.find('origin')
        angles = [float(x) for x in element.attrib['rpy'].split()]
        origin[:3, :3] = Rotation.from_euler('xyz', angles).as_matrix()
        origin[:3, 3] = [float(x) for x in element.attrib['xyz'].split()]
        axis = joint.find('axis')
        direction = None if axis is None else [float(x) for x in axis.attrib['xyz'].split()]
        parent, child = (joint.find(end).attrib['link'] for end in ('parent', 'child'))
        found.append((joint.attrib['name'], parent, child, joint.attrib['type'], origin, direction))
    links = {link.attrib['name'] for link in robot.findall('link')}
    (root,) = links - {child for _, _, child, *_ in found}
    return root, found


def forward_kinematics(urdf, state):
    """Frames (4, 4) of the links of a URDF relative to its root, by name."""
    values = dict(zip(state.name, state.position, strict=True))
    root, joints = joints_of(urdf)
    frames = {root: np.eye(4)}
    for name, parent, child, kind, origin, axis in joints:
        motion = np.eye(4)
        if kind == 'revolute':
            motion[:3, :3] = Rotation.from_rotvec(np.multiply(axis, values.pop(name))).as_matrix()
        elif kind == 'prismatic':
            motion[:3, 3] = np.multiply(axis, values.pop(name))
        else:
            assert kind == 'fixed'
        frames[child] = frames[parent] @ origin @ motion
    assert not values
    return root, frames


@pytest.mark.parametrize('name', ['human32', 'human34', 'human37'])
def test_urdf_joint_states_transforms_and_joint_positions_agree(name, track):
    """The URDF moved by joint states agrees with the transforms."""
    rng = np.random.default_rng(7)
    plain = load_body(name)
    body = plain.with_segment_lengths(
        {key: value * rng.uniform(0.8, 1.2) for key, value in plain.segment_lengths.items()}
    )
    poses = np.clip(rng.normal(0, 0.7, (2, body.dimension)), body.lower, body.upper)
    poses[:, :3] = rng.uniform([-1, -1, 2], [1, 1, 6], (2, 3))
    covariances = np.tile(1e-2 * np.eye(body.dimension), (2, 1, 1))
    mixture = GaussianMixture(np.array([0.4, 0.6]), poses, covariances)
    other = changed(
        track,
        body=body,
        published=SimpleNamespace(log_likelihoods=np.zeros(2), identities=np.arange(2)),
        likelihood=SimpleNamespace(
            values=np.zeros(2),
            errors=CueErrors(0.25, 0.125),
            shape_covariance=np.zeros((body.dimension, body.dimension)),
            identities=np.arange(1, 3),
            posterior_weights=np.full(2, 0.5),
            origins=np.empty((2, 0)),
            ancestors=np.empty(0, dtype=int),
            ancestry_stamp=None,
        ),
        point_estimate=poses[1],
    )
    found = made(replace(other, posterior=mixture, likelihood=mixture))
    urdf = found['human_description'].data
    root, frames = forward_kinematics(urdf, found['human_joint_states'])
    assert root == 'lens'
    transforms = {t.child_frame_id: t.transform for t in found['/tf'].transforms}
    # No link without a frame and no frame without a link.
    assert transforms.keys() == frames.keys() - {root}
    for link, transform in transforms.items():
        t, q = transform.translation, transform.rotation
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        np.testing.assert_allclose([t.x, t.y, t.z], frames[link][:3, 3], atol=1e-9)
        np.testing.assert_allclose(turn, frames[link][:3, :3], atol=1e-9)
    skeleton = body.skeleton
    heaviest = found['pose_mixture'].components[0]
    for index, point in enumerate(heaviest.joint_positions):
        segment = skeleton.segment_names[skeleton.joint_segments[index]]
        place = frames[f'anna/{segment}'] @ [*skeleton.joint_offsets[index], 1.0]
        np.testing.assert_allclose([point.x, point.y, point.z], place[:3], atol=1e-9)
        assert np.allclose(place[:3], body.joint_positions(poses[1:])[0, index], atol=1e-9)
    # The URDF in the body is the same, with other names.
    plain_root, plain_frames = forward_kinematics(found['body'].urdf, found['human_joint_states'])
    assert plain_root == 'lens'
    assert {f'anna/{link}' for link in plain_frames if link != 'lens'} == transforms.keys()


def test_markers_speak_about_all_ranks(track):
    markers = made(track)['markers'].markers
    assert [m.ns for m in markers] == [*(f'mode_{k // 2}' for k in range(16)), 'floor', 'contacts']
    assert [m.action for m in markers] == [0] * 6 + [2] * 10 + [0, 0]
    shares = [m.color.a for m in markers[:6:2]]
    assert shares == sorted(shares, reverse=True)
    assert np.isclose(shares[0], 1.0)


def test_ground(track, body):
    found = made(track)
    content = ground_of(found['ground'])
    assert (content.stamp_ns, content.frame_id) == (STAMP, 'lens')
    np.testing.assert_allclose(content.plane, [0.0, -0.8, -0.6, 1.5])
    assert (content.up_sigma, content.height_sigma) == (0.05, 0.1)
    assert content.contacts == track.tracker.estimate.contacts
    # The feet belong to the point estimate.
    feet = found['markers'].markers[-1]
    joints = dict(
        zip(
            body.joint_names,
            body.joint_positions(track.tracker.estimate.point_estimate[None])[0],
            strict=True,
        )
    )
    for point, name in zip(
        feet.points, ('left_ankle', 'left_toe', 'right_ankle', 'right_toe'), strict=True
    ):
        np.testing.assert_allclose([point.x, point.y, point.z], joints[name])


def test_ground_whose_height_is_unknown(track):
    ground = Ground(track.tracker.estimate.ground.up, 0.3, None, np.inf)
    unknown = changed(track, ground=ground, contacts={})
    found = made(unknown)
    content = ground_of(found['ground'])
    assert content.plane is None
    assert np.isnan(content.height_sigma)
    assert np.isnan(found['ground'].plane).all()
    assert [marker.action for marker in found['markers'].markers[-2:]] == [2, 2]


def test_body_comes_with_its_first_image_only(track):
    assert next(iter(made(track))) == 'body'
    again = replace(track, starts=False)
    assert 'body' not in made(again)
    unchanged = made(replace(again, describe=False))
    assert 'human_description' in made(again)
    assert 'human_description' not in unchanged
    assert made(track)['body'].header.frame_id == 'lens'


def test_overlay_shows_the_modes(track, body):
    message = made(track)['overlay/compressed']
    picture = decode_image(message)
    drawn = draw(body, track.posterior.means, track.posterior.weights, 3, track.waiting.image)
    assert cv2.absdiff(picture, drawn).mean() < 2.0
    assert np.all(track.waiting.image == 200)
    pixels = CAMERA.project(body.joint_positions(track.posterior.means))
    knee = body.joint_names.index('left_knee')
    red = [drawn[round(v), round(u)].astype(int) for u, v in pixels[:, knee]]
    # The heaviest mode is orange, others are bluish and fainter if lighter.
    assert red[0][2] > red[0][0] + 100
    assert red[1][0] > red[1][2] + 10
    assert red[1][0] - red[1][2] > red[2][0] - red[2][2]


def test_overlay_says_what_is_missing(track):
    plain = decode_image(made(track)['overlay/compressed'])
    guessed = replace(track, parameters=replace(track.parameters, focal_length_sigma=0.2))
    noted = decode_image(made(guessed)['overlay/compressed'])
    changed = np.nonzero(cv2.absdiff(noted, plain).max(2) > 60)
    assert len(changed[0]) > 100
    assert changed[0].min() > 0.8 * plain.shape[0]


@pytest.mark.parametrize('size', [(480, 640), (60, 80), (20, 500)])
def test_notes_fit_into_the_image(size):
    image = np.full((*size, 3), 120, np.uint8)
    drawn = draw_notes(image, ['nobody is in view', 'no calibration: distances may be off by 20%'])
    assert drawn.shape == image.shape
    assert drawn.max() > 150
    assert np.all(image == 120)
    np.testing.assert_array_equal(draw_notes(image, []), image)


def test_overlay_with_people_partly_outside_and_behind(body):
    image = np.zeros((240, 320, 3), np.uint8)
    poses = poses_of(body, 4)
    poses[1, 0] = 40.0
    poses[2, 2] = -4.0
    poses[3, 2] = 0.3
    assert draw(body, poses, np.full(4, 0.25), 4, image).shape == image.shape
    assert np.any(draw(body, poses[:1], np.ones(1), 4, image))
    assert not np.any(draw(body, poses[1:3], np.full(2, 0.5), 4, image))
    assert not np.any(draw(body, poses, np.full(4, 0.25), 0, image))
    assert not np.any(draw(body, poses[:0], np.empty(0), 3, image))
    assert not np.any(image)


def test_impossible_mixtures_are_refused_before_anything_is_published(track):
    covariances = -track.likelihood.covariances
    likelihood = GaussianMixture(track.likelihood.weights, track.likelihood.means, covariances)
    bad = replace(track, likelihood=likelihood)
    with pytest.raises(MessageError, match='not positive definite'):
        next(track_messages(bad, lambda topic: True))
