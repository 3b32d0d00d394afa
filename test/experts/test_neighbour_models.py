"""Local experts, and weighted nearest neighbours compared with a brute-force search."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hmt_ros.experts import LocalExperts, NearestNeighbours


def two_branches(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(-1, 1, (n, 2))
    side = rng.choice([-1.0, 1.0], n)
    targets = np.stack([side * (2 + inputs[:, 0]), inputs.sum(1)], axis=1)
    return inputs, targets + 0.02 * rng.normal(size=(n, 2))


def test_each_branch_has_an_expert() -> None:
    inputs, targets = two_branches(1500, 0)
    model = LocalExperts(2, n_neighbours=30).fit(inputs, targets)
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 2))
    weights, means, covariances = model.predict_arrays(points)
    np.testing.assert_allclose(weights.sum(1), 1.0)
    np.testing.assert_allclose(weights, 0.5, atol=0.3)
    order = np.argsort(means[:, :, 0], axis=1)
    found = np.take_along_axis(means, order[..., None], axis=1)
    for k, side in enumerate((-1.0, 1.0)):
        wanted = np.stack([side * (2 + points[:, 0]), points.sum(1)], axis=1)
        assert np.abs(found[:, k] - wanted).max() < 0.12
    assert np.sqrt(np.diagonal(covariances[0, 0])).max() < 0.08


def test_the_density_of_held_out_targets() -> None:
    inputs, targets = two_branches(1500, 0)
    others = two_branches(400, 2)
    two, one = (LocalExperts(m, 30).fit(inputs, targets).log_density(*others) for m in (2, 1))
    assert two.mean() > one.mean() + 1.5


def test_jacobians_where_neighbours_stay() -> None:
    inputs, targets = two_branches(600, 3)
    model = LocalExperts(2, n_neighbours=25, width_neighbour=25).fit(inputs, targets)
    point = np.array([[0.1, -0.2]])
    found = model.jacobians(point)[0]
    h = 1e-5
    # The kernel width is fixed to that of the neighbours at the point.
    distances, index = model._neighbours(point, 25)
    width = distances[0, -1]
    _, _, shares, _ = model._modes(distances, index)

    def means(x: np.ndarray) -> np.ndarray:
        away = model._scaled[index[0]] - model._standardisation.apply(x)
        kernel = np.exp(-0.5 * (away**2).sum(1) / width**2)
        result = []
        for member in shares[0] > 0:
            w = kernel * member
            result.append(w @ model.targets_[index[0]] / w.sum())
        return np.array(result)

    for j in range(2):
        step = h * np.eye(2)[j]
        numeric = (means(point[0] + step) - means(point[0] - step)) / (2 * h)
        np.testing.assert_allclose(found[:, :, j], numeric, atol=1e-6)


def test_more_experts_than_branches_or_neighbours() -> None:
    inputs = np.arange(12.0)[:, None]
    targets = np.zeros((12, 1))
    model = LocalExperts(5, n_neighbours=3, width_neighbour=2).fit(inputs, targets)
    weights, means, _ = model.predict_arrays([[4.2]])
    np.testing.assert_allclose(weights.sum(), 1.0)
    np.testing.assert_array_equal(means, 0.0)
    assert model.log_density([[4.2]], [[0.0]])[0] > 0


def test_support_falls_away_from_the_samples() -> None:
    model = LocalExperts(2, 20).fit(*two_branches(400, 4))
    near, far = model.support([[0.0, 0.0], [30.0, 0.0]])
    assert near > 0.8
    assert far < 1e-6


def test_a_file_brings_it_back(tmp_path: Path) -> None:
    inputs, targets = two_branches(300, 5)
    model = LocalExperts(2, 20).fit(inputs, targets)
    again = LocalExperts.load(model.save(tmp_path / 'm.npz'))
    points = inputs[:40] + 0.003
    np.testing.assert_allclose(
        again.log_density(points, targets[:40]).mean(),
        model.log_density(points, targets[:40]).mean(),
        atol=0.05,
    )
    assert again.get_params() == model.get_params()


def test_inputs_one_by_one_and_together() -> None:
    inputs, targets = two_branches(300, 6)
    model = LocalExperts(3, 20).fit(inputs, targets)
    together = model.predict_arrays(inputs[:9])[1]
    alone = np.concatenate([model.predict_arrays(inputs[i : i + 1])[1] for i in range(9)])
    np.testing.assert_allclose(together, alone, atol=1e-12)


@pytest.mark.parametrize(
    ('settings', 'count', 'match'),
    [
        ({'n_neighbours': 40}, 40, 'at least 41'),
        ({'width_neighbour': 50}, 100, 'width among'),
        ({'n_experts': 0}, 100, 'n_experts 0'),
        ({'scaling': 'none'}, 100, 'scaling'),
    ],
)
def test_what_can_not_be_learned(settings: dict, count: int, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        LocalExperts(**settings).fit(*two_branches(count, 7))


def test_values_that_are_not_finite() -> None:
    inputs, targets = two_branches(100, 8)
    targets[3, 1] = np.nan
    with pytest.raises(ValueError, match='row 3'):
        LocalExperts().fit(inputs, targets)


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


def test_bad_neighbours_are_named(branch_pairs):
    inputs, targets = branch_pairs
    with pytest.raises(ValueError, match='4 samples, wanted at least 6'):
        NearestNeighbours(5).fit(inputs[:4], targets[:4])
    with pytest.raises(ValueError, match='n_neighbours is 0'):
        NearestNeighbours(0).fit(inputs, targets)
