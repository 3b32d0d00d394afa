"""The states of a path given all of it, back from those that were filtered (`path_hypotheses`).

    x_t = m_t + G_t (x_{t+1} - A m_t),          G_t = S_t A' P_{t+1}^-1,  P_{t+1} = A S_t A' + Q
    C_t = S_t + G_t (C_{t+1} - P_{t+1}) G_t'    [Rauch, Tung and Striebel 1965]

Paths that part at a time have the same states and gains before it, which are held once. A mean
costs a product of a matrix and a vector; covariances are made of the paths that are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.block_tridiagonal import BlockTridiagonal
from hmt_ros.smoothing.path_hypotheses import Passage, PathHypotheses


@dataclass(frozen=True, eq=False)
class SmoothedPath:
    """A Gaussian Markov process by what each state is, given the next one.

        x_T ~ N(m_T, S_T),    x_t | x_{t+1} ~ N(m_t + G_t (x_{t+1} - A m_t), D_t)
        D_t = (1 - G_t A) S_t (1 - G_t A)' + G_t Q G_t' = R_t R_t'

    White noise is R_t^-1 (x_t - G_t x_{t+1}). The methods are those of `BlockCholesky`.

    Attributes:
        filtered: T covariances S_t (n, n).
        passages: T-1; of the path before each the row in it.
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

    def inverse_blocks(self) -> tuple[Array, Array]:
        """Blocks of P^-1: (T, n, n) on the diagonal and (T-1, n, n) below it."""
        covariances = np.array(self.filtered)
        neighbours = np.empty_like(covariances[1:])
        for t in range(self.times - 2, -1, -1):
            (passage, row), gain = self.passages[t], self.gains[t]
            np.matmul(covariances[t + 1], gain.T, out=neighbours[t])
            change = gain @ (neighbours[t] - passage.covariances[row] @ gain.T)
            covariances[t] += 0.5 * (change + change.T)
        return covariances, neighbours

    def matrix(self) -> BlockTridiagonal:
        """P."""
        inverse = np.linalg.inv(self.roots)
        diagonal = inverse.swapaxes(1, 2) @ inverse
        gains = np.array(self.gains).reshape(-1, self.size, self.size)
        lower = -gains.swapaxes(1, 2) @ diagonal[:-1]
        diagonal[1:] -= lower @ gains
        return BlockTridiagonal(diagonal, lower)


def smoothed_paths(steps: Sequence[PathHypotheses]) -> tuple[Array, tuple[SmoothedPath, ...]]:
    """States (H, T, n) of the H paths of the last of T steps, and their covariances.

    Args:
        steps: one after the other, as of `FilteredPaths`.
    """
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
