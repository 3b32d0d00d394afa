"""Symmetric block-tridiagonal matrices: Cholesky factors, solutions, blocks of the inverse.

The precision of a trajectory X = (x_1 .. x_T) of a Markov process has this form (VMS 5):
observations fill the diagonal blocks, the dynamics couple neighbours,

    P = | D_1  E_1'          |        P = L L',  L lower triangular with the same blocks.
        | E_1  D_2  E_2'     |
        |      E_2  D_3  ... |

Elimination forwards is filtering, substitution backwards is smoothing. The cost is O(T n^3) and
there is never a dense (T n, T n) array: the matrix is kept in LAPACK's band storage, whose width
follows from the coupling; where E_t is diagonal it is half of that for full blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import as_strided
from scipy.linalg.lapack import dpbtrf, dpbtrs, dtbtrs, dtrtri

from hmt_ros.core import add_diagonal, fill_lower
from hmt_ros.inference.arrays import Array


class NotPositiveDefiniteError(ValueError):
    """A matrix that was to be factorised is not positive definite."""


@dataclass(frozen=True, eq=False)
class BlockTridiagonal:
    """A symmetric matrix of T x T blocks of n x n.

    Attributes:
        diagonal: (T, n, n) D_t; only the lower triangles are read.
        lower: (T-1, n, n) E_t, the block below D_t.

    Raises:
        ValueError: shapes that contradict each other.
    """

    diagonal: Array
    lower: Array

    def __post_init__(self) -> None:
        t, n = self.diagonal.shape[:2]
        if self.diagonal.shape != (t, n, n) or self.lower.shape != (t - 1, n, n) or t < 1:
            raise ValueError(
                f'blocks {self.diagonal.shape} and {self.lower.shape} do not fit: wanted '
                '(T, n, n) and (T-1, n, n)'
            )

    @cached_property
    def bandwidth(self) -> int:
        """Number of diagonals below the main one that are not zero."""
        return bandwidth(self.lower, self.diagonal.shape[1])

    def product(self, x: Array) -> Array:
        """P x of trajectories x (..., T, n)."""
        lower = np.tril(self.diagonal)
        symmetric = lower + np.tril(self.diagonal, -1).swapaxes(1, 2)
        result: Array = (symmetric @ x[..., None])[..., 0]
        result[..., 1:, :] += (self.lower @ x[..., :-1, :, None])[..., 0]
        result[..., :-1, :] += (self.lower.swapaxes(1, 2) @ x[..., 1:, :, None])[..., 0]
        return result

    def cholesky(self) -> BlockCholesky:
        """The factor L.

        Raises:
            NotPositiveDefiniteError: the matrix is not positive definite.
        """
        t, n = self.diagonal.shape[:2]
        return factorise_band(self.band().T, t, n)

    def band(self) -> Array:
        """The columns (T n, width + 1) of LAPACK's band storage: [j, i - j] = P[i, j]."""
        t, n = self.diagonal.shape[:2]
        columns = np.zeros((t * n, self.bandwidth + 1))
        add_diagonal(columns, np.ascontiguousarray(self.diagonal.swapaxes(1, 2)), n)
        fill_lower(columns, np.ascontiguousarray(self.lower))
        return columns


@dataclass(frozen=True, eq=False)
class BlockCholesky:
    """The Cholesky factor of a block-tridiagonal matrix, P = L L'.

    Attributes:
        band: (width + 1, T n) L in LAPACK's band storage: band[i - j, j] = L[i, j].
        times, size: T and n.
    """

    band: Array
    times: int
    size: int

    @property
    def width(self) -> int:
        """Number of diagonals below the main one."""
        return len(self.band) - 1

    @cached_property
    def log_determinant(self) -> float:
        """log |P|."""
        return float(2.0 * np.log(self.band[0]).sum())

    def solve(self, right: Array) -> Array:
        """P^-1 b of right sides b (..., T, n)."""
        solution, _ = dpbtrs(self.band, self._columns(right), lower=1, overwrite_b=1)
        return self._rows(solution, right)

    def solve_lower(self, right: Array) -> Array:
        """L^-1 b of right sides b (..., T, n)."""
        solution, _ = dtbtrs(self.band, self._columns(right), uplo='L', trans='N', overwrite_b=1)
        return self._rows(solution, right)

    def solve_transposed(self, right: Array) -> Array:
        """L'^-1 b of right sides b (..., T, n): white noise becomes noise of covariance P^-1."""
        solution, _ = dtbtrs(self.band, self._columns(right), uplo='L', trans='T', overwrite_b=1)
        return self._rows(solution, right)

    def whiten(self, x: Array) -> Array:
        """L' x of trajectories x (..., T, n), so that x' P x = |L' x|^2."""
        own, coupling = self.blocks
        result: Array = (own.swapaxes(1, 2) @ x[..., None])[..., 0]
        result[..., :-1, :] += (coupling.swapaxes(1, 2) @ x[..., 1:, :, None])[..., 0]
        return result

    @cached_property
    def blocks(self) -> tuple[Array, Array]:
        """The blocks of L: (T, n, n) lower triangular, and (T-1, n, n) below them."""
        t, n, width = self.times, self.size, self.width
        own = np.tril(self._windows(0, t))
        row, column = np.indices((n, n))
        below = np.where(n + row - column <= width, self._windows(n, t - 1), 0.0)
        return own, below

    def inverse_blocks(self) -> Array:
        """Blocks (T, n, n) on the diagonal of P^-1: for a precision the marginal covariances.

        Backwards, with G_t = L_{t+1,t} L_t^-1:

            C_T = (L_T L_T')^-1,    C_t = (L_t L_t')^-1 + G_t' C_{t+1} G_t
        """
        own, below = self.blocks
        t, n = self.times, self.size
        inverse = np.empty((t, n, n))
        for i in range(t):
            inverse[i] = dtrtri(own[i], lower=1)[0]
        gain = below @ inverse[:-1]
        covariances = inverse.swapaxes(1, 2) @ inverse
        for i in range(t - 2, -1, -1):
            covariances[i] += gain[i].T @ (covariances[i + 1] @ gain[i])
        covariances += covariances.swapaxes(1, 2).copy()
        covariances *= 0.5
        return covariances

    def matrix(self) -> BlockTridiagonal:
        """P."""
        own, below = self.blocks
        diagonal = own @ own.swapaxes(1, 2)
        diagonal[1:] += below @ below.swapaxes(1, 2)
        return BlockTridiagonal(diagonal, below @ own[:-1].swapaxes(1, 2))

    def _windows(self, offset: int, count: int) -> Array:
        """Blocks L[t n + offset + a, t n + b] for t < count, with rubbish outside the band.

        In the column-major band L[i, j] lies at i + j * width.
        """
        n, width = self.size, self.width
        flat = self.band.reshape(-1, order='F')
        padded = np.concatenate([flat, np.zeros(n + offset)])
        step = padded.itemsize
        return as_strided(
            padded[offset:],
            (count, n, n),
            (step * n * (1 + width), step, step * width),
            writeable=False,
        )

    def _columns(self, right: Array) -> Array:
        return np.array(right.reshape(-1, self.times * self.size)).T

    def _rows(self, solution: Array, like: Array) -> Array:
        return np.ascontiguousarray(solution.T).reshape(like.shape)


def bandwidth(lower: Array, n: int) -> int:
    """Number of diagonals below the main one that blocks E_t (T-1, n, n) of coupling reach."""
    row, column = np.nonzero((lower != 0).any(axis=0))
    return max(n - 1, n + int((row - column).max(initial=-n)))


def factorise_band(band: Array, times: int, size: int) -> BlockCholesky:
    """Factorises a matrix in band storage (width + 1, T n), which is overwritten.

    Raises:
        NotPositiveDefiniteError: the matrix is not positive definite, or not finite.
    """
    factor, info = dpbtrf(band, lower=1, overwrite_ab=1)
    # LAPACK lets NaN pass where it is not on the diagonal of a pivot.
    if info != 0 or not np.isfinite(factor[0, -1]):
        raise NotPositiveDefiniteError(
            f'a matrix of {times} x {times} blocks is not positive definite: pivot {info} of '
            f'{times * size}'
        )
    return BlockCholesky(factor, times, size)
