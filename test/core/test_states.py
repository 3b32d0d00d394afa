"""States of modes and chains in the compiled core, compared with numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from hmt_ros.core import (
    correct_states,
    fuse,
    predict_damped,
    step_chains,
    widen_precisions,
)
from hmt_ros.inference.linear_algebra import exponential
from hmt_ros.inference.motion_states import Predicted
from test.core.arguments import assert_arguments_are_checked

UNKNOWN = 1e6


def positive(rng, count, n):
    root = rng.normal(size=(count, n, n))
    return root @ root.swapaxes(1, 2) + 0.1 * np.eye(n)


def found_states(seed, count=6, modes=3, d=5):
    """Arguments of `correct_states`, in their order."""
    rng = np.random.default_rng(seed)
    return {
        'predicted': Predicted(
            rng.normal(size=(modes, 2 * d)),
            positive(rng, modes, 2 * d),
            UNKNOWN,
            positive(rng, 1, d)[0],
        ),
        'ancestors': rng.integers(0, modes, count),
        'jumped': rng.random((count, d)) < 0.3,
        'poses': rng.normal(size=(count, d)),
        'found': positive(rng, count, d),
        'velocities': np.empty((count, d)),
        'result': np.empty((count, 2 * d, 2 * d)),
    }


@pytest.mark.parametrize('d', [1, 5, 37])
def test_states_are_conditioned_on_poses(d):
    x = found_states(d, d=d)
    correct_states(*x.values())
    for n, ancestor in enumerate(x['ancestors']):
        own, mean, jumped = (
            x['predicted'].covariances[ancestor],
            x['predicted'].means[ancestor],
            x['jumped'][n],
        )
        gain = own[d:, :d] @ np.linalg.inv(own[:d, :d] + UNKNOWN * np.diag(jumped))
        velocity = mean[d:] + gain @ (x['poses'][n] - mean[:d])
        np.testing.assert_allclose(x['velocities'][n], np.where(jumped, 0.0, velocity), atol=1e-9)
        found, result = x['found'][n], x['result'][n]
        inner = own[d:, d:] - gain @ own[:d, d:] + gain @ found @ gain.T
        inner[jumped] = inner[:, jumped] = 0.0
        inner[np.ix_(jumped, jumped)] = x['predicted'].unknown_velocity[np.ix_(jumped, jumped)]
        np.testing.assert_allclose(result[d:, d:], inner, atol=1e-9)
        np.testing.assert_allclose(
            result[d:, :d], np.where(jumped[:, None], 0.0, gain @ found), atol=1e-9
        )
        np.testing.assert_array_equal(result[:d, :d], found)
        np.testing.assert_array_equal(result, result.T)


@pytest.mark.parametrize('d', [1, 5, 37])
def test_precisions_of_what_jumped(d):
    rng = np.random.default_rng(d)
    covariances, ancestors = positive(rng, 3, d), rng.integers(0, 3, 8)
    jumped, wandered = rng.random((8, d)) < 0.4, rng.uniform(0.0, 9.0, d)
    jumped[0], jumped[1], wandered[0] = True, False, 0.0
    result = np.empty((8, d, d))
    widen_precisions(np.linalg.inv(covariances), ancestors, jumped, wandered, result)
    added = np.eye(d) * np.where(jumped, wandered, 0.0)[:, None]
    np.testing.assert_allclose(result, np.linalg.inv(covariances[ancestors] + added), atol=1e-9)


def test_a_covariance_that_is_not_positive_is_refused():
    x = found_states(0)
    x['predicted'].covariances[:] = -1.0
    with pytest.raises(ValueError, match='wanted a positive definite'):
        correct_states(*x.values())


@pytest.mark.parametrize('dt', [0.0, 1e-3, 0.5, 1e4])
def test_chains_move_on_together(dt):
    rng = np.random.default_rng(0)
    rates, joint = rng.uniform(0.0, 2.0, (3, 2)), rng.dirichlet(np.ones(8))
    wanted = joint.reshape(2, 2, 2)
    for axis, (begins, ends) in enumerate(rates):
        moved = expm(np.array([[-begins, begins], [ends, -ends]]) * dt)
        wanted = np.moveaxis(np.tensordot(moved, wanted, axes=(0, axis)), 0, axis)
    step_chains(rates, dt, joint)
    np.testing.assert_allclose(joint, wanted.ravel(), atol=1e-14)


@pytest.mark.parametrize('size', [0.0, 1e-9, 1e-2, 1.0, 30.0, 1e3])
@pytest.mark.parametrize('n', [1, 2, 7, 40])
def test_the_exponential_of_a_matrix(n, size):
    matrices = np.random.default_rng(n).normal(size=(3, n, n))
    matrices -= 2.0 * np.sqrt(n) * np.eye(n)  # which decays
    np.testing.assert_allclose(
        exponential(size * matrices), expm(size * matrices), rtol=1e-11, atol=1e-13
    )
    with pytest.raises(np.linalg.LinAlgError):
        exponential(np.full((n, n), np.nan))


def test_arguments_that_do_not_fit():
    rng = np.random.default_rng(0)
    assert_arguments_are_checked(correct_states, found_states(1), 'velocities result')
    a, b = positive(rng, 4, 3), positive(rng, 4, 3)
    named = {'a': a, 'b': b, 'result': np.empty_like(a)}
    assert_arguments_are_checked(fuse, named, 'result')
    named = {'precisions': a, 'ancestors': np.array([3, 0]), 'jumped': np.ones((2, 3), np.bool_)}
    named |= {'wandered': np.ones(3), 'result': np.empty((2, 3, 3))}
    assert_arguments_are_checked(widen_precisions, named, 'result', free='precisions')
    named = {'a': np.ones(3), 'b': np.ones(3), 'noise': np.eye(6), 'means': np.ones((4, 6))}
    named |= {'covariances': positive(rng, 4, 6), 'moved': np.ones((4, 6))}
    named |= {'result': np.ones((4, 6, 6))}
    assert_arguments_are_checked(predict_damped, named, 'moved result')
    named = {'rates': np.ones((3, 2)), 'dt': 0.1, 'joint': np.ones(8)}
    assert_arguments_are_checked(step_chains, named, 'joint')
