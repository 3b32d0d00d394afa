import numpy as np
import pytest

from hmt_ros.core import (
    add_band_product,
    add_diagonal,
    factorise_band,
    fill_lower,
    hold,
    invert_block,
    multiply_band_transposed,
    solve_band_lower,
    solve_band_transposed,
)


def dense(columns):
    """The symmetric matrix from the columns of its band."""
    size = len(columns)
    matrix = np.zeros((size, size))
    for j, column in enumerate(columns):
        for b, value in enumerate(column[: size - j]):
            matrix[j, j + b] = matrix[j + b, j] = value
    return matrix


@pytest.mark.parametrize(('times', 'n', 'd', 'width'), [(4, 3, 3, 6), (4, 3, 2, 4), (1, 2, 1, 2)])
def test_a_band_holds_the_blocks_within_its_width(times, n, d, width):
    rng = np.random.default_rng(0)
    blocks, lower = rng.normal(size=(times, d, d)), rng.normal(size=(times - 1, n, n))
    columns = np.zeros((times * n, width))
    add_diagonal(columns, blocks, n)
    fill_lower(columns, lower)
    wanted = np.zeros((times * n, times * n))
    for t in range(times):
        upper = np.triu(blocks[t])
        wanted[t * n : t * n + d, t * n : t * n + d] = upper + np.triu(upper, 1).T
    for t in range(times - 1):
        wanted[(t + 1) * n : (t + 2) * n, t * n : (t + 1) * n] = lower[t]
    row, column = np.indices(wanted.shape)
    wanted = np.where(row - column < width, np.tril(wanted), 0.0)
    np.testing.assert_array_equal(np.tril(dense(columns)), wanted)


def test_held_variables_have_the_rows_of_the_unit_matrix():
    columns = np.random.default_rng(1).normal(size=(7, 3))
    wanted = dense(columns)
    hold(columns, np.array([0, 4, 6]))
    for i in (0, 4, 6):
        wanted[i], wanted[:, i] = 0.0, 0.0
        wanted[i, i] = 1.0
    np.testing.assert_array_equal(dense(columns), wanted)


@pytest.mark.parametrize(
    ('size', 'width'), [(1, 0), (1, 5), (7, 0), (9, 2), (30, 8), (41, 13), (50, 31), (6, 20)]
)
def test_factors_and_solutions_are_those_of_the_dense_matrix(size, width):
    rng = np.random.default_rng(width)
    columns = 0.3 * rng.normal(size=(size, width + 1))
    columns[:, 0] = width + 1.0
    matrix, x = dense(columns), rng.normal(size=(3, size))
    beyond = np.add.outer(np.arange(size), np.arange(width + 1)) >= size
    columns[beyond] = np.nan
    factor = np.linalg.cholesky(matrix)
    assert factorise_band(columns) == size
    assert np.isnan(columns[beyond]).all()
    np.testing.assert_allclose(np.tril(dense(columns)), factor, rtol=0, atol=1e-13)
    for function, wanted in (
        (solve_band_lower, np.linalg.solve(factor, x.T).T),
        (solve_band_transposed, np.linalg.solve(factor.T, x.T).T),
        (multiply_band_transposed, x @ factor),
    ):
        found = x.copy()
        function(columns, found)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize('value', [-1.0, 0.0, np.nan, np.inf])
def test_a_factor_ends_at_the_first_pivot_that_is_none(value):
    columns = np.zeros((20, 4))
    columns[:, 0] = 1.0
    columns[11, 0] = value
    assert factorise_band(columns) == 11
    columns = np.zeros((20, 4))
    columns[:, 0] = 1.0
    columns[11, 2] = np.nan
    assert factorise_band(columns) == 13


@pytest.mark.parametrize(('times', 'n', 'width'), [(3, 5, 9), (4, 2, 2), (1, 3, 2), (3, 1, 1)])
def test_blocks_of_the_inverse_are_those_of_the_dense_matrix(times, n, width):
    rng = np.random.default_rng(n)
    columns = 0.3 * rng.normal(size=(times * n, width + 1))
    columns[:, 0] = width + 1.0
    # Blocks are only coupled to the next one.
    columns[np.add.outer(np.arange(times * n) % n, np.arange(width + 1)) >= 2 * n] = 0.0
    inverse = np.linalg.inv(dense(columns)).reshape(times, n, times, n)
    assert factorise_band(columns) == times * n
    after = np.empty((0, n))
    for place in reversed(range(times)):
        block = np.full((n, n), np.nan)
        invert_block(columns, place, after, block)
        np.testing.assert_allclose(block, inverse[place, :, place], rtol=0, atol=1e-13)
        after = block


@pytest.mark.parametrize(
    ('function', 'arguments', 'text'),
    [
        (add_diagonal, (np.zeros((4, 2)), np.zeros((2, 2, 3)), 2), 'blocks: wanted shape'),
        (add_diagonal, (np.zeros((4, 2)), np.zeros((3, 2, 2)), 2), 'n: wanted'),
        (add_diagonal, (np.zeros((4, 2)), np.zeros((2, 2, 2)), -2), 'n: wanted'),
        (add_diagonal, (np.zeros((6, 2)), np.zeros((2, 3, 3)), 3), 'columns: wanted a band'),
        (add_diagonal, (np.zeros((4, 2)).T, np.zeros((2, 2, 2)), 2), 'columns: wanted .*contig'),
        (fill_lower, (np.zeros((4, 2)), np.zeros((2, 2, 2))), 'columns: wanted shape'),
        (fill_lower, (np.zeros((4, 2)), np.zeros((1, 2, 2), np.float32)), 'lower: wanted'),
        (add_band_product, (np.zeros((4, 2)), np.zeros((1, 3)), np.zeros((1, 4))), 'x: wanted'),
        (add_band_product, (np.zeros((4, 2)), np.zeros((1, 4)), np.zeros((2, 4))), 'result: wan'),
        (hold, (np.zeros((4, 2)), np.array([4])), 'held: wanted numbers'),
        (hold, (np.zeros((4, 2)), np.array([-1])), 'held: wanted numbers'),
        (hold, (np.zeros((4, 0)), np.array([0])), 'columns: wanted a diagonal'),
        (factorise_band, (np.zeros((4, 0)),), 'columns: wanted a diagonal'),
        (factorise_band, (np.zeros((2, 4)).T,), 'columns: wanted .*contiguous'),
        (solve_band_lower, (np.ones((4, 2)), np.zeros((2, 3))), 'x: wanted shape'),
        (solve_band_transposed, (np.ones((4, 2)), np.zeros((4, 2)).T), 'x: wanted .*contiguous'),
        (multiply_band_transposed, (np.ones((4, 0)), np.zeros((1, 4))), 'columns: wanted a'),
        (invert_block, (np.ones((4, 2)), 0, np.zeros((0, 2)), np.zeros((2, 2))), 'after: wanted'),
        (invert_block, (np.ones((4, 2)), 1, np.zeros((2, 2)), np.zeros((2, 2))), 'after: wanted'),
        (invert_block, (np.ones((4, 2)), 2, np.zeros((0, 2)), np.zeros((2, 2))), 'place: wanted'),
        (invert_block, (np.ones((4, 2)), -1, np.zeros((2, 2)), np.zeros((2, 2))), 'place: wan'),
        (invert_block, (np.ones((4, 2)), 1, np.zeros((0, 2)), np.zeros((2, 3))), 'result: wan'),
        (invert_block, (np.ones((4, 2)), 1, np.zeros((0, 0)), np.zeros((0, 0))), 'columns: wan'),
        (invert_block, (np.ones((5, 2)), 1, np.zeros((0, 2)), np.zeros((2, 2))), 'columns: wan'),
    ],
)
def test_what_does_not_fit_is_refused(function, arguments, text):
    with pytest.raises((ValueError, TypeError), match=text):
        function(*arguments)


def test_nothing_comes_of_nothing():
    add_diagonal(np.zeros((0, 2)), np.zeros((0, 2, 2)), 2)
    add_band_product(np.zeros((3, 0)), np.ones((1, 3)), np.zeros((1, 3)))
    fill_lower(np.zeros((2, 0)), np.ones((0, 2, 2)))
    hold(np.zeros((0, 1)), np.array([], np.int64))
    assert factorise_band(np.zeros((0, 2))) == 0
    solve_band_lower(np.ones((3, 2)), np.zeros((0, 3)))
