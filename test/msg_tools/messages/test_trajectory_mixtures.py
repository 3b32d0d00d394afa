"""TrajectoryMixture to arrays and back; invalid messages are refused."""

from dataclasses import replace

import numpy as np
import pytest

from msg_tools import MessageError
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.trajectory_mixtures import (
    TrajectoryMixture,
    trajectory_mixture_message,
    trajectory_mixture_of,
)

RNG = np.random.default_rng(4)
ROOT = RNG.normal(size=(2, 5, 3, 3))
COVARIANCES = ROOT @ ROOT.transpose(0, 1, 3, 2) + np.eye(3)
CONTENT = TrajectoryMixture(
    weights=np.array([0.4, 0.6]),
    means=RNG.normal(size=(2, 5, 3)),
    marginal_covariances=(COVARIANCES + COVARIANCES.transpose(0, 1, 3, 2)) / 2,
    log_joint=np.array([-10.0, -9.0]),
    inflation=np.array([1.0, 1.2]),
    stamps_ns=tuple(10**18 + 33 * i for i in range(5)),
    final_until_ns=10**18 + 33,
    free_energy=np.array([5.0, 4.0]),
    body_model='human34',
    dof_names=('x', 'y', 'bend'),
    frame_id='camera',
    joint_names=('pelvis', 'head'),
    joint_positions=RNG.normal(size=(2, 5, 2, 3)),
    identities=np.array([7, 2]),
)


def test_round_trip_sorts_by_weight(messages):
    data = serialise(trajectory_mixture_message(messages, CONTENT))
    message = deserialise(data, 'hmt_msgs/msg/TrajectoryMixture')
    assert message.header.stamp == message.stamps[-1]
    back = trajectory_mixture_of(message, CONTENT.dof_names)
    for name in (
        'weights', 'means', 'marginal_covariances', 'log_joint', 'inflation', 'joint_positions',
        'identities',
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(back, name), getattr(CONTENT, name)[::-1])
    np.testing.assert_array_equal(back.free_energy, CONTENT.free_energy)
    for name in (
        'stamps_ns', 'final_until_ns', 'body_model', 'dof_names', 'frame_id', 'joint_names',
    ):  # fmt: skip
        assert getattr(back, name) == getattr(CONTENT, name)


def test_without_covariances(messages):
    content = replace(CONTENT, marginal_covariances=None)
    back = trajectory_mixture_of(trajectory_mixture_message(messages, content))
    assert back.marginal_covariances is None
    np.testing.assert_array_equal(back.means, CONTENT.means[::-1])


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'weights': np.array([0.4, 0.4])}, r'weights that sum to 0.8, wanted 1'),
        ({'weights': np.array([1e308, 1e308])}, r'weights that sum to inf, wanted 1'),
        ({'means': np.zeros((2, 4, 3))}, r'means has shape \(2, 4, 3\), wanted \(2, 5, 3\)'),
        ({'stamps_ns': (1, 2, 2, 3, 4)}, r'stamps do not increase'),
        ({'stamps_ns': ()}, r'2 components of 0 poses, wanted one at least'),
        ({'marginal_covariances': np.zeros((2, 5, 3, 3))}, r'not positive definite'),
        ({'log_joint': np.zeros(3)}, r'log_joint has shape \(3,\), wanted \(2,\)'),
        ({'joint_names': ('a',)}, r'joint_positions has shape \(2, 5, 2, 3\), wanted'),
        ({'joint_positions': np.full((2, 5, 2, 3), np.nan)}, r'joint_positions has values'),
        ({'dof_names': ('x', 'y', 'x')}, r"dof_names has the name 'x' twice"),
        ({'means': np.full((2, 5, 3), np.inf)}, r'means has values that are not finite'),
    ],
)
def test_content_that_no_message_may_have(changes, error):
    with pytest.raises(MessageError, match=error):
        replace(CONTENT, **changes)


def test_messages_that_contradict_themselves(messages):
    message = trajectory_mixture_message(messages, CONTENT)
    with pytest.raises(MessageError, match="dof_names has 'bend' at 2, wanted 'twist'"):
        trajectory_mixture_of(message, ('x', 'y', 'twist'))
    message.components[1].means = np.zeros(14)
    with pytest.raises(MessageError, match='component 1: means has 14 values, wanted 15'):
        trajectory_mixture_of(message)
    for name in ('marginal_covariances', 'joint_positions'):
        message = trajectory_mixture_message(messages, CONTENT)
        setattr(message.components[0], name, np.zeros(0))
        with pytest.raises(MessageError, match=f'has no {name}, others have one'):
            trajectory_mixture_of(message)
    message.components = []
    with pytest.raises(MessageError, match='no components'):
        trajectory_mixture_of(message)
