"""The prior of poses: invalid arguments are refused; the tests of `body` check values."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import load_body
from hmt_ros.body.pose_prior import pose_prior
from hmt_ros.core import evaluate_prior_at
from test.core.arguments import assert_arguments_are_checked


def test_the_prior_needs_arguments_that_fit():
    body = load_body('human37')
    n, d = 2, body.dimension
    results = {
        'value': np.zeros(n),
        'gradient': np.zeros((n, d)),
        'hessian': np.zeros((n, d, d)),
    }
    for kind in ('learned', 'angles'):
        given = {'model': pose_prior(body, kind, 1.0).compiled, 'poses': np.zeros((n, d))}
        if kind == 'learned':
            assert_arguments_are_checked(evaluate_prior_at, given | results, ' '.join(results))
        else:
            evaluate_prior_at(*given.values(), *results.values())
            assert np.allclose(results['gradient'], -body.prior_mean * given['model'].rest)
