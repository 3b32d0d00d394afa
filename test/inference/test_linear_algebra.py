"""Linear algebra in a fixed order: numpy's results, and its errors."""

import numpy as np
import pytest

from hmt_ros.inference import linear_algebra

SIZES = [1, 2, 3, 7, 8, 9, 38, 70]


@pytest.fixture(params=SIZES)
def matrices(request):
    """Matrices (2, 3, n, n), positive definite ones, and right sides (2, 3, n, 5)."""
    n = request.param
    rng = np.random.default_rng(n)
    some = rng.normal(size=(2, 3, n, n))
    positive = some @ some.swapaxes(-1, -2) / n + 0.1 * np.eye(n)
    return some, positive, rng.normal(size=(2, 3, n, 5))


def close(saw, wanted, size=1.0):
    np.testing.assert_allclose(saw, wanted, rtol=1e-9, atol=1e-12 * size)


def test_factors_and_solutions_are_those_of_numpy(matrices):
    some, positive, right = matrices
    factor = linear_algebra.cholesky(positive)
    close(factor, np.linalg.cholesky(positive))
    close(linear_algebra.cholesky(np.tril(positive)), factor)
    close(linear_algebra.solve(some, some @ right), right, 1e3)
    close(
        linear_algebra.solve(positive, right[0, 0, :, 0]),
        np.linalg.solve(positive, right[0, 0, :, :1])[..., 0],
    )
    close(factor @ linear_algebra.solve_triangular(factor, right), right)
    upper = factor.swapaxes(-1, -2)
    close(upper @ linear_algebra.solve_triangular(factor, right, transposed=True), right)
    close(upper @ linear_algebra.solve_triangular(upper, right, lower=False), right)
    close(linear_algebra.inverse(positive), np.linalg.inv(positive))
    close(linear_algebra.inverse_triangular(factor), np.linalg.inv(factor))
    close(linear_algebra.log_determinant(some), np.linalg.slogdet(some)[1])
    close(linear_algebra.determinant(some) / np.linalg.det(some), 1.0)


def test_eigenvalues_and_singular_values_are_those_of_numpy(matrices):
    some, positive, right = matrices
    for each in (positive, some + some.swapaxes(-1, -2), np.zeros_like(some), positive * 1e-300):
        size = max(np.abs(each).max(), 1e-300)
        values, vectors = linear_algebra.symmetric_eigen(each)
        close(values / size, np.linalg.eigvalsh(each) / size)
        close((vectors * values[..., None, :]) @ vectors.swapaxes(-1, -2) / size, each / size)
        close(
            vectors.swapaxes(-1, -2) @ vectors, np.broadcast_to(np.eye(some.shape[-1]), some.shape)
        )
        np.testing.assert_array_equal(linear_algebra.symmetric_eigenvalues(each), values)
    for each in (some, right, right.swapaxes(-1, -2)):
        u, values, vt = linear_algebra.singular_values(each)
        close(values, np.linalg.svd(each, compute_uv=False))
        close((u * values[..., None, :]) @ vt, each)
        close(linear_algebra.pseudo_inverse(each), np.linalg.pinv(each), 1e3)
    flat = np.ones((4, 3))
    close(linear_algebra.pseudo_inverse(flat, 1e-12), np.linalg.pinv(flat))


@pytest.mark.parametrize('dtype', [np.float64, np.float32])
@pytest.mark.parametrize('rows', [1, 2, 5, 13])
@pytest.mark.parametrize('columns', [1, 3, 8, 21, 70])
def test_products_are_those_of_numpy_in_every_layout(rows, columns, dtype):
    rng = np.random.default_rng(0)
    a = rng.normal(size=(4, rows, 19)).astype(dtype)
    b = rng.normal(size=(19, columns)).astype(dtype)
    found = linear_algebra.product(a, b)
    assert found.dtype == dtype
    size = np.finfo(dtype).eps
    np.testing.assert_allclose(found, a @ b, rtol=0.0, atol=100 * size)
    for left in (a, np.asfortranarray(a), np.repeat(a, 2, axis=2)[..., ::2], a[:, ::-1][:, ::-1]):
        for right in (b, np.asfortranarray(b), np.repeat(b, 3, axis=1)[:, ::3]):
            np.testing.assert_array_equal(linear_algebra.product(left, right), found)
    np.testing.assert_allclose(linear_algebra.product(a, b[:, 0]), a @ b[:, 0], atol=100 * size)
    np.testing.assert_array_equal(linear_algebra.product(a[0, 0], b), found[0, 0])
    alone = linear_algebra.product(a[0, 0], b[:, 0])
    np.testing.assert_allclose(alone, a[0, 0] @ b[:, 0], atol=100 * size)


def test_sums_keep_their_order():
    # In another order the ones are lost, or the large numbers do not cancel.
    a = np.array([[1e17, 1.0, -1e17, 1.0]])
    assert linear_algebra.product(a, np.ones((4, 2))).tolist() == [[1.0, 1.0]]


def test_a_matrix_without_a_result_is_an_error():
    fails = pytest.raises(np.linalg.LinAlgError)
    one, none = np.eye(3), np.zeros((3, 3))
    for bad in (-one, none, np.full((3, 3), np.nan), np.stack([one, -one])):
        with fails:
            linear_algebra.cholesky(bad)
    for bad in (none, np.ones((3, 3)), np.stack([one, none])):
        with fails:
            linear_algebra.inverse(bad)
        with fails:
            linear_algebra.solve(bad, np.ones(3))
    with fails:
        linear_algebra.solve_triangular(none, np.ones(3))
    for bad in (np.nan, np.inf):
        with fails:
            linear_algebra.symmetric_eigen(np.full((3, 3), bad))
        with fails:
            linear_algebra.singular_values(np.full((3, 2), bad))
    assert np.isnan(linear_algebra.inverse(np.full((3, 3), np.nan))).all()
    assert linear_algebra.log_determinant(none) == -np.inf
    assert linear_algebra.determinant(none) == 0.0


def test_shapes_that_do_not_fit_are_errors_and_empty_ones_are_not():
    with pytest.raises(ValueError, match='cholesky'):
        linear_algebra.cholesky(np.ones((3, 4)))
    with pytest.raises(ValueError, match='inverse'):
        linear_algebra.inverse(np.ones(3))
    with pytest.raises(ValueError, match='solve'):
        linear_algebra.solve(np.eye(3), np.ones((4, 1)))
    with pytest.raises(ValueError, match='product'):
        linear_algebra.product(np.ones((2, 3)), np.ones((2, 3)))
    with pytest.raises(TypeError, match='inverse'):
        linear_algebra.inverse(np.eye(3) * 1j)
    assert linear_algebra.cholesky(np.zeros((0, 3, 3))).shape == (0, 3, 3)
    assert linear_algebra.inverse(np.zeros((2, 0, 0))).shape == (2, 0, 0)
    assert linear_algebra.symmetric_eigen(np.zeros((2, 0, 0)))[1].shape == (2, 0, 0)
    assert linear_algebra.product(np.zeros((2, 0)), np.zeros((0, 3))).tolist() == [[0.0] * 3] * 2


def test_distances_are_those_of_numpy():
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(5, 1, 7, 3)), rng.normal(size=(4, 7, 3))
    wanted = np.linalg.norm(one - other, axis=-1).mean(-1)
    np.testing.assert_allclose(linear_algebra.mean_distances(one, other), wanted, rtol=1e-14)
    flat = other.reshape(4, -1)
    wanted = np.linalg.norm(flat[:, None] - flat, axis=-1)
    np.testing.assert_allclose(linear_algebra.distances(flat), wanted, rtol=1e-14)
    assert (np.diagonal(linear_algebra.distances(flat)) == 0.0).all()
    assert np.isnan(linear_algebra.distances(np.full((2, 3), np.nan))[0, 1])
    with pytest.raises(ValueError, match='dimension'):
        linear_algebra.mean_distances(one, other[:, :6])
