"""Capsules that enclose a person over all modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.keep_out import BARE_BONE_RADIUS, MARGIN, Capsules, keep_out_capsules
from hmt_ros.body.kinematics import forward
from hmt_ros.inference import GaussianMixture

BODY = load_body('human37')


def posterior(depth=0.0, weights=(0.6, 0.395, 0.005)):
    """Modes 0.5 m apart sideways, with a given standard deviation of depth."""
    means = np.zeros((len(weights), BODY.dimension))
    means[:, 2] = 3.0
    means[:, 0] = 0.5 * np.arange(len(weights))
    variances = np.full(BODY.dimension, 1e-6)
    variances[2] += depth**2
    return GaussianMixture(
        np.array(weights), means, np.tile(np.diag(variances), (len(means), 1, 1))
    )


def test_capsules_hold_points():
    one = Capsules(np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 2.0]]), np.array([0.5]))
    points = np.array([[0.4, 0.0, 1.0], [0.6, 0.0, 1.0], [0.0, 0.0, 2.4], [0.0, 0.4, 2.4]])
    assert one.contain(points).tolist() == [True, False, True, False]
    np.testing.assert_allclose(one.depths(points)[:3, 0], [0.1, -0.1, 0.1])


def test_every_joint_of_every_mode_that_counts_is_inside():
    mixture = posterior()
    joints = BODY.joint_positions(mixture.means)
    inside = keep_out_capsules(BODY, mixture)
    assert inside.contain(joints[0]).all()
    assert inside.contain(joints[1]).all()
    # The third mode is less probable than the probability left outside.
    assert not inside.contain(joints[2]).all()
    assert keep_out_capsules(BODY, mixture, 0.9999).contain(joints[2]).all()


def test_the_flesh_is_inside():
    mixture = posterior(weights=(1.0,))
    mesh = BODY.flesh.mesh()
    frames = forward(BODY.skeleton, mixture.means)
    points = frames.points(mesh.segments, mesh.vertices)[..., 0]
    held = keep_out_capsules(BODY, mixture)
    assert (held.depths(points).max(1) > 0.5 * MARGIN).all()


@pytest.mark.parametrize('probability', [0.5, 0.9, 0.99])
def test_drawn_joints_are_inside_as_often_as_asked_for(probability):
    """At least as often for each joint; depth varies by 1.5 m."""
    mixture = posterior(depth=0.5, weights=(0.7, 0.3))
    drawn = mixture.sample(300, np.random.default_rng(0))
    joints = BODY.joint_positions(drawn)
    held = keep_out_capsules(BODY, mixture, probability)
    inside = held.contain(joints.reshape(-1, 3)).reshape(joints.shape[:2])
    assert inside.mean(0).min() >= probability - 0.05
    assert inside.mean() < 1.0 or probability > 0.9


def test_a_body_without_flesh_has_its_bones():
    bare = replace(BODY, shapes=(), growth=())
    held = keep_out_capsules(bare, posterior(weights=(1.0,)))
    assert len(held) <= len(BODY.skeleton.bones)
    assert held.radii.min() == pytest.approx(BARE_BONE_RADIUS + MARGIN, abs=0.03)
    assert held.contain(BODY.joint_positions(posterior(weights=(1.0,)).means)[0]).all()


@pytest.mark.parametrize(
    ('how', 'text'),
    [
        ({'probability': 1.0}, 'probability must be between 0 and 1, saw 1.0'),
        ({'probability': np.nan}, 'probability must be between 0 and 1, saw nan'),
    ],
)
def test_what_is_refused(how, text):
    with pytest.raises(ValueError, match=text):
        keep_out_capsules(BODY, posterior(), **how)


def test_of_nobody_there_is_no_place():
    empty = posterior()[np.array([], dtype=int)]
    with pytest.raises(ValueError, match='no modes'):
        keep_out_capsules(BODY, empty)
