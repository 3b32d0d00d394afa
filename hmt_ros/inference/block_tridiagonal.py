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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import as_strided

from hmt_ros.core import (
    add_band_product,
    add_diagonal,
    elementary,
    factorise_band,
    fill_lower,
    multiply_band_transposed,
    solve_band_lower,
    solve_band_transposed,
)
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import inverse_triangular, product


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
        flat = np.ascontiguousarray(x.reshape(-1, self.diagonal.shape[0] * self.diagonal.shape[1]))
        result = np.zeros_like(flat)
        add_band_product(self.band(), flat, result)
        return result.reshape(x.shape)

    def cholesky(self) -> BlockCholesky:
        """The factor L.

        Raises:
            NotPositiveDefiniteError: the matrix is not positive definite.
        """
        t, n = self.diagonal.shape[:2]
        return factorise(self.band(), t, n)

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
        columns: (T n, width + 1) of L in LAPACK's band storage: [j, i - j] = L[i, j].
        times, size: T and n.
    """

    columns: Array
    times: int
    size: int

    @property
    def width(self) -> int:
        """Number of diagonals below the main one."""
        return int(self.columns.shape[1]) - 1

    @cached_property
    def log_determinant(self) -> float:
        """log |P|."""
        return float(2.0 * elementary.log(self.columns[:, 0]).sum())

    def solve(self, right: Array) -> Array:
        """P^-1 b of right sides b (..., T, n)."""
        return self._applied(right, solve_band_lower, solve_band_transposed)

    def solve_lower(self, right: Array) -> Array:
        """L^-1 b of right sides b (..., T, n)."""
        return self._applied(right, solve_band_lower)

    def solve_transposed(self, right: Array) -> Array:
        """L'^-1 b of right sides b (..., T, n): white noise becomes noise of covariance P^-1."""
        return self._applied(right, solve_band_transposed)

    def whiten(self, x: Array) -> Array:
        """L' x of trajectories x (..., T, n), so that x' P x = |L' x|^2."""
        return self._applied(x, multiply_band_transposed)

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
        inverse = inverse_triangular(own)
        gain = product(below, inverse[:-1])
        covariances: Array = product(inverse.swapaxes(1, 2), inverse)
        for i in range(self.times - 2, -1, -1):
            covariances[i] += product(gain[i].T, product(covariances[i + 1], gain[i]))
        covariances += covariances.swapaxes(1, 2).copy()
        covariances *= 0.5
        return covariances

    def matrix(self) -> BlockTridiagonal:
        """P."""
        own, below = self.blocks
        diagonal = product(own, own.swapaxes(1, 2))
        diagonal[1:] += product(below, below.swapaxes(1, 2))
        return BlockTridiagonal(diagonal, product(below, own[:-1].swapaxes(1, 2)))

    def _windows(self, offset: int, count: int) -> Array:
        """Blocks L[t n + offset + a, t n + b] for t < count, with rubbish outside the band.

        L[i, j] lies at i + j * width.
        """
        n, width = self.size, self.width
        padded = np.concatenate([self.columns.reshape(-1), np.zeros(n + offset)])
        step = padded.itemsize
        return as_strided(
            padded[offset:],
            (count, n, n),
            (step * n * (1 + width), step, step * width),
            writeable=False,
        )

    def _applied(self, vectors: Array, *functions: Callable[[Array, Array], None]) -> Array:
        """The results of functions that overwrite vectors (..., T, n), one after the other."""
        result = np.array(vectors.reshape(-1, self.times * self.size), order='C')
        for function in functions:
            function(self.columns, result)
        return result.reshape(vectors.shape)


def bandwidth(lower: Array, n: int) -> int:
    """Number of diagonals below the main one that blocks E_t (T-1, n, n) of coupling reach."""
    row, column = np.nonzero((lower != 0).any(axis=0))
    return max(n - 1, n + int((row - column).max(initial=-n)))


def factorise(columns: Array, times: int, size: int) -> BlockCholesky:
    """Factorises a matrix in band storage (T n, width + 1), which is overwritten.

    Raises:
        NotPositiveDefiniteError: the matrix is not positive definite, or not finite.
    """
    done = factorise_band(columns)
    if done < len(columns):
        raise NotPositiveDefiniteError(
            f'a matrix of {times} x {times} blocks is not positive definite: pivot {done + 1} of '
            f'{times * size}'
        )
    return BlockCholesky(columns, times, size)
