"""Pairs of Gaussians: invalid arguments are refused; the tests of reduction check values."""

from __future__ import annotations

import numpy as np

from hmt_ros.core import whiten_pairs
from test.core.arguments import assert_arguments_are_checked


def test_pairs_need_arguments_that_fit():
    covariances = np.tile(np.eye(4), (3, 1, 1))
    given = {
        'means_a': np.ones((3, 4)),
        'covariances_a': covariances,
        'means_b': np.zeros((3, 4)),
        'covariances_b': covariances.copy(),
        'pairs': np.array([[0, 1], [2, 0], [1, 1], [2, 2], [0, 0]]),
        'scales': np.full((5, 2), 0.5),
        'squares': np.zeros(5),
        'log_determinants': np.zeros(5),
    }
    assert_arguments_are_checked(whiten_pairs, given, 'squares log_determinants')
    whiten_pairs(*given.values())
    assert np.allclose(given['squares'], 4.0)
    assert np.allclose(given['log_determinants'], 0.0)
