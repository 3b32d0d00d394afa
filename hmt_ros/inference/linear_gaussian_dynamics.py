"""Linear Gaussian dynamics in continuous time, and the implied prior over trajectories.

    dx = F x dt + dw,  E[dw dw'] = Qc dt     =>     p(x_{t+1} | x_t) = N(A x_t, Q)
    A = exp(F dt),  Q = int_0^dt exp(F s) Qc exp(F s)' ds                       [Van Loan 1978]

so that gaps and uneven intervals need no special treatment: predictions over two intervals equal
the prediction over their sum. The random walk has F = 0; with constant velocity the state consists
of the pose and its velocity, and the acceleration is white noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.block_tridiagonal import BlockTridiagonal
from hmt_ros.inference.linear_algebra import (
    cholesky,
    exponential,
    inverse,
    inverse_triangular,
    product,
    symmetric_eigenvalues,
)

# Maximum number of intervals whose transitions are cached.
MAX_INTERVALS = 64


@dataclass(frozen=True, eq=False)
class TrajectoryPrior:
    """Prior p(X) over states X (T, n), -log p(X) = 1/2 X'PX - h'X + c.

    Attributes:
        precision: block-tridiagonal matrix P.
        information: (T, n) vector h.
        constant: constant c, nats; an unknown first pose has density 1.
        dimension: number d of pose variables, which come first in each state.
    """

    precision: BlockTridiagonal
    information: Array
    constant: float
    dimension: int

    def energy(self, states: Array) -> tuple[Array, Array]:
        """Return -log p (N,) and its gradient (N, T, n) at trajectories (N, T, n)."""
        moved = self.precision.product(states)
        value = (states * (0.5 * moved - self.information)).sum((-2, -1))
        return value + self.constant, moved - self.information

    def between(self, first: int, last: int, states: Array) -> TrajectoryPrior:
        """Condition the states with first <= t < last on the other states of a trajectory (T, n).

        The density is unnormalised: its constant is 0.
        """
        information = self.information[first:last].copy()
        if first > 0:
            information[0] -= product(self.precision.lower[first - 1], states[first - 1])
        if last < len(states):
            information[-1] -= product(self.precision.lower[last - 1].T, states[last])
        precision = BlockTridiagonal(
            self.precision.diagonal[first:last], self.precision.lower[first : last - 1]
        )
        return TrajectoryPrior(precision, information, 0.0, self.dimension)


class Couplings(NamedTuple):
    """Terms that couple T successive states, stored once for each distinct interval.

    Attributes:
        before, after, forth: (I, n, n) matrices A' Q^-1 A, Q^-1 and Q^-1 A for I distinct
            intervals.
        which: (T-1,) index of the interval after each state except the last.
        log_determinants: (T-1,) log |Q| of the interval after each state.
    """

    before: Array
    after: Array
    forth: Array
    which: Index
    log_determinants: Array

    def constant(self, noise: Array) -> float:
        """Return -log of the peak densities, nats, with factors (T-1,) on the noise."""
        n = self.before.shape[1]
        logs = n * elementary.log(2.0 * np.pi * noise) + self.log_determinants
        return 0.5 * float(logs.sum())


@dataclass(frozen=True, eq=False)
class LinearGaussianDynamics:
    """Dynamics of a state of n variables; the first d are the pose.

    Construct by `random_walk`, `constant_velocity` or `DampedVelocity.of`, or from any drift and
    diffusion.

    Attributes:
        drift: (n, n) drift F, per second.
        diffusion: (n, n) diffusion Qc, covariance gained per second.
        dimension: number d of observed variables; all other variables are velocities.
        initial_mean: (n,) mean of the first state.
        initial_precision: (n, n) precision of the first state; zero for unknown variables.
        step: interval between observations without timestamps, s.

    Raises:
        ValueError: a shape is wrong, a value is not finite, or a diffusion is not positive
            semi-definite.
    """

    drift: Array
    diffusion: Array
    dimension: int
    initial_mean: Array
    initial_precision: Array
    step: float = 1.0

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.initial_mean))
        shapes = {
            'drift': (n, n),
            'diffusion': (n, n),
            'initial_mean': (n,),
            'initial_precision': (n, n),
        }
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f'dynamics: {name} has shape {value.shape}, wanted {shape}')
            if not np.isfinite(value).all():
                raise ValueError(f'dynamics: {name} has values that are not finite')
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not 0 < self.dimension <= n:
            raise ValueError(f'dynamics: {self.dimension} of {n} variables are observed')
        if not self.step > 0:
            raise ValueError(f'dynamics: step must be positive, saw {self.step}')
        for name in ('diffusion', 'initial_precision'):
            value = getattr(self, name)
            smallest = float(symmetric_eigenvalues(value)[0])
            if smallest < -1e-9 * np.abs(value).max() or not np.allclose(value, value.T):
                raise ValueError(
                    f'dynamics: {name} is not symmetric and positive semi-definite: its smallest '
                    f'eigenvalue is {smallest:.3g}'
                )

    @classmethod
    def random_walk(cls, rates: ArrayLike, *, step: float = 1.0) -> LinearGaussianDynamics:
        """Return first-order dynamics, x_{t+1} = x_t + noise; the first pose is unknown.

        Args:
            rates: (d,) variances, or (d, d) covariance, gained by the pose per second.
        """
        diffusion = _matrix(rates)
        d = len(diffusion)
        return cls(np.zeros((d, d)), diffusion, d, np.zeros(d), np.zeros((d, d)), step)

    @classmethod
    def constant_velocity(
        cls,
        rates: ArrayLike,
        velocity_sigma: ArrayLike,
        *,
        step: float = 1.0,
    ) -> LinearGaussianDynamics:
        """Return second-order dynamics of pose and velocity; the first pose is unknown.

        Args:
            rates: (d,) variances, or (d, d) covariance, gained by the velocity per second.
            velocity_sigma: standard deviation of the first velocity, (d,) or scalar, per second.
        """
        white = _matrix(rates)
        d = len(white)
        sigma = np.broadcast_to(np.asarray(velocity_sigma, dtype=np.float64), (d,))
        if not (sigma > 0).all():
            raise ValueError(f'dynamics: velocity_sigma must be positive, saw {sigma.min()}')
        drift, diffusion, precision = np.zeros((3, 2 * d, 2 * d))
        drift[:d, d:] = np.eye(d)
        diffusion[d:, d:] = white
        precision[d:, d:] = np.diag(1.0 / sigma**2)
        return cls(drift, diffusion, d, np.zeros(2 * d), precision, step)

    @property
    def state_dimension(self) -> int:
        """Number of variables of a state, n."""
        return len(self.drift)

    @cached_property
    def transition(self) -> Callable[[float], tuple[Array, Array]]:
        """Function that returns A and Q, (n, n), for an interval in seconds; results are cached."""

        def made(interval: float) -> tuple[Array, Array]:
            found = self._transition(interval)
            for part in found:
                part.setflags(write=False)
            return found

        return lru_cache(MAX_INTERVALS)(made)

    @cached_property
    def coupling(self) -> Callable[[float], tuple[Array, Array, Array, float]]:
        """Cached function that returns A' Q^-1 A, Q^-1 and Q^-1 A, (n, n), and log |Q|."""
        return lru_cache(MAX_INTERVALS)(self._coupling)

    def _coupling(self, interval: float) -> tuple[Array, Array, Array, float]:
        a, q = self.transition(interval)
        precision, log_det = _precision_of(q)
        forth = product(precision, a)
        return product(a.T, forth), precision, forth, log_det

    def couplings(self, intervals: Array) -> Couplings:
        """Return the terms that couple states with intervals (T-1,) between them, s.

        Raises:
            ValueError: the noise over an interval is not positive definite.
        """
        n = self.state_dimension
        different, which = np.unique(intervals, return_inverse=True)
        each = [self.coupling(float(interval)) for interval in different]
        before, after, forth = (
            np.array([one[k] for one in each]).reshape(-1, n, n) for k in range(3)
        )
        logs = np.array([one[3] for one in each])[which]
        return Couplings(before, after, forth, which, logs)

    @cached_property
    def unknown_velocity(self) -> Array:
        """Covariance (n - d, n - d) of the first velocity."""
        d = self.dimension
        result = inverse(self.initial_precision[d:, d:])
        return np.asarray(0.5 * (result + result.T), dtype=np.float64)

    def states(self, covariances: Array) -> Array:
        """Return covariances (K, n, n) of states from covariances (K, d, d) of their poses.

        All velocities have the covariance of the first velocity.
        """
        d, n = self.dimension, self.state_dimension
        if n == d:
            return covariances
        result = np.zeros((len(covariances), n, n))
        result[:, :d, :d] = covariances
        result[:, d:, d:] = self.unknown_velocity
        return result

    def predict_poses(
        self, means: Array, covariances: Array, interval: float
    ) -> tuple[Array, Array]:
        """Predict means (K, d) and covariances (K, d, d) of poses with unknown velocities.

        Args:
            means, covariances: means (K, d) and covariances (K, d, d) of the poses.
        """
        d = self.dimension
        first = np.broadcast_to(self.initial_mean[d:], (len(means), self.state_dimension - d))
        states = np.concatenate([means, first], axis=1)
        moved, spread = self.predict(states, self.states(covariances), interval)
        return moved[:, :d], spread[:, :d, :d]

    def _transition(self, interval: float) -> tuple[Array, Array]:
        n = self.state_dimension
        if not self.drift.any():
            return np.eye(n), self.diffusion * interval
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n] = -self.drift
        block[:n, n:] = self.diffusion
        block[n:, n:] = self.drift.T
        both = exponential(block * interval)
        a = both[n:, n:].T
        q = product(a, both[:n, n:])
        return a, 0.5 * (q + q.T)

    def predict(self, means: Array, covariances: Array, interval: float) -> tuple[Array, Array]:
        """Predict means (K, n) and covariances (K, n, n) of states after an interval in seconds."""
        a, q = self.transition(interval)
        if not self.drift.any():
            return means, covariances + q
        return product(means, a.T), product(product(a, covariances), a.T) + q

    def prior(
        self, intervals: Array, *, initial: bool = True, noise: ArrayLike = 1.0
    ) -> TrajectoryPrior:
        """Return the prior over trajectories with given intervals between their states.

        Args:
            intervals: (T-1,) intervals, s.
            initial: whether to include the prior of the first state.
            noise: factor on the noise covariance over each interval, (T-1,) or scalar.

        Raises:
            ValueError: the noise over an interval is not positive definite.
        """
        n = self.state_dimension
        times = len(intervals) + 1
        factors = np.broadcast_to(np.asarray(noise, dtype=np.float64), (times - 1,))
        diagonal = np.zeros((times, n, n))
        lower = np.zeros((times - 1, n, n))
        information = np.zeros((times, n))
        start = self.initial_precision if initial else np.zeros((n, n))
        diagonal[0] = start
        information[0] = product(start, self.initial_mean)
        known = symmetric_eigenvalues(start)
        known = known[known > 1e-12 * max(float(known[-1]), 1e-300)]
        constant = 0.5 * (
            len(known) * elementary.log(2 * np.pi)
            - elementary.log(known).sum()
            + product(self.initial_mean, information[0])
        )
        coupled = self.couplings(intervals)
        share = 1.0 / factors[:, None, None]
        diagonal[:-1] += share * coupled.before[coupled.which]
        diagonal[1:] += share * coupled.after[coupled.which]
        lower[:] = -share * coupled.forth[coupled.which]
        constant += coupled.constant(factors)
        precision = BlockTridiagonal(diagonal, lower)
        return TrajectoryPrior(precision, information, float(constant), self.dimension)


def _precision_of(covariance: Array) -> tuple[Array, float]:
    """Return inverse and log determinant; the inverse of a diagonal matrix is exactly diagonal."""
    diagonal = np.diagonal(covariance)
    if not (covariance - np.diag(diagonal)).any() and (diagonal > 0).all():
        return np.diag(1.0 / diagonal), float(elementary.log(diagonal).sum())
    try:
        factor = cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError(
            'dynamics: the noise over an interval is not positive definite; every variable needs '
            'a positive rate'
        ) from None
    root = inverse_triangular(factor)
    # Exact zeros keep the band narrow.
    precision = product(root.T, root)
    precision[covariance == 0] = np.where(
        np.abs(precision[covariance == 0]) < 1e-14 * np.abs(precision).max(),
        0.0,
        precision[covariance == 0],
    )
    return precision, float(2.0 * elementary.log(np.diagonal(factor)).sum())


def _matrix(rates: ArrayLike) -> Array:
    value = np.atleast_1d(np.asarray(rates, dtype=np.float64))
    return np.diag(value) if value.ndim == 1 else value
