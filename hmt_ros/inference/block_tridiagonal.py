"""Symmetric block-tridiagonal matrices: Cholesky factors, solutions, blocks of the inverse.

The precision of a trajectory X = (x_1 .. x_T) of a Markov process has this form (VMS 5):
observations add to the diagonal blocks, and the dynamics couple neighbours,

    P = | D_1  E_1'          |        P = L L',  L lower triangular with the same blocks.
        | E_1  D_2  E_2'     |
        |      E_2  D_3  ... |

Forward elimination is filtering, backward substitution is smoothing. The cost is O(T n^3), without
a dense (T n, T n) array: the matrix is in LAPACK's band storage, whose width depends on the
coupling blocks E_t. With diagonal E_t, the band is half as wide as with full blocks.
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
    invert_block,
    multiply_band_transposed,
    solve_band_lower,
    solve_band_transposed,
)
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product


class NotPositiveDefiniteError(ValueError):
    """Raised when a matrix to factorise is not positive definite."""


@dataclass(frozen=True, eq=False)
class BlockTridiagonal:
    """A symmetric matrix of T x T blocks, each of size n x n.

    Attributes:
        diagonal: (T, n, n) diagonal blocks D_t; only the lower triangles are read.
        lower: (T-1, n, n) blocks E_t below D_t.

    Raises:
        ValueError: shapes are inconsistent.
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
        """Number of diagonals in the band below the main diagonal."""
        return bandwidth(self.lower, self.diagonal.shape[1])

    def product(self, x: Array) -> Array:
        """Product P x with trajectories x (..., T, n)."""
        flat = np.ascontiguousarray(x.reshape(-1, self.diagonal.shape[0] * self.diagonal.shape[1]))
        result = np.zeros_like(flat)
        add_band_product(self.band(), flat, result)
        return result.reshape(x.shape)

    def cholesky(self) -> BlockCholesky:
        """Computes the Cholesky factor L.

        Raises:
            NotPositiveDefiniteError: the matrix is not positive definite.
        """
        t, n = self.diagonal.shape[:2]
        return factorise(self.band(), t, n)

    def band(self) -> Array:
        """Columns (T n, width + 1) of P in LAPACK's band storage: [j, i - j] = P[i, j]."""
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
        times, size: number T of blocks, and size n of each block.
        last_first: whether blocks are eliminated from the last to the first. If so, blocks of the
            inverse are computed from the first to the last.
    """

    columns: Array
    times: int
    size: int
    last_first: bool = False

    @property
    def width(self) -> int:
        """Number of diagonals below the main diagonal."""
        return int(self.columns.shape[1]) - 1

    @cached_property
    def log_determinant(self) -> float:
        """log |P|."""
        return float(2.0 * elementary.log(self.columns[:, 0]).sum())

    def solve(self, right: Array) -> Array:
        """P^-1 b for right-hand sides b (..., T, n)."""
        return self._applied(right, solve_band_lower, solve_band_transposed)

    def solve_lower(self, right: Array) -> Array:
        """L^-1 b for right-hand sides b (..., T, n)."""
        return self._applied(right, solve_band_lower)

    def solve_transposed(self, right: Array) -> Array:
        """L'^-1 b for right-hand sides b (..., T, n): white noise b gets the covariance P^-1."""
        return self._applied(right, solve_band_transposed)

    def whiten(self, x: Array) -> Array:
        """L' x for trajectories x (..., T, n), so that x' P x = |L' x|^2."""
        return self._applied(x, multiply_band_transposed)

    @cached_property
    def blocks(self) -> tuple[Array, Array]:
        """Blocks of L: (T, n, n) on the diagonal, and (T-1, n, n) below the diagonal."""
        t, n, width = self.times, self.size, self.width
        own = np.tril(self._windows(0, t))
        row, column = np.indices((n, n))
        below = np.where(n + row - column <= width, self._windows(n, t - 1), 0.0)
        return own, below

    def inverse_blocks(self, count: int | None = None) -> Array:
        """Returns the first `count` diagonal blocks (count, n, n) of P^-1; None: all T blocks.

        If P is a precision, these are the marginal covariances. The recursion runs backwards along
        L, with G_t = L_{t+1,t} L_t^-1:

            C_T = (L_T L_T')^-1,    C_t = (L_t L_t')^-1 + G_t' C_{t+1} G_t
        """
        count = self.times if count is None else count
        known, n = self._inverse_blocks, self.size
        while len(known) < (count if self.last_first else self.times):
            block = np.empty((n, n))
            after = known[-1] if known else np.empty((0, n))
            invert_block(self.columns, self.times - 1 - len(known), after, block)
            known.append(block)
        return np.array((known if self.last_first else known[::-1])[:count])

    @cached_property
    def _inverse_blocks(self) -> list[Array]:
        """Blocks of the inverse computed so far, backwards along L."""
        return []

    def matrix(self) -> BlockTridiagonal:
        """Computes P = L L'."""
        own, below = self.blocks
        diagonal = product(own, own.swapaxes(1, 2))
        diagonal[1:] += product(below, below.swapaxes(1, 2))
        lower = product(below, own[:-1].swapaxes(1, 2))
        if self.last_first:
            return BlockTridiagonal(diagonal[::-1], lower[::-1].swapaxes(1, 2))
        return BlockTridiagonal(diagonal, lower)

    def _windows(self, offset: int, count: int) -> Array:
        """Blocks L[t n + offset + a, t n + b] for t < count; values outside the band are undefined.

        L[i, j] has the flat index i + j * width.
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
        """Applies in-place functions to copies of vectors (..., T, n), one after the other."""
        order = slice(None, None, -1 if self.last_first else 1)
        trajectories = vectors.reshape(-1, self.times, self.size)[:, order]
        result = np.array(trajectories, order='C').reshape(-1, self.times * self.size)
        for function in functions:
            function(self.columns, result)
        return result.reshape(trajectories.shape)[:, order].reshape(vectors.shape)


def bandwidth(lower: Array, n: int) -> int:
    """Number of diagonals below the main diagonal, given the blocks E_t (T-1, n, n)."""
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
