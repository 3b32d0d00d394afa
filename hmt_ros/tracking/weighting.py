"""Weights of hypotheses: the forward recursion over all pairs of modes.

    log w_k = log sum_j w_j p(x_k | x_j) - sum_g a_g(dt) E_g(x_k)                               (1)
    p(x_k | x_j) = t(x_k, x_j) / n_k / (sum_l t(x_l, x_j) / n_l + e^-c),
    n_k = sum_l t(x_k, x_l)                                                                     (2)
    log t(x, x_j) = -nu/2 log(1 + D(x, f(x_j)) / (nu q dt))                                     (3)

x_j are the modes of the previous image and f(x_j) their predictions by the dynamics. D is the mean
squared distance of the joints relative to the pelvis, and q the mean squared distance between
joints and their predictions after a second. Every hypothesis can continue every mode that is within
reach in dt, whichever proposal found it. A mode continues as one of the hypotheses of the image
(2), or ends if all hypotheses are less likely than e^-c. The number of hypotheses depends on the
search and is no evidence. So n_k is the number of hypotheses near x_k; otherwise, many copies of a
hypothesis would take weight from a hypothesis that was found once. E_g is the energy of cue g,
weighted by its share a_g (`inference.error_model`).

The normaliser |S_k|^(1/2) of a mode is left out, as in the paper: the Hessian shows how well the
image determines a pose, so a badly determined pose (in depth, or with a limb behind the trunk)
would gain weight because less of it is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.core import elementary, rate_histories, rate_transitions
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import log_sum_exp, product
from hmt_ros.tracking.settings import END_NATS, TRANSITION_SPREAD, TRANSITION_TAILS


class Transition(NamedTuple):
    """Parameters of the Student transition density (3), for the compiled functions.

    Attributes:
        variance: mean squared distance q dt, m^2.
        tails: degrees of freedom nu.
    """

    variance: float
    tails: float


@dataclass(frozen=True, eq=False)
class TransitionPrior:
    """Transition densities from the modes of an image to hypotheses of the next image.

    Attributes:
        body: body of the poses.
        predicted: (K, d) predicted poses of the modes.
        log_weights: (K,) log weights of the modes.
        dt: time between the images, s.
    """

    body: Body
    predicted: Array
    log_weights: Array
    dt: float

    @cached_property
    def joints(self) -> Array:
        """Joints (K, J, 3) of the predicted poses, m."""
        return self.body.joint_positions(self.predicted)

    @property
    def _transition(self) -> Transition:
        return Transition(TRANSITION_SPREAD * self.dt, TRANSITION_TAILS)

    def log_transitions(self, joints: Array) -> Array:
        """log t(x_n, x_k), (K, N), for poses x_n with joints (N, J, 3), equation (3)."""
        result = np.empty((len(self.joints), len(joints)))
        rate_transitions(self.joints, joints, self._transition, result)
        return result

    def log_predictive(self, joints: Array) -> Array:
        """Log predictive density log sum_k w_k t(x_n, x_k), (N,), for joints (N, J, 3)."""
        rates = self.log_weights[:, None] + self.log_transitions(joints)
        return np.asarray(log_sum_exp(rates, axis=0), dtype=np.float64)

    def log_histories(self, joints: Array, transitions: Array) -> Array:
        """log w_k p(x_n | x_k), (K, N), for all hypotheses of an image, equation (2).

        Args:
            joints: (N, J, 3) joints of the hypotheses, m.
            transitions: (K, N) log transition densities t.
        """
        result = np.empty_like(transitions)
        rate_histories(self.log_weights, transitions, joints, self._transition, END_NATS, result)
        return result


def normalised(log_weights: Array) -> Array:
    """Normalises log weights (N,), so that the weights sum to 1."""
    return np.asarray(log_weights - log_sum_exp(log_weights), dtype=np.float64)


def at_least(log_weights: Array, least: float) -> Array:
    """Raises log weights (N,) to `least`, so that modes can recover, and normalises them."""
    return normalised(np.maximum(log_weights, least))


def pooled_origins(histories: Array, log_weights: Array, owner: Index) -> Array:
    """Probability (M, K) that kept mode m continues mode k of the previous image.

        P(k | m) = sum_n w_n P(k | x_n) / sum_n w_n,    over the hypotheses n that m represents
        P(k | x_n) = w_k p(x_n | x_k) / sum_j w_j p(x_n | x_j)

    The evidence of the image is a factor of w_n only, and cancels in P(k | x_n).

    Args:
        histories: (K, N) log of w_k p(x_n | x_k).
        log_weights: (N,) log weights.
        owner: (N,) index of the kept mode that represents each hypothesis, 0 to M - 1.
    """
    origins = elementary.exp(histories - log_sum_exp(histories, axis=0))
    shares = elementary.exp(log_weights - log_weights.max())
    member = np.where(owner == np.arange(owner.max() + 1)[:, None], shares, 0.0)
    return np.asarray(product(member, origins.T) / member.sum(1, keepdims=True))
