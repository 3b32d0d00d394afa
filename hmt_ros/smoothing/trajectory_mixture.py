"""A mixture of Gaussians over trajectories, the result of smoothing (VMS 6).

    q(X) = sum_i a_i N(X; M_i, s_i^2 P_i^-1)

Every component is a Gaussian Markov process with block-tridiagonal precision P_i, so that
densities, samples and marginals cost O(T) and no (T d, T d) covariance is needed. Velocities in the
state are integrated out of all results.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.block_tridiagonal import (
    BlockCholesky,
    BlockTridiagonal,
)
from hmt_ros.inference.linear_algebra import log_sum_exp
from hmt_ros.inference.random_numbers import standard_normals


@dataclass(frozen=True, eq=False)
class TrajectoryMixture:
    """M trajectories of T poses with d variables, heaviest first.

    Attributes:
        weights: (M,) probabilities of the trajectories, with sum 1.
        states: (M, T, n) means; the first d of the n variables are the pose.
        factors: M factors of the precisions P_i, without inflation.
        inflation: (M,) s_i, factor on standard deviations.
        log_joint: (M,) log p(M_i, R), the log joint density at each mean.
        free_energy: (I,) free energy at each iteration, on the samples of the descent, nats.
        dimension: d, number of variables of a pose.
        stamps_ns: (T,) times, ns; None: unknown.
        final_until_ns: poses at or before this time will not be revised.
        identities: (M,) positive number that identifies each motion in all windows; empty if only
            one window was smoothed.
        free_energy_fresh: free energy on samples not used in the descent, and its standard error.
        lower, upper: (d,) limits; samples are clipped to them.
        disagreements: (M, T, d, d) covariance between the modes of each motion, added only to the
            marginals. None: components are not motions.
        weights_in_time: (T, M) total probability of the modes near each motion at each time; None:
            `weights` at all times.
        strays: T mixtures of the modes that are far from all motions, with the modes' probabilities
            as weights; they are the last components of the marginals. Empty if missing.

    Raises:
        ValueError: shapes are inconsistent, or weights do not sum to 1.
    """

    weights: Array
    states: Array
    factors: tuple[BlockCholesky, ...]
    inflation: Array
    log_joint: Array
    free_energy: Array
    dimension: int
    stamps_ns: tuple[int, ...] | None = None
    final_until_ns: int | None = None
    identities: tuple[int, ...] = ()
    free_energy_fresh: tuple[float, float] = (np.nan, np.nan)
    lower: Array | float = -np.inf
    upper: Array | float = np.inf
    disagreements: Array | None = None
    weights_in_time: Array | None = None
    strays: tuple[GaussianMixture, ...] = ()

    def __post_init__(self) -> None:
        m, times, n = self.states.shape
        if not (
            self.weights.shape == self.inflation.shape == self.log_joint.shape == (m,)
            and len(self.factors) == m > 0
            and all((factor.times, factor.size) == (times, n) for factor in self.factors)
        ):
            raise ValueError(
                f'trajectories: weights {self.weights.shape}, states {self.states.shape} and '
                f'{len(self.factors)} factors do not fit'
            )
        if not abs(self.weights.sum() - 1.0) < 1e-6 or (self.weights < 0).any():
            raise ValueError(f'trajectories: weights sum to {self.weights.sum()}, wanted 1')
        if self.stamps_ns is not None and len(self.stamps_ns) != times:
            raise ValueError(f'trajectories: {len(self.stamps_ns)} stamps for {times} poses')

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def times(self) -> int:
        """Number of times, T."""
        return int(self.states.shape[1])

    @property
    def means(self) -> Array:
        """Means of the poses, (M, T, d)."""
        return self.states[:, :, : self.dimension]

    @cached_property
    def marginal_covariances(self) -> Array:
        """Covariances (M, T, d, d) of the poses in each component, inflation included."""
        return np.array([self.covariances_of(i) for i in range(len(self))])

    def covariances_of(self, i: int, count: int | None = None) -> Array:
        """Covariances (T, d, d) of the poses of component i, or of its first `count` poses."""
        d = self.dimension
        blocks = self.factors[i].inverse_blocks(count)
        result: Array = self.inflation[i] ** 2 * blocks[:, :d, :d]
        return result if self.disagreements is None else result + self.disagreements[i, :count]

    @cached_property
    def velocities(self) -> Array | None:
        """Velocities of the poses, (M, T, d) per second; None if unknown.

        Velocities are part of the states. If a state consists of the pose only, velocities are
        central differences, one-sided at the ends.
        """
        if self.states.shape[2] == 2 * self.dimension:
            return self.states[:, :, self.dimension :]
        if self.stamps_ns is None or self.times < 2:
            return None
        seconds = (np.array(self.stamps_ns) - self.stamps_ns[0]) * 1e-9
        return np.asarray(np.gradient(self.means, seconds, axis=1))

    def marginal(self, t: int) -> GaussianMixture:
        """The density of the pose at index t: a component for each trajectory, and the strays.

        If trajectories are motions, the heaviest motion has the largest weight at every time; see
        `weights_capped_by_first`. If another motion were heavier in a single image, estimates would
        flicker.
        """
        covariances = np.array([self.covariances_of(i, t + 1)[t] for i in range(len(self))])
        weights = self.weights if self.weights_in_time is None else self.weights_in_time[t]
        poses = GaussianMixture(weights, self.means[:, t], covariances)
        if self.strays:
            poses = joined(poses, self.strays[t])
        if self.weights_in_time is None:
            return poses
        return replace(poses, weights=weights_capped_by_first(poses.weights))

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draws trajectories (n, T, d), projected onto the limits."""
        owners = rng.choice(len(self), size=n, p=self.weights / self.weights.sum())
        noise = standard_normals(rng, (n, *self.states.shape[1:]))
        result = np.empty((n, self.times, self.dimension))
        for i in np.unique(owners):
            mine = owners == i
            moves = self.inflation[i] * self.factors[i].solve_transposed(noise[mine])
            result[mine] = (self.states[i] + moves)[:, :, : self.dimension]
        return np.clip(result, self.lower, self.upper)

    def log_density(self, trajectories: ArrayLike) -> Array:
        """Log densities log q(X), (n,), of trajectories X (n, T, d).

        Raises:
            ValueError: the trajectories have a wrong shape.
        """
        x = np.asarray(trajectories, dtype=np.float64)
        if x.ndim != 3 or x.shape[1:] != (self.times, self.dimension):
            raise ValueError(
                f'trajectories have shape {x.shape}, wanted (n, {self.times}, {self.dimension})'
            )
        each = np.empty((len(x), len(self)))
        for i in range(len(self)):
            each[:, i] = self._component_log_density(i, x)
        with np.errstate(divide='ignore'):
            result: Array = log_sum_exp(each + elementary.log(self.weights), axis=1)
        return result

    def _component_log_density(self, i: int, x: Array) -> Array:
        """Log density log N(X; M_i, s_i^2 S_i), (n,), with velocities integrated out.

        q(x) = q(x, v*) (2 pi)^(D/2) |P_vv|^(-1/2) at the most probable velocities v* given x.
        """
        factor, scale, d = self.factors[i], float(self.inflation[i]), self.dimension
        n = factor.size
        offset = np.zeros((len(x), self.times, n))
        offset[:, :, :d] = (x - self.means[i]) / scale
        log = 0.5 * factor.log_determinant
        if n > d:
            whole = factor.matrix()
            hidden = BlockTridiagonal(whole.diagonal[:, d:, d:], whole.lower[:, d:, d:]).cholesky()
            pull = whole.product(offset)[:, :, d:]
            offset[:, :, d:] = -hidden.solve(pull)
            log -= 0.5 * hidden.log_determinant
        white = factor.whiten(offset)
        log -= self.times * d * (elementary.log(scale) + 0.5 * elementary.log(2 * np.pi))
        return np.asarray(log - 0.5 * np.einsum('stn,stn->s', white, white))

    def mean(self) -> Array:
        """Expected poses, (T, d)."""
        return np.asarray(np.einsum('m,mtd->td', self.weights, self.means))

    def message_content(self, *, covariances: bool = True) -> dict[str, Any]:
        """Content of a message without names and frame (`msg_tools.messages`).

        Args:
            covariances: whether to compute and include covariances.

        Raises:
            ValueError: the stamps are not known.
        """
        if self.stamps_ns is None:
            raise ValueError('trajectories without stamps can not become a message')
        before = self.stamps_ns[0] - 1
        return {
            'weights': self.weights,
            'means': self.means,
            'marginal_covariances': self.marginal_covariances if covariances else None,
            'log_joint': self.log_joint,
            'inflation': self.inflation,
            'stamps_ns': self.stamps_ns,
            'final_until_ns': before if self.final_until_ns is None else self.final_until_ns,
            'free_energy': self.free_energy,
            'identities': np.array(self.identities, dtype=np.uint32) if self.identities else None,
        }


def joined(one: GaussianMixture, other: GaussianMixture) -> GaussianMixture:
    """Concatenate the components of two mixtures."""
    return GaussianMixture(
        np.concatenate([one.weights, other.weights]),
        np.concatenate([one.means, other.means]),
        np.concatenate([one.covariances, other.covariances]),
    )


def weights_capped_by_first(weights: Array) -> Array:
    """Limit weights (K,) to at most the first weight, without changing the sum.

    The other weights are cut at a level; their total excess raises the first weight to it.
    """
    heavier = -np.sort(-weights[1:][weights[1:] > weights[0]])
    levels = (weights[0] + np.cumsum(heavier)) / np.arange(2, len(heavier) + 2)
    enough = np.append(levels[:-1] >= heavier[1:], True)
    level = levels[int(np.argmax(enough))] if len(heavier) else weights[0]
    return np.concatenate([[level], np.minimum(weights[1:], level)])
