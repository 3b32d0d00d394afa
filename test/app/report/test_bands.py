"""Heights and angles over time, and their intervals of 90 %."""

from __future__ import annotations

import base64

import numpy as np
import pytest
from scipy.stats import norm

from hmt_ros.app.report.mixtures import PROBABILITIES, intervals, marginals_of
from hmt_ros.inference import GaussianMixture
from msg_tools.messages.ground import GroundState
from msg_tools.messages.headers import FRAME_ID
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture
from test.app.conftest import FRAMES, STAMPS, data_of, make
from test.app.report.test_command import UP, with_ground

pytestmark = pytest.mark.usefixtures('no_pictures')

GROUND = GroundState(STAMPS[0], FRAME_ID, UP, height=1.5)


def test_intervals_of_one_component_are_those_of_a_normal_distribution():
    marginals = np.array([[[1.0, -200.0]], [[0.1, 30.0]]])
    found = intervals(np.ones(1), marginals)
    wanted = norm.ppf(PROBABILITIES, [[1.0], [-200.0]], [[0.1], [30.0]])
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_intervals_of_a_mixture_hold_ninety_percent():
    rng = np.random.default_rng(0)
    weights = np.array([0.5, 0.3, 0.2])
    marginals = np.stack([rng.normal(size=(3, 4)), rng.uniform(0.1, 0.8, (3, 4))])
    drawn = rng.choice(3, 200_000, p=weights)
    samples = marginals[0, drawn] + marginals[1, drawn] * rng.normal(size=(len(drawn), 4))
    found = intervals(weights, marginals)
    share = (samples[..., None] < found).mean(axis=0)
    np.testing.assert_allclose(share, np.tile(PROBABILITIES, (4, 1)), atol=0.003)


def content_of(body, means, **changes):
    covariances = np.tile(np.diag(np.linspace(0.001, 0.01, body.dimension)), (len(means), 1, 1))
    weights = np.full(len(means), 1.0 / len(means))
    mixture = GaussianMixture(weights, means, covariances)
    content = PoseMixture.of_body(body, mixture, MixtureKind.POSTERIOR, STAMPS[0], FRAME_ID)
    return PoseMixture(**{**vars(content), **changes})


def test_heights_are_those_above_the_floor(body, poses):
    content = content_of(body, poses[:2])
    means, sigmas = marginals_of(content, None, GROUND)
    joints = len(body.joint_names)
    assert means.shape == sigmas.shape == (2, joints)
    np.testing.assert_allclose(means, content.joint_positions @ UP + 1.5)
    drawn = np.random.default_rng(0).multivariate_normal(
        content.joint_positions[0, 3], content.joint_covariances[0, 3], 50_000
    )
    assert sigmas[0, 3] == pytest.approx((drawn @ UP).std(), rel=0.02)
    level, _ = marginals_of(content, None, None)
    np.testing.assert_allclose(level, -content.joint_positions[..., 1])


def test_angles_lie_around_those_of_the_heaviest_component(body, poses):
    means = poses[:2].copy()
    heading = body.dof_names.index('root_z')
    means[:, heading] = [3.1, -3.1]
    found, sigmas = marginals_of(content_of(body, means), body, None)
    joints = len(body.joint_names)
    assert found.shape[1] == joints + body.dimension - 3
    np.testing.assert_allclose(
        found[:, joints], np.degrees([3.1, 2.0 * np.pi - 3.1]), err_msg='the heading is the first'
    )
    wanted = np.degrees(np.sqrt(np.linspace(0.001, 0.01, body.dimension)[3:]))
    np.testing.assert_allclose(sigmas[0, joints:], wanted)


def numbers(text, shape):
    return np.frombuffer(base64.b64decode(text), '<i2').reshape(shape)


def test_the_page_has_the_bands_of_filter_and_smoother(made, body, poses, tmp_path):
    data = data_of(make(with_ground(tmp_path, body, poses), tmp_path / 'report'))
    bands = {layer['kind']: layer['bands'] for layer in data['layers']}
    assert set(bands) == {'posterior', 'smoothed'}
    names = [*body.joint_names, *body.dof_names[3:]]
    assert bands['smoothed']['joints'] + bands['smoothed']['angles'] == names
    values = numbers(bands['smoothed']['values'], (FRAMES, len(names), 3))
    assert (np.diff(values, axis=-1) > 0).all()
    # Modes err by about 0.1 rad or m, so the truth is in the intervals or near them.
    true = body.joint_positions(poses) @ UP + 1.5
    found = 1e-3 * values[:, : len(body.joint_names), 1]
    assert np.abs(found - true).mean() < 0.15
    known = numbers(data['truth']['heights'], true.shape)
    np.testing.assert_allclose(1e-3 * known, true, atol=6e-4)
