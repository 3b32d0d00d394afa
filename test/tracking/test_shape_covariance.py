"""The covariance of the lengths at a start is where the estimate of the shape begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.shape import MIN_LENGTH_SIGMA
from hmt_ros.image.subject import Subject
from hmt_ros.tracking.initialisation import start_from_keypoints
from hmt_ros.tracking.shape_estimation import ShapeEstimate


@pytest.mark.parametrize('size', [1.0, 0.05])
def test_an_estimate_starts_with_the_covariance_of_the_lengths(size):
    """Down to the lower bound of the standard deviation of a length."""
    body = load_body('human37')
    body = replace(body, length_covariance=size**2 * body.length_covariance)
    count = len(body.skeleton.lengths)
    covariance = ShapeEstimate(body).covariance
    found = covariance[:count, :count]
    off = ~np.eye(count, dtype=bool)
    assert np.allclose(found[off], body.length_covariance[off])
    wanted = np.maximum(body.length_sigma, MIN_LENGTH_SIGMA)
    assert np.allclose(np.sqrt(np.diagonal(found)), wanted)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert not covariance[:count, count:].any()


def test_a_start_leaves_the_size_open_but_not_the_proportions(
    human32, camera, keypoints_of, motion
):
    keypoints = keypoints_of(human32, motion[6], 1.0)
    free = start_from_keypoints(human32, camera, Subject(0, keypoints, {}, None)).body
    measured = start_from_keypoints(
        human32, camera, Subject(0, keypoints, {}, human32.stature)
    ).body
    rates = human32.stature_rates

    def deviation(body, direction) -> float:
        return float(np.sqrt(direction @ body.length_covariance @ direction))

    # One view does not determine the size, so the errors of lengths are correlated.
    assert deviation(free, rates) > 0.7 * deviation(human32, rates)
    assert deviation(measured, rates) < 0.021
    names = human32.skeleton.length_names
    ratio = np.zeros(len(names))
    thigh, shin = names.index('thigh'), names.index('shin')
    ratio[[thigh, shin]] = 1.0, -free.skeleton.lengths[thigh] / free.skeleton.lengths[shin]
    assert deviation(free, ratio) < deviation(human32, ratio)
    covariance = free.length_covariance
    assert covariance[thigh, shin] > 0.5 * np.sqrt(
        covariance[thigh, thigh] * covariance[shin, shin]
    )
