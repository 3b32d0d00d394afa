"""Probable paths through the modes of a sequence, each filtered in closed form.

A path that goes on to mode k of the next image has the state and the weight

    N(x; A m, A S A' + Q) N(C x; mu_k, S_k) w_k        m, S: its state before

where C takes the pose out of the state. So weights are those of the components of the posterior.
The network of VMS 4 weighs a path by pairs of neighbours (`embedded_network`), and a pair does not
depend on the images before it: where most modes are wide, a path may turn round and back. In every
image only few paths are kept: some that are apart, and the heaviest.

The states of a path, given all of it, follow backwards from the last one (`smoothed_paths`):

    x_t = m_t + G_t (x_{t+1} - A m_t),          G_t = S_t A' P_{t+1}^-1,  P_{t+1} = A S_t A' + Q
    C_t = S_t + G_t (C_{t+1} - P_{t+1}) G_t'    [Rauch, Tung and Striebel 1965]

Paths that part at a time have the same states and gains before it, which are held once. A mean
costs a product of a matrix and a vector; covariances are made of the paths that are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.block_tridiagonal import BlockTridiagonal
from hmt_ros.inference.gaussian_pairs import pair_log_densities
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.reduction import leaders
from hmt_ros.smoothing.embedded_network import Paths

# Motions are one as long as no point of theirs is farther apart than this, m: half the length of a
# forearm, which a flip turns over.
SAME_MOTION = 0.12
# Least log weight of the state of a path: its exponential is still positive.
LEAST_LOG_WEIGHT = -690.0


@dataclass(frozen=True, eq=False)
class Passage:
    """From H paths up to a time to the next one: x' = A x + N(0, Q).

    Attributes:
        means: (H, n) A m.
        covariances: (H, n, n) P = A S A' + Q.
        gains: (H, n, n) G = S A' P^-1 of the paths that go on; 0 of others.
        transition, noise: A and Q.
    """

    means: Array
    covariances: Array
    gains: Array
    transition: Array
    noise: Array

    def __getitem__(self, index: Index) -> Passage:
        """The passage from some of the paths."""
        return replace(
            self,
            means=self.means[index],
            covariances=self.covariances[index],
            gains=self.gains[index],
        )


@dataclass(frozen=True, eq=False)
class PathHypotheses:
    """H paths up to a time, heaviest first.

    Attributes:
        log_weights: (H,) normalised.
        states: (H, n) of the last state; of its weights none is 0.
        parents: (H,) path up to the time before that each continues; empty: there is none before.
        modes: (H,) mode of the last mixture that each goes through.
        passage: from the paths up to the time before; None: there is none before.
    """

    log_weights: Array
    states: GaussianMixture
    parents: Index
    modes: Index
    passage: Passage | None = None

    def __len__(self) -> int:
        return len(self.modes)

    def __getitem__(self, index: Index) -> PathHypotheses:
        """Some of them, in the order of the index; weights are not normalised again."""
        return replace(
            self,
            log_weights=self.log_weights[index],
            states=self.states[index],
            parents=self.parents[index],
            modes=self.modes[index],
        )

    @classmethod
    def of_states(cls, states: GaussianMixture) -> PathHypotheses:
        """Paths that begin in states (H, n)."""
        nothing = np.empty(0, dtype=np.intp)
        return cls._of(np.log(states.weights), states, nothing, np.arange(len(states)), None)

    @classmethod
    def _of(
        cls,
        log: Array,
        states: GaussianMixture,
        parents: Index,
        modes: Index,
        passage: Passage | None,
    ) -> PathHypotheses:
        log = log - logsumexp(log)
        weights = np.exp(np.maximum(log, LEAST_LOG_WEIGHT))
        return cls(log, replace(states, weights=weights), parents, modes, passage)

    def followed(
        self,
        mixture: GaussianMixture,
        dynamics: LinearGaussianDynamics,
        interval: float,
        count: int,
        gaps: Array | None = None,
        past: Array | None = None,
    ) -> PathHypotheses:
        """The paths that go on through the modes of the next mixture.

        Args:
            mixture: the likelihood of the next pose, K modes of positive weight.
            interval: to the next pose, s.
            count: paths at most. Half of them were apart before, a quarter are apart now, if there
                are so many; the others are the heaviest.
            gaps: (K, K) distances of the modes, m; None: nothing is apart.
            past: (H, H) distances of the paths, m; None: as above.
        """
        d = dynamics.dimension
        means, covariances = dynamics.predict(self.states.means, self.states.covariances, interval)
        pairs = np.indices((len(self), len(mixture))).reshape(2, -1).T
        i, k = pairs.T
        log = pair_log_densities(
            means[:, :d], covariances[:, :d, :d], mixture.means, mixture.covariances, pairs
        )
        log += self.log_weights[i] + np.log(mixture.weights)[k]
        chosen: Index = np.empty(0, dtype=np.intp)
        if past is not None:
            half = max(count // 2, min(2, count))
            chosen = leaders(log, lambda a: past[i[a], i], SAME_MOTION, half)
        if gaps is not None:
            most = max(3 * count // 4, len(chosen))
            chosen = leaders(log, lambda a: gaps[k[a], k], SAME_MOTION, most, chosen.tolist())
        rest = np.argsort(-log, kind='stable')
        rest = rest[~np.isin(rest, chosen)][: max(count - len(chosen), 0)]
        chosen = np.concatenate([chosen, rest])
        chosen = chosen[np.argsort(-log[chosen], kind='stable')]
        i, k = i[chosen], k[chosen]
        before, spread = covariances[i], mixture.covariances[k]
        gain = np.linalg.solve(before[:, :d, :d] + spread, before[:, :d, :]).swapaxes(1, 2)
        fused = means[i] + np.einsum('pij,pj->pi', gain, mixture.means[k] - means[i][:, :d])
        # Joseph's form, (1 - G C) S (1 - G C)' + G R G', keeps them positive definite.
        kept = before - gain @ before[:, :d]
        left = kept + (gain @ spread - kept[:, :, :d]) @ gain.swapaxes(1, 2)
        states = GaussianMixture(np.ones(len(i)), fused, 0.5 * (left + left.swapaxes(1, 2)))
        transition, noise = dynamics.transition(interval)
        gains, go_on = np.zeros_like(covariances), np.unique(i)
        gains[go_on] = np.linalg.solve(
            covariances[go_on], transition @ self.states.covariances[go_on]
        ).swapaxes(1, 2)
        passage = Passage(means, covariances, gains, transition, noise)
        return self._of(log[chosen], states, i, k, passage)


class FilteredPaths:
    """The paths through the modes of images that come one after the other.

    Args:
        points: maps poses (N, d) to points (N, P, 3), m: some paths are apart, see
            `PathHypotheses.followed`; None: they are the heaviest.
        first: states (H, n) that they begin in; None: the first mixture begins them.

    Attributes:
        steps: the paths up to each time, of which those are left that go on to the end; of the
            first time, all.
    """

    def __init__(
        self,
        dynamics: LinearGaussianDynamics,
        count: int,
        points: Callable[[Array], Array] | None = None,
        first: GaussianMixture | None = None,
    ) -> None:
        self.dynamics, self.count, self.points = dynamics, count, points
        self.steps: list[PathHypotheses] = []
        # Distances of the modes of each time, and of the paths, m.
        self._gaps: list[Array | None] = []
        self._past: Array | None = None
        if first is not None:
            self._begin(first)

    def add(self, mixture: GaussianMixture, interval: float) -> None:
        """Goes on to the likelihood of the next pose, `interval` s after the one before."""
        if not self.steps:
            self._begin(first_state(mixture, self.dynamics))
            return
        gaps = self._distances(mixture.means)
        step = self.steps[-1].followed(
            mixture, self.dynamics, interval, self.count, gaps, self._past
        )
        if self._past is not None and gaps is not None:
            before = self._past[np.ix_(step.parents, step.parents)]
            self._past = np.maximum(before, gaps[np.ix_(step.modes, step.modes)])
        self.steps.append(step)
        self._gaps.append(gaps)
        self._forget_dead_ends()

    def advance(self) -> None:
        """Takes the oldest time out; the states of the paths stand for all times before."""
        del self.steps[0], self._gaps[0]
        first = self.steps[0]
        self.steps[0] = replace(
            first, parents=first.parents[:0], modes=np.arange(len(first)), passage=None
        )
        self._gaps[0] = self._distances(first.states.means[:, : self.dynamics.dimension])
        self._past = distances_of_paths(traced(self.steps), self._gaps)

    @property
    def paths(self) -> Paths:
        """The paths, heaviest first; nodes of the first time are its states."""
        return Paths(traced(self.steps), self.steps[-1].log_weights)

    @property
    def motions(self) -> Index:
        """Leader (H,) of each path, the heaviest path of the same motion; may be itself."""
        log = self.steps[-1].log_weights
        past = self._past
        if past is None:
            return np.arange(len(log))
        chosen = leaders(log, lambda i: past[i], SAME_MOTION)
        return np.asarray(chosen[np.argmin(past[chosen], axis=0)])

    def _begin(self, states: GaussianMixture) -> None:
        self.steps.append(PathHypotheses.of_states(states))
        self._past = self._distances(states.means[:, : self.dynamics.dimension])
        self._gaps.append(self._past)

    def _distances(self, poses: Array) -> Array | None:
        """Distances (K, K) of poses (K, d), m; None: there is no measure of distance."""
        return None if self.points is None else distances(self.points(poses))

    def _forget_dead_ends(self) -> None:
        """Leaves out, of all times but the first, the paths that no later one continues."""
        for t in range(len(self.steps) - 1, 1, -1):
            after, step = self.steps[t], self.steps[t - 1]
            go_on, parents = np.unique(after.parents, return_inverse=True)
            if len(go_on) == len(step):
                break
            assert after.passage is not None
            passage = after.passage[go_on]
            self.steps[t] = replace(after, parents=parents.reshape(-1), passage=passage)
            self.steps[t - 1] = step[go_on]


def distances(points: Array) -> Array:
    """Distances (K, K) of the points of K poses (K, P, 3) that are farthest from each other."""
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=3).max(2))


def distances_of_paths(nodes: Index, gaps: Sequence[Array | None]) -> Array | None:
    """Largest distances (H, H) at any time of paths with nodes (H, T).

    Args:
        gaps: T arrays (K_t, K_t) of distances of the nodes of each time; None: unknown.
    """
    result = np.zeros((len(nodes), len(nodes)))
    for column, gap in zip(nodes.T, gaps, strict=True):
        if gap is None:
            return None
        np.maximum(result, gap[np.ix_(column, column)], out=result)
    return result


def traced(steps: Sequence[PathHypotheses]) -> Index:
    """Nodes (H, T) of the paths of the last of T steps: of the first, paths; of others, modes."""
    at = np.arange(len(steps[-1]))
    nodes = np.empty((len(at), len(steps)), dtype=np.intp)
    for t in range(len(steps) - 1, 0, -1):
        nodes[:, t] = steps[t].modes[at]
        at = steps[t].parents[at]
    nodes[:, 0] = at
    return nodes


def first_state(mixture: GaussianMixture, dynamics: LinearGaussianDynamics) -> GaussianMixture:
    """The density of the first state: its likelihood times the prior of the dynamics."""
    n, d = dynamics.state_dimension, dynamics.dimension
    precisions = np.zeros((len(mixture), n, n))
    precisions[:, :d, :d] = np.linalg.inv(mixture.covariances)
    pull = np.zeros((len(mixture), n))
    pull[:, :d] = np.einsum('kij,kj->ki', precisions[:, :d, :d], mixture.means)
    pull += dynamics.initial_precision @ dynamics.initial_mean
    covariances = np.linalg.inv(precisions + dynamics.initial_precision)
    covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
    means = np.einsum('kij,kj->ki', covariances, pull)
    log = np.log(mixture.weights)
    known = dynamics.initial_precision[:d, :d]
    if known.any():
        spread = np.asarray(np.linalg.inv(known), dtype=np.float64)
        pairs = np.stack([np.arange(len(mixture)), np.zeros(len(mixture), dtype=int)], axis=1)
        log = log + pair_log_densities(
            mixture.means, mixture.covariances, dynamics.initial_mean[None, :d], spread[None], pairs
        )
    return GaussianMixture(np.exp(log - logsumexp(log)), means, covariances)


@dataclass(frozen=True, eq=False)
class SmoothedPath:
    """A Gaussian Markov process, as the density of each state given the next one.

        x_T ~ N(m_T, S_T),    x_t | x_{t+1} ~ N(m_t + G_t (x_{t+1} - A m_t), D_t)
        D_t = (1 - G_t A) S_t (1 - G_t A)' + G_t Q G_t' = R_t R_t'

    White noise is R_t^-1 (x_t - G_t x_{t+1}). The methods are those of `BlockCholesky`.

    Attributes:
        filtered: T covariances S_t (n, n).
        passages: T-1 passages, each with the row of the path in it.
    """

    filtered: tuple[Array, ...]
    passages: tuple[tuple[Passage, int], ...]

    @property
    def times(self) -> int:
        """T."""
        return len(self.filtered)

    @property
    def size(self) -> int:
        """n."""
        return len(self.filtered[0])

    @cached_property
    def gains(self) -> tuple[Array, ...]:
        """T-1 matrices G_t (n, n)."""
        return tuple(passage.gains[row] for passage, row in self.passages)

    @cached_property
    def roots(self) -> Array:
        """(T, n, n) R_t, lower triangular; the last is that of S_T."""
        left = np.empty((self.times, self.size, self.size))
        left[-1] = self.filtered[-1]
        for t, (gain, (passage, _)) in enumerate(zip(self.gains, self.passages, strict=True)):
            kept = np.eye(self.size) - gain @ passage.transition
            left[t] = kept @ self.filtered[t] @ kept.T + gain @ passage.noise @ gain.T
        return np.asarray(np.linalg.cholesky(0.5 * (left + left.swapaxes(1, 2))))

    @cached_property
    def log_determinant(self) -> float:
        """log |P| of the precision P."""
        return float(-2.0 * np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum())

    def solve_transposed(self, right: Array) -> Array:
        """White noise (..., T, n) becomes noise of covariance P^-1."""
        result = np.array((self.roots @ right[..., None])[..., 0])
        for t in range(self.times - 2, -1, -1):
            result[..., t, :] += result[..., t + 1, :] @ self.gains[t].T
        return result

    def whiten(self, x: Array) -> Array:
        """The white noise of trajectories x (..., T, n): x' P x is its square."""
        apart = np.array(x)
        for t, gain in enumerate(self.gains):
            apart[..., t, :] -= x[..., t + 1, :] @ gain.T
        return np.asarray(np.linalg.solve(self.roots, apart[..., None])[..., 0])

    def inverse_blocks(self) -> Array:
        """Blocks (T, n, n) on the diagonal of P^-1."""
        covariances = np.array(self.filtered)
        for t in range(self.times - 2, -1, -1):
            (passage, row), gain = self.passages[t], self.gains[t]
            change = gain @ (covariances[t + 1] @ gain.T - passage.covariances[row] @ gain.T)
            covariances[t] += 0.5 * (change + change.T)
        return covariances

    def matrix(self) -> BlockTridiagonal:
        """P."""
        inverse = np.linalg.inv(self.roots)
        diagonal = inverse.swapaxes(1, 2) @ inverse
        gains = np.array(self.gains).reshape(-1, self.size, self.size)
        lower = -gains.swapaxes(1, 2) @ diagonal[:-1]
        diagonal[1:] -= lower @ gains
        return BlockTridiagonal(diagonal, lower)


def smoothed_paths(steps: Sequence[PathHypotheses]) -> tuple[Array, tuple[SmoothedPath, ...]]:
    """States (H, T, n) of the H paths of the last of T steps, and their covariances."""
    at = np.arange(len(steps[-1]))
    rows = [at]
    states = np.empty((len(at), len(steps), steps[-1].states.dimension))
    states[:, -1] = steps[-1].states.means
    for t in range(len(steps) - 2, -1, -1):
        step, passage = steps[t], steps[t + 1].passage
        assert passage is not None
        at = steps[t + 1].parents[at]
        moved = states[:, t + 1] - passage.means[at]
        for row in np.unique(at):
            mine = at == row
            states[mine, t] = step.states.means[row] + moved[mine] @ passage.gains[row].T
        rows.append(at)
    passages = [step.passage for step in steps[1:] if step.passage is not None]
    return states, tuple(
        SmoothedPath(
            tuple(step.states.covariances[row] for step, row in zip(steps, own, strict=True)),
            tuple(zip(passages, own[:-1], strict=True)),
        )
        for own in np.stack(rows[::-1], axis=1).tolist()
    )
