"""PoseMixture to arrays and back, and refused messages."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from msg_tools import MessageError, typestore
from msg_tools.messages.bodies import body_of
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.pose_mixtures import (
    POSE_MIXTURE,
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
    pose_mixture_of,
)


def test_kinds_are_those_of_the_message():
    constants = typestore().fielddefs['hmt_msgs/msg/PoseMixture'][0]
    kinds = {kind.name: kind.value for kind in MixtureKind}
    states = {f'STATE_{state.name}': state.value for state in TrackState}
    assert {name: value for name, _, value in constants} == kinds | states


def test_round_trip_sorts_by_weight(pose_mixture, messages):
    data = serialise(pose_mixture_message(messages, pose_mixture))
    back = pose_mixture_of(
        deserialise(data, 'hmt_msgs/msg/PoseMixture'),
        pose_mixture.dof_names,
        pose_mixture.joint_names,
    )
    order = [2, 1, 0]
    np.testing.assert_array_equal(back.mixture.weights, [0.5, 0.3, 0.2])
    np.testing.assert_array_equal(back.mixture.means, pose_mixture.means[order])
    np.testing.assert_array_equal(back.mixture.covariances, pose_mixture.covariances[order])
    np.testing.assert_array_equal(back.joint_positions, pose_mixture.joint_positions[order])
    np.testing.assert_array_equal(back.log_likelihoods, [-1.0, -2.0, -3.0])
    np.testing.assert_array_equal(back.degrees_of_freedom, [0.0, 5.0, 0.0])
    for name in (
        'body_model', 'dof_names', 'joint_names', 'kind', 'stamp_ns', 'frame_id', 'segment_lengths',
    ):  # fmt: skip
        assert getattr(back, name) == getattr(pose_mixture, name)
    # After sorting, it is the same message again.
    assert serialise(pose_mixture_message(messages, back)) == data


def test_what_is_unknown(pose_mixture, messages):
    content = replace(
        pose_mixture,
        covariances=None,
        segment_lengths={},
        log_likelihoods=None,
        degrees_of_freedom=None,
    )
    message = pose_mixture_message(messages, content)
    assert all(len(component.covariance) == 0 for component in message.components)
    back = pose_mixture_of(message)
    assert back.covariances is None
    assert back.segment_lengths == {}
    assert np.isnan(back.log_likelihoods).all()
    assert (back.degrees_of_freedom == 0).all()
    with pytest.raises(MessageError, match='mixture has no covariances'):
        _ = back.mixture


def test_nobody(messages):
    body = load_body('human37')
    content = PoseMixture.of_body(body, None, MixtureKind.PREDICTION, 7, 'camera')
    back = pose_mixture_of(pose_mixture_message(messages, content), body.dof_names)
    assert back.joint_positions.shape == (0, len(body.joint_names), 3)
    with pytest.raises(MessageError, match='mixture has no components') as caught:
        _ = back.mixture
    assert caught.value.fault == 'no components'


def test_error_model(pose_mixture, messages):
    """Both values are unknown if a publisher does not set them."""
    told = replace(pose_mixture, error_share=0.5, error_time=0.0)
    back = pose_mixture_of(pose_mixture_message(messages, told))
    assert (back.error_share, back.error_time) == (0.5, 0.0)
    message = pose_mixture_message(messages, pose_mixture)
    assert math.isnan(message.error_share)
    message.error_share = message.error_time = 0.0
    back = pose_mixture_of(message)
    assert math.isnan(back.error_share)
    assert math.isnan(back.error_time)
    for wrong in (-0.1, 1.1, math.inf):
        with pytest.raises(MessageError, match=r'error_share must lie in \(0, 1\]'):
            replace(pose_mixture, error_share=wrong)
    for wrong in (-0.1, math.inf):
        with pytest.raises(MessageError, match='error_time must be 0 s or more'):
            replace(pose_mixture, error_time=wrong)


def test_relative_covariances_are_those_of_samples():
    """Covariances of joints relative to the pelvis, whose position is the least certain.

    They include pose-independent errors of the joints.
    """
    body = load_body('human37')
    sigma = np.where(body.skeleton.dof_is_rotation, 1e-3, 0.3)
    mixture = GaussianMixture([1.0], body.prior_mean[None], np.diag(sigma**2)[None])
    content = PoseMixture.of_body(body, mixture, MixtureKind.POSTERIOR, 10**18, 'lens')
    rng = np.random.default_rng(0)
    joints = body.joint_positions(mixture.sample(4000, rng))
    seen = joints - joints[:, :1]
    assert content.joint_covariances_relative is not None
    assert content.joint_covariances is not None
    assert not content.joint_covariances_relative[0, 0].any()
    wrist = body.joint_names.index('left_wrist')
    wanted = np.cov(seen[:, wrist].T) + body.joint_errors[wrist] ** 2 * np.eye(3)
    found = content.joint_covariances_relative[0, wrist]
    assert np.abs(found - wanted).max() < 0.1 * wanted.max()
    assert content.joint_covariances[0, wrist].trace() > 50 * found.trace()


def test_messages_measure_root_angles_against_the_camera():
    """For any level of the body, because readers know no other reference."""
    body = load_body('human37')
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    level, pose = body.levelled(turn @ turn), body.prior_mean.copy()
    pose[:3], pose[3] = (0.3, 0.2, 4.0), 0.7
    covariance, velocity = np.diag(np.linspace(1e-4, 1e-2, body.dimension)), np.ones((1, 37))
    mixture = GaussianMixture([1.0], pose[None], covariance[None])
    content = PoseMixture.of_body(
        level, mixture, MixtureKind.LIKELIHOOD, 10**18, 'lens', velocities=velocity,
        shape_covariance=covariance, error_share=0.5, error_time=0.1,
    )  # fmt: skip
    assert content.joint_positions == pytest.approx(level.joint_positions(pose[None]))
    assert body.joint_positions(content.means) == pytest.approx(content.joint_positions, abs=1e-9)
    slopes = body.joint_jacobians(content.means)[0]
    wanted = content.joint_covariances[0] - np.square(body.joint_errors)[:, None, None] * np.eye(3)
    for found in (content.covariances[0], content.shape_covariance):
        assert slopes @ found @ slopes.transpose(0, 2, 1) == pytest.approx(wanted, abs=1e-9)
    # At the level of the camera the numbers do not change.
    same = PoseMixture.of_body(body, mixture, MixtureKind.POSTERIOR, 10**18, 'lens')
    assert np.array_equal(same.means, mixture.means)


def test_probability_of_existence(pose_mixture, messages):
    """NaN if unknown, also for publishers that do not set the field."""
    content = replace(pose_mixture, state=TrackState.LOST, existence_probability=0.25)
    message = pose_mixture_message(messages, content)
    assert pose_mixture_of(message).existence_probability == 0.25
    assert math.isnan(pose_mixture.existence_probability)
    unknown = pose_mixture_message(messages, pose_mixture)
    assert math.isnan(pose_mixture_of(unknown).existence_probability)
    untouched = replace(pose_mixture, state=TrackState.UNKNOWN, existence_probability=0.0)
    alone = pose_mixture_message(messages, untouched)
    assert math.isnan(pose_mixture_of(alone).existence_probability)
    nobody = replace(pose_mixture, state=TrackState.NOBODY, existence_probability=0.0)
    assert pose_mixture_of(pose_mixture_message(messages, nobody)).existence_probability == 0.0
    for wrong in (-0.1, 1.1, math.inf):
        with pytest.raises(MessageError, match=r'existence_probability must lie in \[0, 1\]'):
            replace(pose_mixture, existence_probability=wrong)


def test_probabilities_of_cues(pose_mixture, messages):
    """By name, in their order; empty if unknown."""
    told = {'silhouette': 0.25, 'keypoints/legs': 0.0, 'track': 1.0}
    message = pose_mixture_message(messages, replace(pose_mixture, cue_probabilities=told))
    back = pose_mixture_of(deserialise(serialise(message), POSE_MIXTURE))
    assert list(back.cue_probabilities.items()) == list(told.items())
    unknown = pose_mixture_message(messages, pose_mixture)
    assert pose_mixture_of(unknown).cue_probabilities == {}
    for wrong in (-0.1, 1.1, math.nan):
        error = r"cue_probabilities of 'track' must lie in \[0, 1\], saw"
        with pytest.raises(MessageError, match=error):
            replace(pose_mixture, cue_probabilities={'depth': 0.5, 'track': wrong})


CHAIN = {
    'posterior_weights': np.array([0.25, 0.0, 0.75]),
    'ancestry': np.array([[0.5, 0.5], [0.0, 1.0], [0.125, 0.875]]),
    'ancestry_stamp_ns': 1_700_000_000_000_000_001,
    'ancestry_ids': np.array([7, 2**32 - 1]),
}


def test_weights_and_ancestry_of_the_chain_of_the_modes(pose_mixture, messages):
    """Columns keep the order of their ids; rows follow their components."""
    message = pose_mixture_message(messages, replace(pose_mixture, **CHAIN))
    back = pose_mixture_of(deserialise(serialise(message), POSE_MIXTURE))
    assert back.identities.tolist() == pose_mixture.identities[::-1].tolist()
    assert back.posterior_weights.tolist() == CHAIN['posterior_weights'][::-1].tolist()
    assert back.ancestry.tolist() == CHAIN['ancestry'][::-1].tolist()
    assert back.ancestry_ids.tolist() == CHAIN['ancestry_ids'].tolist()
    assert back.ancestry_stamp_ns == CHAIN['ancestry_stamp_ns']
    assert serialise(pose_mixture_message(messages, back)) == serialise(message)
    # Weights without ancestry belong to first modes.
    weights = CHAIN['posterior_weights']
    for ancestry in (None, np.empty((3, 0))):
        begins = replace(pose_mixture, posterior_weights=weights, ancestry=ancestry)
        back = pose_mixture_of(pose_mixture_message(messages, begins))
        assert back.posterior_weights.tolist() == weights[::-1].tolist()
        assert (back.ancestry.shape, back.ancestry_ids.shape) == ((3, 0), (0,))
    # A publisher that sets none of them, or marks them as unknown.
    message = pose_mixture_message(messages, pose_mixture)
    for nothing in (0.0, math.nan):
        for component in message.components:
            component.posterior_weight = nothing
        back = pose_mixture_of(message)
        assert (back.posterior_weights, back.ancestry) == (None, None)
        assert (back.ancestry_stamp_ns, back.ancestry_ids.size) == (0, 0)


@pytest.mark.parametrize(
    ('field', 'value', 'error'),
    [
        ('0.posterior_weight', 0.5, r'mixture: posterior has weights that sum to 0.75, wanted 1'),
        ('1.posterior_weight', -0.25, r'mixture: posterior has the weight -0.25, wanted numbers'),
        ('2.posterior_weight', np.nan, r'mixture: posterior has the weight nan'),
        ('2.posterior_weight', np.inf, r'mixture: posterior has the weight inf'),
        ('1.ancestry', np.zeros(0), r'mixture: component 1: ancestry has 0 values, wanted 2'),
        ('1.ancestry', np.ones(3) / 3, r'mixture: component 1: ancestry has 3 values, wanted 2'),
        ('1.ancestry', np.array([0.5, 0.6]), r'ancestry of component 1 has weights that sum to 1'),
        ('1.ancestry', np.array([1.5, -0.5]), r'ancestry of component 1 has the weight -0.5, want'),
        ('1.ancestry', np.full(2, np.nan), r'ancestry of component 1 has the weight nan, wanted n'),
        ('ancestry_ids', np.array([], np.uint32), r'component 0: ancestry has 2 values, wanted 0'),
        ('ancestry_ids', np.array([5, 5], np.uint32), r'ancestry has the identity 5 twice'),
        ('2.id', 1, r'mixture has the identity 1 twice'),
    ],
)
def test_chains_that_contradict_themselves(pose_mixture, messages, field, value, error):
    message = pose_mixture_message(messages, replace(pose_mixture, **CHAIN))
    bend(field, value)(message)
    with pytest.raises(MessageError, match=error) as caught:
        pose_mixture_of(message)
    assert '\n' not in str(caught.value)


def test_ancestors_without_ancestry(pose_mixture):
    with pytest.raises(MessageError, match='mixture has ancestry_ids, and no ancestry'):
        replace(pose_mixture, ancestry_ids=CHAIN['ancestry_ids'])


def test_whose_poses_they_are():
    model = load_body('human37')
    person = model.with_stature(1.6)
    mixture = GaussianMixture([1.0], person.prior_mean[None], np.eye(37)[None])
    content = PoseMixture.of_body(person, mixture, MixtureKind.POSTERIOR, 7, 'camera')
    assert body_of(content, model).segment_lengths == person.segment_lengths
    assert body_of(replace(content, segment_lengths={}), model) is model
    renamed = replace(content, body_model='anna')
    assert body_of(renamed, model, any_name=True).segment_lengths == person.segment_lengths
    for strange, error in (
        (renamed, 'mixture is of the body anna, wanted one of human37'),
        (replace(content, segment_lengths={'tail': 1.0}), "body human37: .*'tail'"),
    ):
        with pytest.raises(MessageError, match=error) as caught:
            body_of(strange, model)
        assert caught.value.fault == 'body'
    with pytest.raises(MessageError, match='wanted 32') as caught:
        body_of(content, load_body('human32'), any_name=True)
    assert caught.value.fault == 'names'


def bend(path, value):
    """Sets a field of a message, or of a component as '0.mean'."""

    def change(message):
        index, _, name = path.rpartition('.')
        setattr(message.components[int(index)] if index else message, name, value)

    return change


def asymmetric():
    result = np.eye(4)
    result[0, 1] = 0.1
    return result.ravel()


@pytest.mark.parametrize(
    ('change', 'error'),
    [
        (bend('1.mean', np.zeros(3)), r'mixture: component 1: mean has 3 values, wanted 4'),
        (bend('1.mean', np.array([0, 0, np.nan, 0])), r'mean has values that are not finite'),
        (bend('1.covariance', np.zeros(0)), r'component 1 has no covariance, others have one'),
        (bend('2.covariance', np.zeros(15)), r'component 2: covariance has 15 values, wanted 16'),
        (bend('2.covariance', np.zeros(16)), r'covariance of mixture is not positive definite: sm'),
        (
            bend('2.covariance', -np.eye(4).ravel()),
            r'not positive definite: smallest eigenvalue -1',
        ),
        (bend('2.covariance', asymmetric()), r'covariance of mixture is not symmetric'),
        (bend('2.covariance', np.full(16, np.inf)), r'covariance of mixture has values that are n'),
        (bend('segment_names', ['a', 'a']), r"segment_names has the name 'a' twice"),
        (bend('segment_names', ['a']), r'segment_lengths has 2 values, wanted 1'),
        (bend('segment_lengths', np.array([1, np.inf])), r'segment_lengths has values that are n'),
        (bend('cue_names', ['depth']), r'cue_probabilities has 0 values, wanted 1'),
        (bend('cue_names', ['depth', 'depth']), r"cue_names has the name 'depth' twice"),
        (bend('cue_probabilities', np.ones(2)), r'cue_probabilities has 2 values, wanted 0'),
        (bend('0.weight', -0.5), r'mixture has the weight -0.5, wanted numbers from 0 to 1'),
        (bend('0.weight', np.nan), r'mixture has the weight nan'),
        (bend('0.weight', 0.51), r'mixture has weights that sum to 1.01, wanted 1'),
        (bend('0.joint_positions', []), r'component 0 has 0 joint_positions, wanted 2'),
        (bend('joint_names', ['pelvis']), r'component 0 has 2 joint_positions, wanted 1'),
        (bend('joint_names', ['a', 'a']), r"joint_names has the name 'a' twice"),
        (bend('dof_names', ['a', 'b', 'c', 'a']), r"dof_names has the name 'a' twice"),
        (bend('dof_names', ['a', 'b', 'c']), r'component 0: mean has 4 values, wanted 3'),
        (bend('kind', 9), r'mixture has the kind 9'),
    ],
)
def test_messages_that_contradict_themselves(pose_mixture, messages, change, error):
    message = pose_mixture_message(messages, pose_mixture)
    change(message)
    with pytest.raises(MessageError, match=error) as caught:
        pose_mixture_of(message)
    assert '\n' not in str(caught.value)


def test_more_components_than_anybody_publishes(pose_mixture, messages):
    message = pose_mixture_message(messages, pose_mixture)
    message.components = [message.components[0]] * 1025
    with pytest.raises(MessageError, match='mixture has 1025 components, the limit is 1024'):
        pose_mixture_of(message)
