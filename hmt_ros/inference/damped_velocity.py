"""Second-order dynamics: the velocity of a pose is damped, and driven by coupled noise.

    dx = v dt + dn,  E[dn dn'] = W dt              dv = -G v dt + dw,  E[dw dw'] = D dt

with a diagonal damping G, a diagonal W and a full D, which couples the velocities of joints that
move together. The velocity has the stationary covariance S_ij = D_ij / (G_i + G_j), and

    x(t) ~ x + a v,   v(t) ~ b v,     a = (1 - exp(-G t)) / G,   b = exp(-G t)
    Q_xx = int a a' D + W t,   Q_xv = int a b' D,   Q_vv = int b b' D    (entry by entry, 0..t)

The integrals are sums of exponentials. Over short times, in which the exponentials cancel, Gaussian
quadrature computes them [Uhlenbeck and Ornstein 1930; Van Loan 1978 for the general case].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary, predict_damped
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import cholesky, inverse, product
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics

# Nodes and weights of the quadrature, and the bound on G t below which it is exact to rounding.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_MAX_EXPONENT = 4.0


@dataclass(frozen=True, eq=False)
class DampedVelocity(LinearGaussianDynamics):
    """Dynamics of poses and damped velocities, n = 2 d; constructed by `of`."""

    @classmethod
    def of(
        cls, damping: ArrayLike, diffusion: ArrayLike, white: ArrayLike, *, step: float = 1.0
    ) -> DampedVelocity:
        """Return the dynamics; the first velocity has the stationary covariance.

        Args:
            damping: (d,) damping G, rate at which the velocity decays, per second.
            diffusion: (d, d) diffusion D, covariance that the velocity gains per second.
            white: (d,) white noise W, additional variance that the pose gains per second.

        Raises:
            ValueError: shapes are inconsistent, damping or white noise is not positive, or the
                diffusion is not positive definite.
        """
        rates = np.atleast_1d(np.asarray(damping, dtype=np.float64))
        own = np.atleast_1d(np.asarray(white, dtype=np.float64))
        driven = np.atleast_2d(np.asarray(diffusion, dtype=np.float64))
        d = len(rates)
        if driven.shape != (d, d) or own.shape != (d,):
            raise ValueError(
                f'dynamics: damping {rates.shape}, diffusion {driven.shape} and white noise '
                f'{own.shape} do not fit, wanted (d,), (d, d) and (d,)'
            )
        for name, value in (('damping', rates), ('white noise', own)):
            if not (np.isfinite(value).all() and (value > 0).all()):
                raise ValueError(f'dynamics: {name} must be positive, saw {value.min()}')
        stationary = driven / (rates[:, None] + rates)
        try:
            cholesky(stationary)
        except np.linalg.LinAlgError:
            raise ValueError(
                'dynamics: the diffusion of the velocity is not positive definite'
            ) from None
        drift, noise, precision = np.zeros((3, 2 * d, 2 * d))
        drift[:d, d:] = np.eye(d)
        drift[d:, d:] = -np.diag(rates)
        noise[:d, :d], noise[d:, d:] = np.diag(own), driven
        known = inverse(stationary)
        precision[d:, d:] = 0.5 * (known + known.T)
        return cls(drift, noise, d, np.zeros(2 * d), precision, step)

    @cached_property
    def damping(self) -> Array:
        """Damping G (d,), per second."""
        d = self.dimension
        return -np.diagonal(self.drift)[d:]

    def _transition(self, interval: float) -> tuple[Array, Array]:
        d = self.dimension
        a, b = self._decay(interval)
        moved = np.eye(2 * d)
        moved[:d, d:], moved[d:, d:] = np.diag(a), np.diag(b)
        noise = np.empty((2 * d, 2 * d))
        noise[:d, :d], noise[:d, d:], noise[d:, d:] = self._integrals(interval)
        noise[d:, :d] = noise[:d, d:].T
        noise *= np.tile(self.diffusion[d:, d:], (2, 2))
        noise[:d, :d] += self.diffusion[:d, :d] * interval
        return moved, noise

    def _decay(self, interval: float) -> tuple[Array, Array]:
        """a and b (d,): shift of the pose per unit velocity, and remaining fraction of velocity."""
        lost: Array = -elementary.expm1(-self.damping * interval)
        return lost / self.damping, 1.0 - lost

    def _integrals(self, interval: float) -> tuple[Array, Array, Array]:
        """Integrals (d, d) over the interval of a a', a b' and b b'."""
        g = self.damping
        if g.max() * interval < _MAX_EXPONENT:
            times = 0.5 * interval * (_NODES + 1.0)
            root = np.sqrt(0.5 * interval * _WEIGHTS)[:, None]
            lost = -elementary.expm1(-times[:, None] * g)
            a, b = root * lost / g, root * (1.0 - lost)
            return product(a.T, a), product(a.T, b), product(b.T, b)
        a, _ = self._decay(interval)
        total = g[:, None] + g
        both = -elementary.expm1(-total * interval) / total
        return (
            (interval - a[:, None] - a + both) / np.outer(g, g),
            (a[None, :] - both) / g[:, None],
            both,
        )

    def predict(self, means: Array, covariances: Array, interval: float) -> tuple[Array, Array]:
        """Predict means (K, n) and covariances (K, n, n) of states after an interval in seconds."""
        _, noise = self.transition(interval)
        moved, result = np.empty_like(means), np.empty_like(covariances)
        predict_damped(*self._decay(interval), noise, means, covariances, moved, result)
        return moved, result
