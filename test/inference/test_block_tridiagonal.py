"""Block-tridiagonal algebra against the dense matrix."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.core import add_band_product
from hmt_ros.inference.block_tridiagonal import (
    BlockCholesky,
    BlockTridiagonal,
    NotPositiveDefiniteError,
)

CASES = [(3, 5, 'full'), (3, 5, 'diagonal'), (3, 5, 'lower'), (3, 5, 'upper'), (1, 4, 'full'),
         (4, 1, 'full'), (2, 2, 'zero')]  # fmt: skip


def example(n: int, times: int, coupling: str) -> tuple[BlockTridiagonal, np.ndarray]:
    rng = np.random.default_rng(0)
    lower = 0.3 * rng.normal(size=(times - 1, n, n))
    lower *= {
        'full': np.ones((n, n)),
        'diagonal': np.eye(n),
        'lower': np.tril(np.ones((n, n))),
        'upper': np.triu(np.ones((n, n))),
        'zero': np.zeros((n, n)),
    }[coupling]
    factors = rng.normal(size=(times, n, n))
    diagonal = factors @ factors.swapaxes(1, 2) + 8 * np.eye(n)
    dense = np.zeros((times, n, times, n))
    for t in range(times):
        dense[t, :, t] = diagonal[t]
    for t, block in enumerate(lower):
        dense[t + 1, :, t], dense[t, :, t + 1] = block, block.T
    return BlockTridiagonal(diagonal, lower), dense.reshape(times * n, -1)


@pytest.mark.parametrize(('n', 'times', 'coupling'), CASES)
def test_everything_agrees_with_the_dense_matrix(n, times, coupling):
    matrix, dense = example(n, times, coupling)
    factor = matrix.cholesky()
    lower, inverse = np.linalg.cholesky(dense), np.linalg.inv(dense)
    x = np.random.default_rng(1).normal(size=(3, times, n))
    flat = x.reshape(3, -1)
    for found, expected in (
        (matrix.product(x), flat @ dense),
        (factor.solve(x), flat @ inverse),
        (factor.whiten(x), flat @ lower),
        (factor.solve_lower(x), np.linalg.solve(lower, flat.T).T),
        (factor.solve_transposed(x), np.linalg.solve(lower.T, flat.T).T),
    ):
        np.testing.assert_allclose(found.reshape(3, -1), expected, atol=1e-12)
    product = np.zeros_like(flat)
    add_band_product(matrix.band(), flat, product)
    np.testing.assert_allclose(product, flat @ dense, atol=1e-12)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1])
    covariances = factor.inverse_blocks()
    blocks = inverse.reshape(times, n, times, n)
    for t in range(times):
        np.testing.assert_allclose(covariances[t], blocks[t, :, t], atol=1e-14)


def test_the_last_block_may_come_first():
    matrix, dense = example(3, 5, 'full')
    backwards = BlockTridiagonal(matrix.diagonal[::-1], matrix.lower[::-1].swapaxes(1, 2))
    columns = backwards.cholesky().columns
    factor = BlockCholesky(columns, 5, 3, last_first=True)
    inverse, x = np.linalg.inv(dense), np.random.default_rng(1).normal(size=(2, 5, 3))
    np.testing.assert_allclose(factor.solve(x).reshape(2, -1), x.reshape(2, -1) @ inverse)
    squares = np.square(factor.whiten(x)).sum((1, 2))
    np.testing.assert_allclose(squares, np.einsum('sti,sti->s', x, matrix.product(x)))
    np.testing.assert_allclose(factor.matrix().diagonal, matrix.diagonal)
    np.testing.assert_allclose(factor.matrix().lower, matrix.lower)
    blocks = inverse.reshape(5, 3, 5, 3)[range(5), :, range(5)]
    np.testing.assert_allclose(factor.inverse_blocks(2), blocks[:2], atol=1e-14)
    np.testing.assert_allclose(factor.inverse_blocks(), blocks, atol=1e-14)


def test_the_band_is_as_narrow_as_the_coupling():
    widths = [example(4, 5, kind)[0].bandwidth for kind in ('full', 'lower', 'diagonal', 'zero')]
    assert widths == [7, 7, 4, 3]
    assert example(4, 5, 'upper')[0].bandwidth == 4


def test_coloured_noise_has_the_inverse_as_covariance():
    matrix, dense = example(2, 3, 'full')
    noise = np.random.default_rng(2).normal(size=(100_000, 3, 2))
    found = np.cov(matrix.cholesky().solve_transposed(noise).reshape(len(noise), -1).T)
    np.testing.assert_allclose(found, np.linalg.inv(dense), atol=3e-3)


def test_a_matrix_that_is_not_positive_definite_is_refused():
    matrix, _ = example(2, 3, 'full')
    with pytest.raises(NotPositiveDefiniteError, match='not positive definite'):
        BlockTridiagonal(-matrix.diagonal, matrix.lower).cholesky()
    with pytest.raises(NotPositiveDefiniteError):
        BlockTridiagonal(matrix.diagonal * np.nan, matrix.lower).cholesky()


def test_blocks_must_fit():
    with pytest.raises(ValueError, match='do not fit'):
        BlockTridiagonal(np.ones((3, 2, 2)), np.ones((3, 2, 2)))
