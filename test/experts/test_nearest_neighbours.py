"""Weighted nearest neighbours against a brute-force search."""

import numpy as np
import pytest

from hmt_ros.experts import NearestNeighbours


def test_weights_are_inverse_distances(branch_pairs):
    inputs, targets = branch_pairs
    model = NearestNeighbours(4).fit(inputs, targets)
    query = inputs[:3] + 0.1
    scale = inputs.std(0)
    for point, mixture in zip(query, model.predict(query), strict=True):
        distance = np.linalg.norm((inputs - point) / scale, axis=1)
        nearest = np.argsort(distance)[:4]
        expected = 1.0 / distance[nearest]
        np.testing.assert_allclose(mixture.weights, expected / expected.sum(), atol=1e-10)
        np.testing.assert_array_equal(mixture.means, targets[nearest])


def test_a_training_input_has_its_own_target(branch_pairs):
    inputs, targets = branch_pairs
    weights, means, _ = NearestNeighbours().fit(inputs, targets).predict_arrays(inputs)
    assert weights[:, 0].min() > 0.9
    np.testing.assert_array_equal(means[:, 0], targets)


def test_noise_is_what_neighbours_lack(branch_pairs):
    inputs, targets = branch_pairs
    z = inputs / inputs.std(0)
    distance = np.linalg.norm(z[:, None] - z, axis=2)
    np.fill_diagonal(distance, np.inf)
    index = np.argsort(distance, axis=1)[:, :2]
    near = np.take_along_axis(distance, index, 1)
    share = (1 / near) / (1 / near).sum(1, keepdims=True) / len(z)
    lack = targets[:, None] - targets[index]
    expected = np.einsum('nk,nki,nkj->ij', share, lack, lack)
    model = NearestNeighbours(2).fit(inputs, targets)
    np.testing.assert_allclose(model.noise_, expected, rtol=1e-4, atol=1e-5)


def test_support_and_jacobians(branch_pairs):
    inputs, targets = branch_pairs
    model = NearestNeighbours().fit(inputs, targets)
    near, far = model.support(np.vstack([inputs[:1], inputs[:1] + 1e3]))
    assert near == pytest.approx(1.0)
    assert far == 0.0
    assert not model.jacobians(inputs[:2]).any()
    assert model.jacobians(inputs[:2]).shape == (2, 5, 3, 6)


def test_bad_input_is_named(branch_pairs):
    inputs, targets = branch_pairs
    with pytest.raises(ValueError, match='4 samples, wanted at least 6'):
        NearestNeighbours(5).fit(inputs[:4], targets[:4])
    with pytest.raises(ValueError, match='n_neighbours is 0'):
        NearestNeighbours(0).fit(inputs, targets)
