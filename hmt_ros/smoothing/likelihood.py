"""Likelihoods of observations for a smoother: -log p(r_t | x_t), its gradient and its curvature.

A likelihood is either made of a filter's mixtures (`MixtureLikelihood`), or any other `EnergyTerm`
whose rows are times, such as the likelihood of the images themselves (VMS 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import add_mixture_energy, elementary
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy, EnergyTerm
from hmt_ros.inference.linear_algebra import inverse_triangular, log_sum_exp, product


class SequenceLikelihood(EnergyTerm, Protocol):
    """Energies -log p(r_t | x_t) at the times t < T of a sequence; the rows are times."""

    @property
    def times(self) -> int:
        """Number T of times."""
        ...


@dataclass(frozen=True, eq=False)
class MixtureLikelihood:
    """Likelihood p(r_t | x_t) = sum_k w_k N(x_t; m_k, S_k) from the mixtures of a filter.

    With y_k = W_k (x - m_k), S_k^-1 = W_k' W_k, responsibilities r_k and u_k = W_k' y_k, the
    gradient of -log p is u = sum_k r_k u_k and its Hessian sum_k r_k S_k^-1 - (sum_k r_k u_k u_k' -
    u u'). Without the part in brackets, this is the Hessian of the quadratic that
    expectation-maximisation minimises. This quadratic lies above -log p, so a full step never
    increases -log p.

    Attributes:
        first: (T+1,) index of the first mode of each time; time t has first[t] .. first[t+1] - 1.
        log_scales: (K,) log w_k - log |2 pi S_k| / 2.
        means: (K, d) m_k.
        whiteners: (K, d, d) W_k, lower triangular.
        precisions: (K, d, d) S_k^-1.
    """

    first: NDArray[np.int64]
    log_scales: Array
    means: Array
    whiteners: Array
    precisions: Array

    @classmethod
    def of(cls, mixtures: Sequence[GaussianMixture]) -> MixtureLikelihood:
        """The likelihood of a sequence of mixtures; modes of weight 0 are left out.

        Raises:
            ValueError: a mixture has no modes, no weight, a different dimension, or a covariance
                that is not positive definite.
        """
        check_mixtures(mixtures)
        kept = [mixture[mixture.weights > 0] for mixture in mixtures]
        first = np.concatenate([[0], np.cumsum([len(mixture) for mixture in kept])])
        factors = np.concatenate([mixture.cholesky() for mixture in kept])
        whiteners = inverse_triangular(factors)
        d = whiteners.shape[1]
        log_norms = elementary.log(np.diagonal(whiteners, axis1=1, axis2=2)).sum(1)
        weights = np.concatenate([mixture.weights for mixture in kept])
        return cls(
            first.astype(np.int64),
            elementary.log(weights) + log_norms - 0.5 * d * elementary.log(2 * np.pi),
            np.ascontiguousarray(np.concatenate([mixture.means for mixture in kept])),
            np.tril(whiteners),
            product(whiteners.swapaxes(1, 2), whiteners),
        )

    @property
    def times(self) -> int:
        """Number T of times."""
        return len(self.first) - 1

    def modes_of(self, path: Index) -> tuple[Array, Array, Array]:
        """Log scales (T,), means (T, d) and precisions (T, d, d) of the modes on a path (T,)."""
        at = self.first[:-1] + path
        return self.log_scales[at], self.means[at], self.precisions[at]

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`; the rows are times."""
        n, d = x.shape
        wanted = derivatives >= Derivatives.POSITIVE
        value, gradient = np.empty(n), np.empty((n, d))
        hessian = np.empty((n if wanted else 0, d, d))
        add_mixture_energy(
            np.ascontiguousarray(x),
            rows.astype(np.int64),
            self.first,
            self.log_scales,
            self.means,
            self.whiteners,
            self.precisions,
            wanted,
            derivatives == Derivatives.EXACT,
            value,
            gradient,
            hessian,
        )
        return Energy(value, gradient, hessian if wanted else None)


@dataclass(frozen=True, eq=False)
class LikelihoodPart:
    """The part of a likelihood for some consecutive times.

    Attributes:
        whole: likelihood of all times.
        first: index of the first time.
        times: number of times.
    """

    whole: SequenceLikelihood
    first: int
    times: int

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`; the rows are times relative to the first."""
        return self.whole.energy(x, rows + self.first, derivatives=derivatives)


def counted(mixture: GaussianMixture, share: float) -> GaussianMixture:
    """Discount the likelihood of an observation of which only a share a is new information.

        sum_k v_k N(m_k, S_k / a) / sum_k v_k,        v_k = w_k^a |S_k|^((1 - a) / 2)

    If errors persist, each observation repeats a part of the information in earlier observations.
    Only the share a of its information is used (`inference.error_model`). The density near each
    mode is then w_k N(m_k, S_k) to the power a.

    Args:
        mixture: likelihood before the discount; modes of weight 0 are left out.
        share: share a of new information.

    Raises:
        ValueError: the share is not in (0, 1].
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f'the share of the evidence must lie in (0, 1], saw {share}')
    some = mixture[mixture.weights > 0]
    log_weights = share * elementary.log(some.weights) + 0.5 * (1.0 - share) * some.log_determinants
    weights = elementary.exp(log_weights - log_sum_exp(log_weights))
    return GaussianMixture(weights, some.means, some.covariances / share)


def check_mixtures(mixtures: Sequence[GaussianMixture]) -> None:
    """Checks that the mixtures of a window, one for each time, are valid inputs of a smoother.

    Raises:
        ValueError: a mixture is invalid; the message gives the index of the mixture.
    """
    if len(mixtures) == 0:
        raise ValueError('no mixtures to smooth; wanted one for each time')
    for t, mixture in enumerate(mixtures):
        if len(mixture) == 0 or not mixture.weights.sum() > 0:
            raise ValueError(
                f'mixture {t} of {len(mixtures)} has no modes with weight; leave out times without '
                'observation and give stamps instead'
            )
        if mixture.dimension != mixtures[0].dimension:
            raise ValueError(
                f'mixture {t} has {mixture.dimension} variables, those before '
                f'{mixtures[0].dimension}'
            )
        try:
            mixture.cholesky()
        except ValueError as error:
            raise ValueError(f'mixture {t} of {len(mixtures)}: {error}') from None
