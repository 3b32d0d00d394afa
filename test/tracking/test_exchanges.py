"""Exchanged sides from image to image."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.image.keypoint_schemes import usual_exchanges
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.tracking.exchanges import SideExchanges
from test.image.test_keypoints import BODY, CAMERA, exchanged, seen

LIMBS = ('shoulder', 'elbow', 'wrist', 'hand', 'hip', 'knee', 'ankle', 'toe')


def standing():
    pose = BODY.prior_mean.copy()
    pose[:3], pose[3] = (0.1, 0.0, 4.0), 0.4
    return pose


def after(observation, count, dt=1.0 / 30.0):
    """Exchanges after so many images of one pose."""
    one, likelihood = SideExchanges(), ImageLikelihood(BODY, CAMERA)
    for _ in range(count):
        one.predict(dt)
        prior = one.of(np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.bool_))
        one.update(likelihood, observation, standing()[None], prior)
    return one


def test_nothing_is_known_at_first():
    one = SideExchanges()
    one.predict(0.1)
    np.testing.assert_array_equal(
        one.of(np.array([0, 3]), np.zeros(2, dtype=np.bool_)), np.repeat(usual_exchanges(), 2, 0)
    )
    assert one.probabilities is None


def test_an_exchange_is_expected_to_stay_and_is_forgotten():
    turned = Observation(keypoints=exchanged(seen(standing()), LIMBS))
    one = after(turned, 3)
    assert one.probabilities[0, 1] > 0.9
    one.predict(1.0 / 30.0)
    assert np.exp(one.prior[0, 1]) > 0.6
    one.predict(60.0)
    assert np.exp(one.prior[0, 0]) == pytest.approx(np.exp(one.prior[0, 1]), rel=1e-3)


def test_images_without_keypoints_only_let_time_pass():
    turned = Observation(keypoints=exchanged(seen(standing()), LIMBS))
    one, likelihood = after(turned, 3), ImageLikelihood(BODY, CAMERA)
    before = one.probabilities[0, 1]
    one.predict(1.0 / 30.0)
    prior = one.of(np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.bool_))
    one.update(likelihood, Observation(), standing()[None], prior)
    assert one.probabilities[0, 1] < before


def test_who_faces_the_other_way_has_the_other_sides():
    one = after(Observation(keypoints=seen(standing())), 3)
    one.predict(1.0 / 30.0)
    own = one.of(np.zeros(2, dtype=np.intp), np.array([False, True]))
    np.testing.assert_allclose(np.exp(own[1, :2]), np.exp(own[0, :2]).mean())
    np.testing.assert_allclose(np.exp(own).sum(1), 1.0, rtol=1e-3)
