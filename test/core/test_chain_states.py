from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from hmt_ros.body.resting_points import RestingTable
from hmt_ros.core import condition_chain
from hmt_ros.smoothing.motion_smoother import ChainPrior
from test.core.arguments import assert_arguments_are_checked

TIMES, N, D = 4, 5, 3


class Chain(NamedTuple):
    prior: ChainPrior
    precisions: np.ndarray
    means: np.ndarray
    resting: RestingTable
    columns: np.ndarray
    states: np.ndarray


def chain(resting: int, times: int = TIMES) -> Chain:
    """A chain with two different intervals; its transition is a random matrix."""
    rng = np.random.default_rng(resting)

    def positive(count: int, size: int) -> np.ndarray:
        root = rng.normal(size=(count, size, size))
        return root @ root.swapaxes(1, 2) + np.eye(size)

    step, after, known = rng.normal(size=(2, N, N)), positive(2, N), positive(1, N)[0]
    forth = after @ step
    prior = ChainPrior(
        step.swapaxes(1, 2) @ forth,
        after,
        forth,
        np.arange(times - 1) % 2,
        rng.uniform(0.5, 2.0, size=times - 1),
        known,
        rng.normal(size=N),
    )
    table = RestingTable(
        rng.normal(size=(times, resting, D)),
        rng.normal(size=(times, resting)),
        rng.uniform(size=(times - 1, resting)),
    )
    room = np.full((times * N, 2 * N), np.nan), np.full((times, N), np.nan)
    return Chain(prior, positive(times, D), rng.normal(size=(times, D)), table, *room)


def dense(given: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (T n, T n) and right side (T n,) of the energy, residual by residual."""
    prior, resting, times = given.prior, given.resting, len(given.means)
    hessian, right = np.zeros((times, N, times, N)), np.zeros((times, N))
    hessian[0, :, 0] += prior.known
    right[0] += prior.pull
    for t in range(times):
        hessian[t, :D, t, :D] += given.precisions[t]
        right[t, :D] += given.precisions[t] @ given.means[t]
    for t in range(times - 1):
        i, s = prior.which[t], prior.shares[t]
        hessian[t, :, t] += s * prior.before[i]
        hessian[t + 1, :, t + 1] += s * prior.after[i]
        hessian[t + 1, :, t] -= s * prior.forth[i]
        hessian[t, :, t + 1] -= s * prior.forth[i].T
        for r, weight in enumerate(resting.weights[t]):
            slope = np.zeros((times, N))
            slope[t, :D], slope[t + 1, :D] = -resting.jacobians[t, r], resting.jacobians[t + 1, r]
            hessian += weight * np.einsum('ti,uj->tiuj', slope, slope)
            right -= weight * (resting.places[t + 1, r] - resting.places[t, r]) * slope
    return hessian.reshape(times * N, -1), right.reshape(-1)


@pytest.mark.parametrize(('resting', 'times'), [(0, TIMES), (2, TIMES), (0, 1)])
def test_the_states_are_those_of_least_energy(resting, times):
    given = chain(resting, times)
    assert condition_chain(*given) == times * N
    hessian, right = dense(given)
    wanted = np.linalg.solve(hessian, right)
    np.testing.assert_allclose(given.states.reshape(-1), wanted, rtol=1e-10, atol=1e-10)
    reverse = hessian.reshape(times, N, times, N)[::-1, :, ::-1].reshape(times * N, -1)
    factor = np.linalg.cholesky(reverse)
    for j, column in enumerate(given.columns):
        rows = min(2 * N, times * N - j)
        np.testing.assert_allclose(column[:rows], factor[j : j + rows, j], atol=1e-10)


def test_a_precision_that_is_not_positive_has_no_states():
    given = chain(0)
    assert condition_chain(*given._replace(precisions=-100.0 * given.precisions)) < TIMES * N
    assert np.isnan(given.states).all()


def test_what_does_not_fit_is_refused():
    assert_arguments_are_checked(condition_chain, chain(2)._asdict(), 'columns states')
