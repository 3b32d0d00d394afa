"""A hidden Markov chain in continuous time: n states, rates per second between them.

    predict   p <- p exp(Q dt)                      Q_ij: rate from state i to state j, 1/s
    update    log p_i <- log p_i + l_i - const      l_i: log likelihood of an observation in state i

Two states have the closed form  p_1 <- u + (p_1 - u) exp(-(q_01 + q_10) dt),  u = q_01 / (q_01 +
q_10). Results depend neither on the division of time into steps nor on the frame rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import exponential, log_sum_exp, product, solve
from hmt_ros.inference.logistic import probability_of


@dataclass(frozen=True, eq=False)
class MarkovChain:
    """Markov chain with given rates between its states.

    Attributes:
        rates: (n, n) rates from state i to state j, 1/s; the diagonal is ignored.
    """

    rates: Array

    @classmethod
    def of_two(cls, begins: float, ends: float) -> MarkovChain:
        """Chain with two states, given the rates at which the second state begins and ends, 1/s.

        Example:
            >>> chain = MarkovChain.of_two(begins=1.0, ends=3.0)
            >>> chain.predict([1.0, 0.0], 0.1).round(3), chain.usual
            (array([0.918, 0.082]), array([0.75, 0.25]))
        """
        return cls(np.array([[0.0, begins], [ends, 0.0]]))

    @cached_property
    def generator(self) -> Array:
        """Q (n, n), whose rows sum to 0, 1/s."""
        off = self.rates * (1.0 - np.eye(len(self.rates)))
        return np.asarray(off - np.diag(off.sum(1)))

    @cached_property
    def usual(self) -> Array:
        """Stationary probabilities (n,)."""
        # Solve p Q = 0 with sum p = 1, which replaces a redundant equation.
        equations = self.generator.T.copy()
        equations[-1] = 1.0
        found = solve(equations, np.eye(len(equations))[-1])
        found.flags.writeable = False
        return found

    @cached_property
    def _rate(self) -> float:
        """Rate at which a chain of two states decays to its stationary probabilities, 1/s."""
        return float(self.rates[0, 1] + self.rates[1, 0])

    def transition(self, dt: float) -> Array:
        """Matrix (n, n) of the probabilities of state j, dt seconds after state i."""
        if len(self.rates) == 2:
            share = -elementary.expm1(-self._rate * dt)
            return np.asarray((1.0 - share) * np.eye(2) + share * self.usual)
        return exponential(self.generator * dt)

    def predict(self, p: ArrayLike, dt: float) -> Array:
        """Predicts probabilities (..., n) dt seconds after p (..., n)."""
        return np.asarray(product(p, self.transition(dt)))

    def closed(self, p: ArrayLike, dt: float) -> Array:
        """Predicts probabilities (...) of the second of two states, in closed form."""
        return np.asarray(p + (p - self.usual[1]) * elementary.expm1(-self._rate * dt))


def update(p: ArrayLike, log_likelihoods: ArrayLike) -> Array:
    """Updates probabilities p (..., n) of the states with an observation.

    Args:
        log_likelihoods: (..., n) log likelihoods of the observation in each state, nats, up to a
            constant.
    """
    with np.errstate(divide='ignore'):
        log_p = elementary.log(p) + log_likelihoods
    return np.asarray(elementary.exp(log_p - log_sum_exp(log_p)[..., None]))


def of_log_odds(log_odds: ArrayLike) -> Array:
    """Probabilities (..., 2) of two states, from the log odds of the second state, nats."""
    is_so = probability_of(log_odds)
    return np.stack([1.0 - is_so, is_so], axis=-1)
