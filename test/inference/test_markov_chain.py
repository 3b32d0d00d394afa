"""The chain of states against the exponential of its rates, and all sequences of states."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from hmt_ros.inference.markov_chain import MarkovChain, of_log_odds, update

PROBABILITIES = st.floats(0.0, 1.0)
TIMES = st.floats(0.0, 1e4)
TWO = MarkovChain.of_two(0.1, 0.2)
THREE = MarkovChain(np.array([[9.0, 0.3, 0.1], [0.0, 9.0, 2.0], [0.5, 0.0, 9.0]]))


@given(PROBABILITIES, TIMES, TIMES)
def test_where_nothing_is_said_time_can_be_divided_at_will(r, first, second):
    """Chapman-Kolmogorov."""
    p = [1.0 - r, r]
    assert TWO.predict(TWO.predict(p, first), second) == pytest.approx(
        TWO.predict(p, first + second), abs=1e-12
    )


@pytest.mark.parametrize('chain', [TWO, THREE])
@pytest.mark.parametrize('dt', [0.0, 0.03, 1.0, 20.0])
def test_the_chain_is_the_exponential_of_its_rates(chain, dt):
    generator = chain.rates.copy()
    np.fill_diagonal(generator, 0.0)
    np.fill_diagonal(generator, -generator.sum(1))
    assert chain.transition(dt) == pytest.approx(expm(generator * dt), abs=1e-13)


@pytest.mark.parametrize('chain', [TWO, THREE])
def test_after_a_long_time_it_is_as_usual(chain):
    assert chain.usual.sum() == pytest.approx(1.0)
    assert chain.predict(np.eye(len(chain.usual)), 1e3) == pytest.approx(
        np.tile(chain.usual, (len(chain.usual), 1)), abs=1e-12
    )


def test_two_states_are_named_by_the_rates():
    """The state begins three times as often as it ends."""
    assert MarkovChain.of_two(0.3, 0.1).usual == pytest.approx([0.25, 0.75])
    assert MarkovChain.of_two(0.3, 0.1).predict([1.0, 0.0], 1e-6)[1] == pytest.approx(0.3e-6)


@given(PROBABILITIES, st.lists(st.tuples(TIMES, st.floats(-1e3, 1e3)), max_size=8))
def test_it_is_always_a_probability(r, steps):
    p = np.array([1.0 - r, r])
    for dt, llr in steps:
        p = update(TWO.predict(p, dt), [0.0, llr])
        assert p.sum() == pytest.approx(1.0)
        assert (p >= 0.0).all()


@pytest.mark.parametrize('chain', [TWO, THREE])
def test_against_all_sequences_of_states(chain):
    """p(state | y_1:T) by enumerating n^T sequences of the hidden Markov chain."""
    rng = np.random.default_rng(0)
    n, steps = len(chain.rates), 6
    times, says = rng.uniform(0.05, 3.0, steps), rng.normal(0.0, 2.0, (steps, n))
    p = start = rng.dirichlet(np.ones(n))
    for dt, say in zip(times, says, strict=True):
        p = update(chain.predict(p, dt), say)
    total = np.zeros(n)
    for states in itertools.product(range(n), repeat=steps + 1):
        product = start[states[0]]
        for before, after, dt, say in zip(states, states[1:], times, says, strict=False):
            product *= chain.transition(dt)[before, after] * math.exp(say[after])
        total[states[-1]] += product
    assert p == pytest.approx(total / total.sum(), rel=1e-9)


@given(st.floats(-700.0, 700.0))
def test_log_odds(value):
    p = of_log_odds(value)
    assert p.sum() == pytest.approx(1.0)
    if abs(value) < 30.0:
        assert math.log(p[1] / p[0]) == pytest.approx(value, abs=1e-2)
