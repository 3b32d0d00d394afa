"""The smoother continues the chain of the filter's modes, which messages contain."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from hmt_ros.body import Camera
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.camera_session import WaitingImage
from hmt_ros.sessions.smoothed_messages import TOPICS
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.track_messages import TrackedImage, track_messages
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.smoothing import backward_weights
from hmt_ros.tracking import LaggedWeights, Tracker, TrackerSettings
from hmt_ros.tracking.hypotheses import Modes
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.pose_mixtures import pose_mixture_of
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_of

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
STAMP, STEP, IMAGES = 1_700_000_000_123_456_789, 100_000_000, 8
SETTINGS = TrackerSettings(
    candidates=8,
    likelihood=LikelihoodSettings.of_terms(keypoints=LikelihoodSettings().keypoints),
    flow_weight=0.0,
    estimate_shape=False,
    lifter='',
)


class Filtered(NamedTuple):
    """An image of the filter."""

    data: bytes
    modes: Modes

    @property
    def message(self):
        """The likelihood message of the image."""
        return deserialise(self.data, 'hmt_msgs/msg/PoseMixture')


@pytest.fixture(scope='module')
def filtered(body):
    """Images tracked from keypoints alone, with limbs towards or away from the camera."""
    tracker, pose = Tracker(body, CAMERA, SETTINGS), body.prior_mean.copy()
    pose[2] = 4.0
    tracker.reset(GaussianMixture(np.ones(1), pose[None], 0.01 * np.eye(len(pose))[None]))
    black, rng = np.zeros((240, 320, 3), np.uint8), np.random.default_rng(0)
    result = []
    for i in range(IMAGES):
        pose[body.dof_names.index('left_elbow')] += 0.1
        pixels = CAMERA.project(body.joint_positions(pose[None]))[0]
        pixels += rng.normal(size=pixels.shape)
        covariances = np.tile(np.eye(2), (len(pixels), 1, 1))
        seen = Keypoints(body.joint_names, pixels, covariances, np.ones(len(pixels)))
        waiting = WaitingImage(black, STAMP + i * STEP, 'lens')
        found = tracker.step(black, waiting.stamp_ns, seen)
        image = TrackedImage(waiting, tracker, *found, FilterParameters(), '', False, False)
        ((_, message),) = track_messages(image, lambda topic: topic == MIXTURE)
        result.append(Filtered(serialise(message), tracker.estimate.modes))
    assert min(len(one.modes) for one in result[1:]) > 1
    return result


def in_order(one, weights):
    """Weights of modes in the order of the components of their message."""
    of_modes = dict(zip(one.modes.identities.tolist(), weights.tolist(), strict=True))
    return [of_modes[x] for x in pose_mixture_of(one.message).identities.tolist()]


def test_the_chain_passes_through_messages(filtered):
    """Weights given later images, from messages alone, equal those of the filter."""
    contents = [pose_mixture_of(one.message) for one in filtered]
    weights, wanted = contents[-1].posterior_weights, filtered[-1].modes.mixture.weights
    for i, (content, one) in reversed([*enumerate(zip(contents, filtered, strict=True))]):
        assert weights == pytest.approx(in_order(one, wanted), abs=1e-12)
        if i:
            assert content.ancestry_ids.tolist() == contents[i - 1].identities.tolist()
            assert content.ancestry_stamp_ns == contents[i - 1].stamp_ns
            weights, wanted = weights @ content.ancestry, wanted @ one.modes.origins
    assert (contents[0].ancestry.shape[1], contents[0].ancestry_stamp_ns) == (0, 0)


@pytest.mark.parametrize('lag', [0.0, 0.3, 10.0])
def test_backward_weights_are_those_of_the_filter(filtered, lag):
    """The newest image has the filter's weights, earlier ones have its lagged weights."""
    session = SmootherSession(SmootherParameters(fixed_lag=lag), lambda output: None)
    differ = 0.0
    for i, one in enumerate(filtered):
        handled = session.take(MIXTURE, one.message)
        assert handled.faults == handled.warnings == ()
        weights = backward_weights(session._window.links)
        assert weights[-1] == pytest.approx(in_order(one, one.modes.mixture.weights), abs=1e-12)
        recursion = LaggedWeights(IMAGES)
        for before in filtered[: i + 1]:
            recursion.update(i, before.modes.mixture, before.modes.origins)
        lagged = recursion.finish()[-len(weights) :]
        for own, wanted, image in zip(weights, lagged, filtered[i + 1 - len(weights) :]):
            assert own == pytest.approx(in_order(image, wanted.posterior.weights), abs=1e-12)
            changes = np.abs(wanted.posterior.weights - image.modes.mixture.weights)
            differ = max(differ, changes.max())
    # Later images have changed the weights.
    assert (differ > 1e-3) == (lag > 0.0)


def test_published_weights_are_sums_of_them(filtered):
    """In one image, modes within 30 mm are one motion, others keep their weights."""
    outputs = []
    session = SmootherSession(SmootherParameters(fixed_lag=0.0, max_hypotheses=64), outputs.append)
    for one in filtered:
        session.take(MIXTURE, one.message)
    found = [
        pose_mixture_of(deserialise(x.data, TOPICS[x.topic].msgtype))
        for x in outputs
        if x.topic == 'smoothed_pose_mixture'
    ]
    assert len(found) == IMAGES
    for one, smoothed in zip(filtered, found, strict=True):
        weights = one.modes.mixture.weights
        assert smoothed.weights.sum() == pytest.approx(1.0, abs=1e-12)
        some = np.array([*itertools.product((0.0, 1.0), repeat=len(weights))])
        for weight in smoothed.weights:
            assert np.abs(some @ weights - weight).min() < 1e-12
    assert any(len(smoothed.weights) > 1 for smoothed in found)


def test_same_messages_same_smoothed_bytes(filtered):
    def smoothed():
        outputs = []
        session = SmootherSession(SmootherParameters(), outputs.append)
        for one in filtered:
            session.take(MIXTURE, one.message)
        session.finish()
        return [output.data for output in outputs]

    assert smoothed() == smoothed() != []


def test_a_message_of_eight_motions(likelihoods, body):
    """All eight have weights, identities and timestamps, also in a span on demand."""
    outputs, alone = [], replace(likelihoods, hops=0.0)
    session = SmootherSession(SmootherParameters(), outputs.append)
    yaw = body.dof_names.index('root_z')
    means = np.tile(body.prior_mean, (8, 1))
    means[:, 2], means[:, yaw] = 4.0, 0.7 * np.arange(8)
    shares = np.arange(12.0, 4.0, -1.0) / 68.0
    covariances = np.tile(1e-3 * np.eye(body.dimension), (8, 1, 1))
    for index in range(5):
        mixture = GaussianMixture(np.full(8, 0.125), means, covariances)
        message = alone.message(index, mixture=mixture, weights=shares)
        handled = session.take(MIXTURE, message)
        assert handled.faults == handled.warnings == ()
    *_, data = (output.data for output in outputs if output.topic == 'trajectory_mixture')
    message = deserialise(data, TOPICS['trajectory_mixture'].msgtype)
    content = trajectory_mixture_of(message, body.dof_names)
    assert serialise(message) == data
    on_demand = trajectory_mixture_of(session.smooth_span())
    for found in (content, on_demand):
        turned = np.rint(np.mod(found.means[:, -1, yaw] + 0.1, 2.0 * np.pi) / 0.7).astype(int)
        assert sorted(turned) == list(range(8))
        assert found.weights == pytest.approx(shares[turned], abs=1e-9)
        assert found.stamps_ns == tuple(likelihoods.stamp(index) for index in range(5))
        joints = body.joint_positions(found.means[:, 0])
        assert found.joint_positions[:, 0] == pytest.approx(joints, abs=1e-9)
    assert sorted(content.identities.tolist()) == list(range(1, 9))
    assert on_demand.marginal_covariances.shape == (8, 5, 37, 37)
