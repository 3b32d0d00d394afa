"""The smoother session."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body.camera import roll
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.sessions import smoother_session
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.session import FINISH
from hmt_ros.sessions.smoothed_messages import TOPICS
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.track_messages import links_of
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.pose_mixtures import MixtureKind, TrackState, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_of

LAG, SECONDS = 2, 0.2
INDEPENDENT, UNKNOWN = CueErrors(1.0, 0.0), CueErrors(np.nan, np.nan)
WINDOW = ['trajectory_mixture', 'trajectory_markers']
FINAL = ['smoothed_pose_mixture', 'smoothed_joint_states']

# Constants of the session that tests change.
CONSTANTS = ('max_interval',)


@pytest.fixture(scope='module')
def likelihoods(likelihoods):
    """Likelihoods of two modes that are two motions."""
    return replace(likelihoods, leans=True)


@pytest.fixture
def session(outputs, monkeypatch, random_walk):
    def make(wanted=lambda topic: True, prior=random_walk, **values):
        values.setdefault('fixed_lag', SECONDS)
        monkeypatch.setattr(smoother_session, 'motion_prior', prior)
        for name in CONSTANTS:
            if name in values:
                monkeypatch.setattr(smoother_session, name.upper(), values.pop(name))
        parameters = with_values(SmootherParameters(), values)
        return SmootherSession(parameters, outputs.append, wanted)

    return make


def smoothed(outputs):
    """Timestamps of the final poses."""
    return [output.stamp_ns for output in outputs if output.topic == 'smoothed_pose_mixture']


def read(outputs, topic):
    kind = TOPICS[topic].msgtype
    return [deserialise(output.data, kind) for output in outputs if output.topic == topic]


def test_poses_become_final_after_the_lag(session, outputs, likelihoods):
    one = session()
    stamps = [likelihoods.stamp(index) for index in range(5)]
    for index in range(5):
        handled = one.take(MIXTURE, likelihoods.message(index))
        assert (handled.source, handled.stamp_ns) == (MIXTURE, stamps[index])
        assert handled.faults == handled.warnings == ()
        wanted = [(topic, stamps[index]) for topic in WINDOW]
        if index >= LAG:
            wanted += [(topic, stamps[index - LAG]) for topic in FINAL]
        assert list(handled.published) == wanted
    assert smoothed(outputs) == stamps[:3]
    assert one.state.counts == {'received': 5, 'smoothed': 5}
    assert (one.state.status, one.state.wants, one.state.window) == ('smoothing', '', LAG + 1)
    finished = one.finish()
    assert (finished.source, finished.stamp_ns) == (FINISH, stamps[-1])
    assert [topic for topic, _ in finished.published] == FINAL * LAG
    assert smoothed(outputs) == stamps
    assert one.state.status == 'waiting'
    assert one.finish().published == ()


def test_final_poses_are_mixtures_that_need_no_kinematics(session, outputs, likelihoods):
    one = session()
    for index in range(6):
        one.take(MIXTURE, likelihoods.message(index))
    one.finish()
    body = likelihoods.body
    states = read(outputs, 'smoothed_joint_states')
    for index, message in enumerate(read(outputs, 'smoothed_pose_mixture')):
        content = pose_mixture_of(message, body.dof_names, body.joint_names)
        assert content.kind == MixtureKind.SMOOTHED
        assert (content.stamp_ns, content.frame_id) == (likelihoods.stamp(index), 'lens')
        mixture, seen = content.mixture, likelihoods.mixture(index)
        np.testing.assert_allclose(
            content.joint_positions, body.joint_positions(mixture.means), atol=1e-9
        )
        assert np.array_equal(states[index].position, mixture.means[0])
        # Each image has a variance of 0.001, which its neighbours reduce a little.
        elbow = body.dof_names.index('left_elbow')
        for mean, covariance in zip(mixture.means, mixture.covariances, strict=True):
            assert np.abs(seen.means[:, elbow] - mean[elbow]).min() < 0.02
            assert (np.diagonal(covariance) < 1e-3).all()
        # The elbow that is always more probable gains weight with every image.
        straight = mixture.means[:, elbow] < seen.means[:, elbow].mean()
        assert 0.6 < mixture.weights[straight].sum() < 0.95


def test_errors_that_last_are_discounted_once(session, outputs, likelihoods):
    """Checks the first of three poses by the dense joint precision of each variable."""
    body = likelihoods.body
    one = session(max_hypotheses=1, fixed_lag=0.3, resting_feet=False)
    errors, stamps, means = CueErrors(0.5, 0.1), (0, 1, 3), []
    for index in stamps:
        mixture = likelihoods.mixture(index)[:1].normalised()
        means.append(mixture.means[0])
        message = likelihoods.message(index, errors=errors, mixture=mixture)
        assert one.take(MIXTURE, message).faults == ()
    # Weight of each image, and the random walk between the poses.
    kept = np.exp([-np.inf, -1.0, -2.0])
    shares = 0.5 / (1.0 - kept**2)
    links = 1.0 / (body.rates[:, None] * [0.1, 0.2])
    precisions = np.zeros((body.dimension, 3, 3))
    precisions[:, range(3), range(3)] = shares / 1e-3
    for i in range(2):
        precisions[:, i : i + 2, i : i + 2] += links[:, i, None, None] * [[1, -1], [-1, 1]]
    covariances = np.linalg.inv(precisions)
    lasting = np.mean(1.0 / (1.0 - kept) ** 2)
    pulls = shares[:, None] / 1e-3 * np.array(means)
    wanted = np.einsum('dij,jd->id', covariances, pulls)
    first, *_ = (pose_mixture_of(m).mixture for m in read(outputs, 'smoothed_pose_mixture'))
    np.testing.assert_allclose(first.means[0], wanted[0], atol=1e-6)
    found = np.diagonal(first.covariances[0])
    np.testing.assert_allclose(found, lasting * covariances[:, 0, 0], rtol=1e-6)


def test_likelihoods_without_an_error_model_are_refused(session, outputs, likelihoods):
    """Likelihoods of earlier versions are already discounted; later messages are smoothed."""
    one = session(max_interval=1.0)
    handled = [
        one.take(MIXTURE, likelihoods.message(index, errors=UNKNOWN if index < 2 else INDEPENDENT))
        for index in range(5)
    ]
    assert [len(h.faults) for h in handled] == [1, 1, 0, 0, 0]
    assert [len(h.warnings) for h in handled] == [1, 0, 0, 0, 0]
    (text,) = handled[0].warnings
    assert text.endswith('likelihood has error_share nan and error_time nan, wanted numbers')
    assert one.state.counts == {'received': 5, 'smoothed': 3, 'skipped': 2}
    assert one.state.faults == {'error_share and error_time': 2}
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in (2, 3, 4)]
    # A person leaves: there is nothing to discount.
    nobody = change(likelihoods.message(5, errors=UNKNOWN), components=[])
    assert one.take(MIXTURE, nobody).faults == ()


def test_forecasts_are_no_evidence(session, outputs, likelihoods):
    one = session()
    for index in range(3):
        kind = MixtureKind.FORECAST if index == 1 else MixtureKind.LIKELIHOOD
        handled = one.take(MIXTURE, likelihoods.message(index, kind=kind))
        assert len(handled.faults) == (index == 1)
    assert one.state.faults == {'kind': 1}
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(0), likelihoods.stamp(2)]


def test_smoothed_poses_tell_state_track_and_motion(session, outputs, likelihoods):
    one = session(max_hypotheses=2)
    for index in range(5):
        message = likelihoods.message(index)
        message.track_id = 3
        message.state = int(TrackState.LOST if index == 1 else TrackState.TRACKING)
        one.take(MIXTURE, message)
    one.finish()
    found = [pose_mixture_of(message) for message in read(outputs, 'smoothed_pose_mixture')]
    assert [content.state for content in found] == [
        TrackState.LOST if index == 1 else TrackState.TRACKING for index in range(5)
    ]
    body = likelihoods.body
    wrist, elbow = body.joint_names.index('left_wrist'), body.dof_names.index('left_elbow')
    for content in found:
        assert content.track_id == 3
        assert len(set(content.identities)) == 2
        assert np.linalg.eigvalsh(content.joint_covariances).min() > 0
        # The elbow bends by half a radian a second, and nothing else moves.
        swing = body.joint_jacobians(content.means)[:, wrist, :, elbow]
        speeds = np.linalg.norm(content.joint_velocities[:, wrist], axis=1)
        assert np.allclose(speeds, 0.5 * np.linalg.norm(swing, axis=1), rtol=0.25)
        pelvis = body.joint_names.index('pelvis')
        assert np.abs(content.joint_velocities[:, pelvis]).max() < 0.01
    # The bent elbow keeps its identity.
    bent = [content.identities[np.argmax(content.means[:, elbow])] for content in found]
    assert len(set(bent)) == 1


def test_a_camera_that_jumps(session, outputs, likelihoods):
    """If the person is suddenly 2 m farther and turned, smoothed poses are so, too."""
    body, one = likelihoods.body, session(fixed_lag=0.5, prior=motion_prior)
    yaw = body.dof_names.index('root_z')
    for index in range(24):
        mixture = likelihoods.mixture(index)
        means = mixture.means.copy()
        means[:, 2] += 2.0 * (index >= 12)
        means[:, yaw] += 1.0 * (index >= 12)
        handled = one.take(
            MIXTURE, likelihoods.message(index, mixture=replace(mixture, means=means))
        )
        assert handled.faults == ()
    one.finish()
    found = [pose_mixture_of(message) for message in read(outputs, 'smoothed_pose_mixture')]
    depths = [content.means[0, 2] for content in found]
    assert len(depths) == 24
    np.testing.assert_allclose(depths[:9], 4.0, atol=0.1)
    np.testing.assert_allclose(depths[15:], 6.0, atol=0.1)


def test_a_track_that_ends_and_begins_in_a_window(session, outputs, likelihoods):
    one = session(fixed_lag=1.0)
    for index in range(4):
        one.take(MIXTURE, change(likelihoods.message(index), track_id=1))
    empty = change(likelihoods.message(4), components=[], kind=int(MixtureKind.LIKELIHOOD))
    one.take(MIXTURE, empty)
    for index in range(6, 9):
        one.take(MIXTURE, change(likelihoods.message(index), track_id=2))
    one.finish()
    found = [(m.track_id, bool(m.components)) for m in read(outputs, 'smoothed_pose_mixture')]
    assert found == [(1, True)] * 4 + [(1, False)] + [(2, True)] * 3


def test_an_unknown_shape_is_added_once(session, outputs, likelihoods):
    """It is added to published covariances, for any number of images with the same error."""
    one = session(publish_covariances=True)
    d = likelihoods.body.dimension
    shape = np.zeros((d, d))
    shape[2, 2] = 0.04
    for index in range(6):
        message = likelihoods.message(index)
        message.shape_covariance = shape.reshape(-1)
        assert one.take(MIXTURE, message).faults == ()
    one.finish()
    for content in map(pose_mixture_of, read(outputs, 'smoothed_pose_mixture')):
        assert 0.04 < content.covariances[0, 2, 2] < 0.041
        assert content.covariances[0, 3, 3] < 1e-3
        assert content.shape_covariance is None
    window = trajectory_mixture_of(read(outputs, 'trajectory_mixture')[-1])
    assert (window.marginal_covariances[:, :, 2, 2] > 0.04).all()
    one.take(MIXTURE, change(likelihoods.message(7), shape_covariance=shape.reshape(-1)))
    span = trajectory_mixture_of(one.smooth_span())
    assert 0.04 < span.marginal_covariances[0, 0, 2, 2] < 0.042


def test_a_motion_passes_over_an_image_that_is_all_wrong(session, outputs, likelihoods):
    """The image's modes face the other way."""
    yaw = likelihoods.body.dof_names.index('root_z')
    one = session(fixed_lag=1.5, prior=motion_prior)
    for index in range(30):
        mixture = likelihoods.mixture(index)
        means = mixture.means.copy()
        means[:, yaw] += np.pi * (index == 10)
        one.take(MIXTURE, likelihoods.message(index, mixture=replace(mixture, means=means)))
    one.finish()
    found = [pose_mixture_of(m) for m in read(outputs, 'smoothed_pose_mixture')]
    start = likelihoods.mixture(0).means[0, yaw]
    turned = [abs(content.means[0, yaw] - start) for content in found]
    assert len(turned) == 30
    assert max(turned) < 0.3


def test_motions_have_the_same_numbers_in_both_messages(session, outputs, likelihoods):
    one = session(max_hypotheses=2)
    for index in range(6):
        one.take(MIXTURE, likelihoods.message(index))
    windows = [trajectory_mixture_of(m) for m in read(outputs, 'trajectory_mixture')]
    poses = [pose_mixture_of(m) for m in read(outputs, 'smoothed_pose_mixture')]
    elbow = likelihoods.body.dof_names.index('left_elbow')
    for window, pose in zip(windows[LAG:], poses, strict=True):
        bent = window.identities[window.means[:, 0, elbow].argmax()]
        assert sorted(window.identities) == sorted(windows[LAG].identities)
        assert len(window.identities) == 2
        assert bent == pose.identities[pose.means[:, elbow].argmax()]
        assert bent == windows[LAG].identities[windows[LAG].means[:, 0, elbow].argmax()]
    # Another window of the same track uses new identities; another track begins with 1 again.
    one.finish()
    one.take(MIXTURE, likelihoods.message(6))
    newest = trajectory_mixture_of(read(outputs, 'trajectory_mixture')[-1])
    assert min(newest.identities) > max(max(window.identities) for window in windows)
    one.take(MIXTURE, change(likelihoods.message(7), track_id=8))
    one.take(MIXTURE, change(likelihoods.message(8), track_id=9))
    assert min(trajectory_mixture_of(read(outputs, 'trajectory_mixture')[-1]).identities) == 1


def test_trajectories(session, outputs, likelihoods):
    one = session(max_hypotheses=2)
    for index in range(4):
        one.take(MIXTURE, likelihoods.message(index))
    *_, last = read(outputs, 'trajectory_mixture')
    content = trajectory_mixture_of(last, likelihoods.body.dof_names)
    assert content.stamps_ns == tuple(likelihoods.stamp(index) for index in (1, 2, 3))
    assert content.final_until_ns == likelihoods.stamp(1)
    assert content.means.shape == (2, 3, likelihoods.body.dimension)
    assert content.marginal_covariances is None
    one.parameters = with_values(one.parameters, {'publish_covariances': True})
    one.take(MIXTURE, likelihoods.message(4))
    *_, last = read(outputs, 'trajectory_mixture')
    assert trajectory_mixture_of(last).marginal_covariances.shape == (2, 3, 37, 37)
    (final,) = read(outputs, 'smoothed_pose_mixture')[-1:]
    found, window = pose_mixture_of(final), trajectory_mixture_of(last)
    for identity, covariance in zip(found.identities, found.covariances, strict=True):
        own = window.marginal_covariances[window.identities.tolist().index(identity), 0]
        np.testing.assert_allclose(covariance, own, atol=1e-12)


def test_same_messages_same_bytes(session, outputs, likelihoods):
    for _ in range(2):
        one = session()
        for index in range(4):
            one.take(MIXTURE, likelihoods.message(index))
        one.finish()
    half = len(outputs) // 2
    assert half > 0
    assert outputs[:half] == outputs[half:]


def test_transforms_are_the_links_of_the_heaviest_pose(session, outputs, likelihoods):
    one = session(publish_tf=True)
    for index in range(4):
        one.take(MIXTURE, likelihoods.message(index))
    one.finish()
    states, found = read(outputs, 'smoothed_joint_states'), read(outputs, '/tf')
    assert len(found) == len(states) == 4
    body = likelihoods.body
    for message, state in zip(found, states, strict=True):
        names, rotations, origins = links_of(body, np.array(state.position))
        links = {link.child_frame_id: link for link in message.transforms}
        assert set(links) == {f'smoothed/{name}' for name in names}
        for name, origin in zip(names, origins, strict=True):
            link = links[f'smoothed/{name}']
            assert link.header.frame_id == 'lens'
            place = link.transform.translation
            np.testing.assert_allclose([place.x, place.y, place.z], origin, atol=1e-12)
        assert rotations.shape == (len(names), 3, 3)
    one.parameters = with_values(one.parameters, {'publish_tf': False})
    one.take(MIXTURE, likelihoods.message(5))
    one.finish()
    assert len(read(outputs, '/tf')) == 4


def test_poses_have_the_motion_prior_of_the_body(session, outputs, likelihoods):
    one = session(prior=motion_prior)
    for index in range(4):
        assert one.take(MIXTURE, likelihoods.message(index)).faults == ()
    assert len(smoothed(outputs)) == 2


def test_a_new_body_begins_a_new_window(session, outputs, likelihoods):
    one = session()
    other = likelihoods.body.with_stature(1.6)
    one.take(MIXTURE, likelihoods.message(0))
    handled = one.take(MIXTURE, likelihoods.message(1, other))
    assert handled.warnings == (
        'mixtures belong to another body or another track: a new window begins',
    )
    assert smoothed(outputs) == [likelihoods.stamp(0)]
    # The same body once more changes nothing.
    assert one.take(MIXTURE, likelihoods.message(2, other)).warnings == ()
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in range(3)]
    for message, body in zip(
        read(outputs, 'smoothed_pose_mixture'), (likelihoods.body, other, other), strict=True
    ):
        content = pose_mixture_of(message)
        assert content.segment_lengths == body.segment_lengths
        np.testing.assert_allclose(
            content.joint_positions, body.joint_positions(content.mixture.means), atol=1e-9
        )
    windows = [trajectory_mixture_of(m) for m in read(outputs, 'trajectory_mixture')]
    assert [len(window.stamps_ns) for window in windows] == [1, 1, 2]
    assert windows[2].segment_lengths == other.segment_lengths


def test_nobody_in_view_ends_the_window(session, outputs, likelihoods):
    one = session(max_interval=0.5)
    for index in range(3):
        one.take(MIXTURE, likelihoods.message(index))
    del outputs[:]
    nobody = change(likelihoods.message(4), components=[])
    handled = one.take(MIXTURE, nobody)
    assert handled.faults == handled.warnings == ()
    stamp = likelihoods.stamp(4)
    assert handled.events == (f'nobody in view at the mixture of {stamp} ns: the window ends',)
    # The remaining poses are published, then the end of the track.
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in (1, 2, 4)]
    *_, last = read(outputs, 'smoothed_pose_mixture')
    assert (len(last.components), last.kind) == (0, int(MixtureKind.SMOOTHED))
    (markers,) = read(outputs, 'trajectory_markers')
    assert {marker.action for marker in markers.markers} == {2}
    assert (one.state.status, one.state.trouble()) == ('nobody', 'nobody in view')
    # A second one adds nothing, and a later message starts a new window without a gap.
    handled = one.take(MIXTURE, change(likelihoods.message(5), components=[]))
    assert handled.published == handled.events == ()
    handled = one.take(MIXTURE, likelihoods.message(14))
    assert handled.faults == handled.warnings == ()
    assert (one.state.status, one.state.window, one.state.gaps) == ('smoothing', 1, 0)
    assert one.state.counts == {'received': 6, 'smoothed': 4}


def change(message, **fields):
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def covariance_of(message, value):
    d = len(message.dof_names)
    message.components[0].covariance = np.full((d, d), value).reshape(-1)
    return message


def nan_in_mean(message):
    mean = np.array(message.components[0].mean)
    mean[3] = np.nan
    message.components[0].mean = mean
    return message


BAD = {
    'no components': (
        lambda m: change(m, components=[], kind=int(MixtureKind.PREDICTION)),
        'mixture has no components',
    ),
    'dof_names': (
        lambda m: change(m, dof_names=[*m.dof_names[:-1], 'tail']),
        "has 'tail' at 36, wanted ",
    ),
    'fewer dof_names': (
        lambda m: change(m, dof_names=m.dof_names[:-1]),
        'mean has 37 values, wanted 36',
    ),
    'not finite': (nan_in_mean, 'mixture: mean has values that are not finite'),
    'not positive definite': (lambda m: covariance_of(m, 1.0), 'is not positive definite'),
    'covariance that is not a number': (
        lambda m: covariance_of(m, np.nan),
        'covariance of mixture has values that are not finite',
    ),
    'posterior weights': (
        lambda m: change(m.components[0], posterior_weight=0.2) and m,
        'posterior has weights that sum to 0.5, wanted 1',
    ),
    'ancestry': (
        lambda m: change(m.components[1], ancestry=[0.5, 0.1]) and m,
        'ancestry of component 1',
    ),
    'ancestry that is not a number': (
        lambda m: change(m.components[1], ancestry=[np.nan, 1.0]) and m,
        'ancestry of component 1',
    ),
    'weight': (lambda m: change(m.components[0], weight=3.0) and m, 'weights that sum to 3.4'),
    'size of the shape': (
        lambda m: change(m, shape_covariance=np.zeros(36)),
        'mixture: shape_covariance has 36 values, wanted 1369',
    ),
    'negative shape': (
        lambda m: change(m, shape_covariance=-np.eye(37).reshape(-1)),
        'covariance of the shape is not positive definite',
    ),
    'body': (
        lambda m: change(m, body_model='horse'),
        "no body 'horse': wanted one of",
    ),
}


@pytest.mark.parametrize('name', BAD)
def test_bad_mixtures_are_skipped(session, outputs, likelihoods, name):
    spoil, text = BAD[name]
    one = session(max_interval=1.0)
    handled = []
    for index in range(4):
        message = likelihoods.message(index)
        handled.append(one.take(MIXTURE, spoil(message) if index in (1, 2) else message))
    assert [len(h.faults) for h in handled] == [0, 1, 1, 0]
    assert [len(h.warnings) for h in handled] == [0, 1, 0, 0]
    assert text in handled[1].warnings[0]
    assert '\n' not in handled[1].warnings[0]
    assert one.state.counts == {'received': 4, 'smoothed': 2, 'skipped': 2}
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(0), likelihoods.stamp(3)]


def test_time_that_stands_still_or_jumps_back_is_skipped(session, outputs, likelihoods):
    one = session()
    handled = [one.take(MIXTURE, likelihoods.message(index)) for index in (1, 1, 0, 2)]
    assert [len(h.faults) for h in handled] == [0, 1, 1, 0]
    assert 'wanted stamps that increase' in handled[1].warnings[0]
    assert 'with reset_on_time_jump the window would start again' in handled[2].warnings[0]
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(1), likelihoods.stamp(2)]


def test_time_that_jumps_back_begins_a_new_window(session, outputs, likelihoods):
    one = session(reset_on_time_jump=True)
    for _ in range(2):
        for index in range(4):
            assert one.take(MIXTURE, likelihoods.message(index)).faults == ()
    one.finish()
    # A bag played twice gives the same results twice.
    wanted = [likelihoods.stamp(index) for index in range(4)]
    assert smoothed(outputs) == [*wanted, *wanted]
    half = len(outputs) // 2
    assert outputs[:half] == outputs[half:]
    assert one.state.faults == {'time jumps back': 1}


def test_gaps_are_bridged_and_told(session, outputs, likelihoods):
    one = session(max_interval=0.15)
    handled = [one.take(MIXTURE, likelihoods.message(index)) for index in (0, 1, 6, 7, 14)]
    assert [len(h.faults) for h in handled] == [0] * 5
    assert [len(h.warnings) for h in handled] == [0, 0, 1, 0, 0]
    assert 'no mixture for 0.50 s' in handled[2].warnings[0]
    assert (one.state.gaps, one.state.longest_gap) == (2, pytest.approx(0.7))
    one.finish()
    assert len(smoothed(outputs)) == 5
    # Distant neighbours reduce the variance less.
    variances = [
        pose_mixture_of(message).mixture.covariances[0].trace()
        for message in read(outputs, 'smoothed_pose_mixture')
    ]
    assert variances[4] > variances[0]


def test_posteriors_are_told_but_smoothed(session, likelihoods):
    one = session()
    message = likelihoods.message(0, kind=MixtureKind.POSTERIOR)
    handled = one.take(MIXTURE, message)
    assert handled.faults == ()
    assert 'kind POSTERIOR, wanted LIKELIHOOD' in handled.warnings[0]
    assert one.state.counts['smoothed'] == 1


def test_a_span_is_smoothed_on_demand(session, likelihoods):
    one = session(window_length=4, max_hypotheses=4)
    with pytest.raises(ValueError, match='none is'):
        one.smooth_span()
    for index in range(6):
        one.take(MIXTURE, likelihoods.message(index))
    content = trajectory_mixture_of(one.smooth_span(0, likelihoods.stamp(4)))
    assert content.stamps_ns == tuple(likelihoods.stamp(index) for index in (2, 3, 4))
    assert content.marginal_covariances.shape == (len(content.weights), 3, 37, 37)
    assert content.body_model == 'human37'
    newest = likelihoods.stamp(5)
    assert trajectory_mixture_of(one.smooth_span(newest, 0)).stamps_ns == (newest,)
    with pytest.raises(ValueError, match='are kept'):
        one.smooth_span(likelihoods.stamp(7), likelihoods.stamp(9))
    one.restart()
    with pytest.raises(ValueError, match='none is'):
        one.smooth_span()


def test_body_in_a_message_leads_to_no_file(session, likelihoods, tmp_path):
    """Only files named by a parameter are read, not files named by a message."""
    path = tmp_path / 'own.yaml'
    path.write_text('extends: human37\n')
    message = change(likelihoods.message(0), body_model=str(path))
    one = session()
    (fault,) = one.take(MIXTURE, message).faults
    assert 'own.yaml' in fault
    assert 'wanted one of' in fault
    assert one.state.status == 'waiting'
    trusting = session(body_model=str(path))
    assert trusting.take(MIXTURE, message).faults == ()


@pytest.mark.parametrize('degrees', [90.0, 180.0])
def test_a_camera_on_its_side_is_smoothed_as_an_upright_one(session, outputs, likelihoods, degrees):
    level = roll([np.sin(np.radians(degrees)), -np.cos(np.radians(degrees)), 0.0])
    body = likelihoods.body.levelled(level)
    found, trajectories = [], []
    for one in (likelihoods.body, body):
        outputs.clear()
        made = session(prior=motion_prior)
        for index in range(8):
            mixture = likelihoods.mixture(index)
            turn = np.where(np.arange(37) == 3, 0.1, 0.0)  # nobody faces the camera exactly
            mixture = replace(mixture, means=mixture.means + turn)
            made.take(MIXTURE, likelihoods.message(index, body=one, mixture=mixture))
        made.finish()
        found.append([pose_mixture_of(x) for x in read(outputs, 'smoothed_pose_mixture')])
        trajectories.append(trajectory_mixture_of(read(outputs, 'trajectory_mixture')[-1]))
    upright, turned = found
    assert len(upright) == len(turned) == 8
    for one, other in zip(upright, turned, strict=True):
        relative = [x.joint_positions - x.joint_positions[:, :1] for x in (one, other)]
        assert relative[1] == pytest.approx(relative[0] @ level.T, abs=1e-6)
        # Root angles are relative to the camera.
        joints = likelihoods.body.joint_positions(other.means)
        assert joints == pytest.approx(other.joint_positions, abs=1e-6)
    last = trajectories[1]
    joints = likelihoods.body.joint_positions(last.means[0])
    assert joints == pytest.approx(last.joint_positions[0], abs=1e-6)


def weights_of(outputs):
    """Posterior weights of the straight and of the bent elbow in each smoothed pose."""
    found = [pose_mixture_of(message) for message in read(outputs, 'smoothed_pose_mixture')]
    trunk = found[0].dof_names.index('trunk_x')
    middle = found[0].means[:, trunk].mean() if len(found[0].means) > 1 else -0.5
    bent = [content.means[:, trunk] < middle for content in found]
    return np.array([content.weights @ own for content, own in zip(found, bent, strict=True)])


def test_motions_have_the_weights_that_the_filter_tells(session, outputs, likelihoods):
    """They are not those of the likelihood, in one window or in windows of one image each."""
    for lag in (SECONDS, 0.0):
        outputs.clear()
        one = session(fixed_lag=lag)
        one.take(MIXTURE, likelihoods.message(0))
        one.finish()
        assert weights_of(outputs) == pytest.approx([0.3], abs=1e-9)
    for index in range(1, 6):
        one.take(MIXTURE, likelihoods.message(index))
    one.finish()
    assert weights_of(outputs) == pytest.approx([0.3] * 6, abs=1e-9)
    # With a lag, later images contribute.
    outputs.clear()
    one = session()
    for index in range(6):
        weights = [0.7, 0.3] if index < 5 else [0.1, 0.9]
        one.take(MIXTURE, likelihoods.message(index, weights=weights))
    one.finish()
    assert weights_of(outputs) == pytest.approx([0.3] * 3 + [0.9] * 3, abs=0.02)


def test_messages_from_elsewhere_tell_no_chain(session, outputs, likelihoods):
    """Modes continue those within reach, at 30 images per second; one warning is given."""
    one, times = session(), [index / 3 for index in range(6)]
    handled = [one.take(MIXTURE, likelihoods.message(index, chain=False)) for index in times]
    assert [len(h.faults) for h in handled] == [0] * 6
    assert [len(h.warnings) for h in handled] == [1, 0, 0, 0, 0, 0]
    assert 'have no posterior weights and ancestry' in handled[0].warnings[0]
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in times]
    # Their own weights are used. No person moves as far as from one mode to the other.
    assert weights_of(outputs) == pytest.approx([0.4] * 6, abs=1e-9)
    windows = [trajectory_mixture_of(m) for m in read(outputs, 'trajectory_mixture')]
    assert [len(window.weights) for window in windows] == [2] * len(windows)
    # At ten per second a person can, and each mode can continue each.
    outputs.clear()
    for index in range(3, 6):
        one.take(MIXTURE, likelihoods.message(index, chain=False))
    assert len(trajectory_mixture_of(read(outputs, 'trajectory_mixture')[-1]).weights) > 2


def test_a_likelihood_that_is_lost_on_the_way(session, outputs, likelihoods):
    """Ancestry refers to a missing image, so modes continue those within reach."""
    one = session(max_interval=0.5)
    for index in (0, 1, 2, 4, 5, 6):
        handled = one.take(MIXTURE, likelihoods.message(index))
        assert handled.faults == handled.warnings == ()
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in (0, 1, 2, 4, 5, 6)]
    assert weights_of(outputs) == pytest.approx([0.3] * 6, abs=0.2)
    numbers = {
        tuple(sorted(pose_mixture_of(m).identities)) for m in read(outputs, 'smoothed_pose_mixture')
    }
    assert {1, 2} <= set.union(*map(set, numbers))


def test_modes_that_other_modes_follow(session, outputs, likelihoods):
    """Their ancestry names modes that the previous image did not have."""
    one = session()
    for index in range(5):
        message = likelihoods.message(index)
        if index == 2:
            message.ancestry_ids = [7, 8]
        assert one.take(MIXTURE, message).faults == ()
    one.finish()
    assert weights_of(outputs) == pytest.approx([0.3] * 5, abs=0.2)


def test_modes_that_begin_within_a_track(session, outputs, likelihoods):
    """A lost track is found again: modes have weights, but no ancestors."""
    one = session()
    for index in range(8):
        before = None if index == 4 else index - 1
        handled = one.take(MIXTURE, likelihoods.message(index, before=before))
        assert handled.faults == handled.warnings == ()
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in range(8)]
    assert weights_of(outputs) == pytest.approx([0.3] * 8, abs=0.2)


def test_another_number_of_modes_in_each_image(session, outputs, likelihoods):
    """One mode, two, one: without ancestry, and with a mode without weight."""
    one = session()
    for index in range(9):
        mixture = likelihoods.mixture(index)
        if index % 3 == 0:
            mixture = mixture[:1].normalised()
        weights = [1.0, 0.0] if index % 3 == 1 else None
        message = likelihoods.message(index, mixture=mixture, weights=weights, chain=index != 5)
        assert one.take(MIXTURE, message).faults == ()
    one.finish()
    assert smoothed(outputs) == [likelihoods.stamp(index) for index in range(9)]
    for message in read(outputs, 'smoothed_pose_mixture'):
        content = pose_mixture_of(message)
        assert content.weights.sum() == pytest.approx(1.0, abs=1e-9)
        assert np.isfinite(content.joint_covariances).all()


def test_all_modes_are_wrong_for_a_second(session, outputs, likelihoods):
    """They face the other way, 2 m aside; the person is found again within a second."""
    yaw = likelihoods.body.dof_names.index('root_z')
    one = session(fixed_lag=0.5, prior=motion_prior)
    for index in range(40):
        mixture = likelihoods.mixture(index)
        means = mixture.means.copy()
        means[:, 0] += 2.0 * (10 <= index < 20)
        means[:, yaw] += 2.5 * (10 <= index < 20)
        message = likelihoods.message(index, mixture=replace(mixture, means=means))
        assert one.take(MIXTURE, message).faults == ()
    one.finish()
    found = [pose_mixture_of(m) for m in read(outputs, 'smoothed_pose_mixture')]
    assert len(found) == 40
    for content in found:
        assert np.isfinite(content.means).all()
        assert np.linalg.eigvalsh(content.covariances).min() > 0.0
    beside = [abs(content.means[0, 0]) for content in (*found[:6], *found[30:])]
    assert max(beside) < 0.05
    turned = [abs(content.means[0, yaw]) for content in (*found[:6], *found[30:])]
    assert max(turned) < 0.1
