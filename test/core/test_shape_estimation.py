"""Information of modes about the shape and back: sums in numpy; bad input is refused."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros import core
from test.core.arguments import assert_arguments_are_checked

K, P, D = 3, 7, 9
MOST_TURN = 0.2
RNG = np.random.default_rng(0)
TURNS = np.arange(D) >= 3


def positive(*shape):
    roots = RNG.normal(size=(*shape, shape[-1]))
    return roots @ roots.swapaxes(-1, -2) + np.eye(shape[-1])


MIXED, COVARIANCES, OF_SHAPE = RNG.normal(size=(K, P, D)), positive(K, D), positive(P)
# An angle on a limit has no variance.
COVARIANCES[1, 4] = COVARIANCES[1, :, 4] = 0.0
GRADIENTS = {
    'by_shape': RNG.normal(size=(K, P)),
    'curvature': positive(K, P),
    'mixed': MIXED,
    'weights': np.array([0.5, 0.3, 0.2]),
    'gradients': RNG.normal(size=(K, D)),
    'covariances': COVARIANCES,
    'turns': TURNS,
    'most_turn': MOST_TURN,
}


def limited(shift, covariance):
    if np.abs(shift).max() <= MOST_TURN:
        return shift
    most = max(np.abs(shift[TURNS]).max(), MOST_TURN)
    excess = shift[TURNS] * (1.0 - MOST_TURN / most)
    result = shift.copy()
    result[TURNS] -= excess
    free = TURNS & (np.diagonal(covariance) > 0)
    by_turns = np.linalg.solve(covariance[np.ix_(free, free)], excess[free[TURNS]])
    result[~TURNS] -= covariance[np.ix_(~TURNS, free)] @ by_turns
    return result


def test_the_uncertain_shape_moves_modes():
    result = np.empty((K, D, D))
    core.consider_shape(MIXED, COVARIANCES, OF_SHAPE, result)
    for own, mixed, covariance in zip(result, MIXED, COVARIANCES, strict=True):
        moved = covariance @ mixed.T
        np.testing.assert_allclose(own, moved @ OF_SHAPE @ moved.T, rtol=1e-11, atol=1e-11)
        assert np.array_equal(own, own.T)
    named = {'mixed': MIXED, 'covariances': COVARIANCES, 'of_shape': OF_SHAPE, 'result': result}
    assert_arguments_are_checked(core.consider_shape, named, 'result')


@pytest.mark.parametrize('size', [1e-3, 0.1, 3.0])
def test_poses_that_give_way_leave_information_on_the_shape(size):
    information, pull = np.empty((P, P)), np.empty(P)
    named = GRADIENTS | {'gradients': size * GRADIENTS['gradients']}
    assert core.inform_shape(*named.values(), information, pull)
    wanted, wanted_pull = np.zeros((P, P)), np.zeros(P)
    for k, weight in enumerate(named['weights']):
        mixed, covariance = MIXED[k], COVARIANCES[k]
        shift = limited(covariance @ named['gradients'][k], covariance)
        wanted += weight * (named['curvature'][k] - mixed @ covariance @ mixed.T)
        wanted_pull += weight * (named['by_shape'][k] - mixed @ shift)
    np.testing.assert_allclose(information, wanted, rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(pull, wanted_pull, rtol=1e-11, atol=1e-10)


def test_arguments_about_the_shape_must_fit():
    outputs = {'information': np.empty((P, P)), 'pull': np.empty(P)}
    assert_arguments_are_checked(core.inform_shape, GRADIENTS | outputs, ' '.join(outputs))


def test_angles_that_do_not_move_by_themselves_are_singular():
    covariances = COVARIANCES.copy()
    covariances[0, 5:7] = covariances[0, :, 5:7] = 0.0
    covariances[0, 5:7, 5:7] = 1.0
    named = GRADIENTS | {'covariances': covariances, 'gradients': 100.0 * GRADIENTS['gradients']}
    assert not core.inform_shape(*named.values(), np.empty((P, P)), np.empty(P))
