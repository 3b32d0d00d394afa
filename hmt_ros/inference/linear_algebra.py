"""Linear algebra with bit-identical results on every processor.

BLAS and LAPACK, which numpy calls, choose kernels by processor, and these add in different orders.
The functions of this module add in a fixed order. They broadcast over leading axes and, as in
numpy, raise `numpy.linalg.LinAlgError` if there is no result. They are meant for matrices with up
to a few hundred rows.
"""

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.core import matrices

Array = NDArray[np.float64]

# Matrix product like `numpy.matmul`, in float32 if both operands are float32, else in float64.
product: Callable[..., Any] = matrices.product

# log sum exp(x) along the last axis, or along `axis`, like `numpy.logaddexp.reduce`.
log_sum_exp: Callable[..., Any] = matrices.log_sum_exp

# Mean distance (...) between corresponding points (..., P, c) of two sets.
mean_distances: Callable[..., Any] = matrices.mean_distance

# Pairwise distances (..., N, N) of vectors (..., N, k).
distances: Callable[..., Any] = matrices.distances


def _checked(what: str) -> np.errstate:
    def fail(_kind: str, _flag: int) -> NoReturn:
        raise np.linalg.LinAlgError(what)

    return np.errstate(invalid='call', call=fail)


_NOT_POSITIVE = 'matrix is not positive definite'
_SINGULAR = 'singular matrix'
_NOT_CONVERGED = 'no convergence, or a matrix that is not finite'


def length(vector: ArrayLike) -> float:
    """Euclidean length of a vector, or Frobenius norm of an array."""
    vector = np.asarray(vector)
    return float(np.sqrt((vector * vector).sum()))


def unit(vectors: Array) -> Array:
    """Scales vectors (..., n) to length 1."""
    return np.asarray(vectors / np.sqrt((vectors * vectors).sum(-1, keepdims=True)))


def cholesky(matrix: ArrayLike) -> Array:
    """Lower triangular factor L of L L^T, from the lower triangle of a matrix (..., n, n)."""
    with _checked(_NOT_POSITIVE):
        result: Array = matrices.cholesky(matrix)
    return result


def solve(matrix: ArrayLike, right: ArrayLike) -> Array:
    """Solution X of A X = B, for A (..., n, n) and B (..., n, m), or one vector (n,)."""
    return _solved(matrices.solve, matrix, right)


def solve_triangular(
    factor: ArrayLike, right: ArrayLike, *, lower: bool = True, transposed: bool = False
) -> Array:
    """Solution of A X = B, or A^T X = B, for a triangular A (..., n, n); reads one triangle."""
    if transposed:
        factor, lower = np.swapaxes(factor, -1, -2), not lower
    return _solved(matrices.solve_lower if lower else matrices.solve_upper, factor, right)


def inverse(matrix: ArrayLike) -> Array:
    """Inverse of a matrix (..., n, n)."""
    with _checked(_SINGULAR):
        result: Array = matrices.inverse(matrix)
    return result


def inverse_triangular(factor: ArrayLike) -> Array:
    """Inverse of a lower triangular matrix (..., n, n)."""
    return solve_triangular(factor, np.eye(np.shape(factor)[-1]))


def exponential(matrix: ArrayLike) -> Array:
    """Exponential of a matrix (..., n, n)."""
    with _checked(_SINGULAR):
        result: Array = matrices.exponential(matrix)
    return result


def determinant(matrix: ArrayLike) -> Array:
    """Determinant of a matrix (..., n, n)."""
    result: Array = matrices.determinant(matrix)[0]
    return result


def log_determinant(matrix: ArrayLike) -> Array:
    """Log of the absolute determinant of a matrix (..., n, n); -inf if singular."""
    result: Array = matrices.determinant(matrix)[1]
    return result


def symmetric_eigen(matrix: ArrayLike) -> tuple[Array, Array]:
    """Ascending eigenvalues (..., n), eigenvectors (..., n, n) in columns; reads the lower half."""
    with _checked(_NOT_CONVERGED):
        values, vectors = matrices.symmetric_eigen(matrix)
    return values, vectors


def symmetric_eigenvalues(matrix: ArrayLike) -> Array:
    """Ascending eigenvalues (..., n) of a symmetric matrix; reads the lower triangle."""
    with _checked(_NOT_CONVERGED):
        result: Array = matrices.symmetric_eigenvalues(matrix)
    return result


def singular_values(matrix: ArrayLike) -> tuple[Array, Array, Array]:
    """U (..., m, k), descending singular values (..., k), and V^T (..., k, n); k = min(m, n).

    If a singular value is 0, its column of U, or its row of V^T for m < n, is 0.
    """
    matrix = np.asarray(matrix)
    if matrix.shape[-2] < matrix.shape[-1]:
        v, values, u = singular_values(matrix.swapaxes(-1, -2))
        return u.swapaxes(-1, -2), values, v.swapaxes(-1, -2)
    with _checked(_NOT_CONVERGED):
        u, values, v = matrices.singular_values(matrix)
    return u, values, v.swapaxes(-1, -2)


def pseudo_inverse(matrix: ArrayLike, tolerance: float = 1e-15) -> Array:
    """Moore-Penrose inverse (..., n, m); treats singular values s <= `tolerance` max s as 0."""
    u, values, vt = singular_values(matrix)
    large = values > tolerance * values[..., :1]
    inverses = np.divide(1.0, values, out=np.zeros_like(values), where=large)
    result: Array = product(vt.swapaxes(-1, -2) * inverses[..., None, :], u.swapaxes(-1, -2))
    return result


def _solved(function: Callable[..., Any], matrix: ArrayLike, right: ArrayLike) -> Array:
    vector = np.ndim(right) == 1
    with _checked(_SINGULAR):
        result: Array = function(matrix, np.asarray(right)[:, None] if vector else right)
    return result[..., 0] if vector else result
