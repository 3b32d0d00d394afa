"""Mixtures of experts: likelihood, bound, oracles, files, bad input."""

import numpy as np
import pytest
from scipy.stats import chi2

from hmt_ros.experts import ConditionalExperts, JointExperts
from test.oracles.branching import true_log_density

MODELS = [
    ConditionalExperts(3, n_starts=2),
    JointExperts(3, n_starts=2),
    ConditionalExperts(1),
    ConditionalExperts(3, 'linear', n_starts=2),
    JointExperts(3, 'linear', n_starts=2),
]
NAMES = ['conditional', 'joint', 'one', 'conditional_linear', 'joint_linear']


def fresh(model, **parameters):
    return type(model)(**(model.get_params() | parameters))


@pytest.fixture(scope='module')
def learned(branch_pairs):
    return {
        name: fresh(model).fit(*branch_pairs) for name, model in zip(NAMES, MODELS, strict=True)
    }


@pytest.mark.parametrize(('model', 'least'), [(ConditionalExperts, 1.0), (JointExperts, 1.0)])
def test_three_experts_follow_three_branches(model, least, toy_pairs, toy_test):
    found = model(3, n_starts=2).fit(*toy_pairs)
    assert found.log_density(*toy_test).mean() > least
    gates, means, _ = found.predict_arrays(np.array([[0.5], [-0.05], [1.05]]))
    assert (gates[0] > 0.1).all()
    np.testing.assert_allclose(np.sort(means[0, :, 0]), [0.21, 0.5, 0.79], atol=0.03)
    # With one branch, one gate has all the weight.
    assert gates[1].max() > 0.95
    assert gates[2].max() > 0.95
    assert gates[1].argmax() != gates[2].argmax()


@pytest.mark.parametrize('model', [ConditionalExperts, JointExperts])
def test_five_experts_are_better_than_three(model, toy_pairs, toy_test):
    assert model(5, n_starts=2).fit(*toy_pairs).log_density(*toy_test).mean() > 1.08


def test_one_regression_averages_the_branches(toy_pairs, toy_test):
    found = ConditionalExperts(1).fit(*toy_pairs)
    assert 0.1 < found.log_density(*toy_test).mean() < 0.25


@pytest.mark.parametrize('model', MODELS, ids=NAMES)
def test_bound_rises_iteration_by_iteration(model, toy_pairs):
    found = fresh(model, tolerance=0.0, max_iterations=40, width=0.7).fit(*toy_pairs)
    assert len(found.bound_) > 1
    assert np.diff(found.bound_).min() > -1e-7


@pytest.mark.parametrize('name', NAMES)
def test_log_density_is_that_of_the_predicted_mixture(learned, branch_pairs, name):
    inputs, targets = (part[:20] for part in branch_pairs)
    expected = [
        mixture.log_density(x[None])[0]
        for mixture, x in zip(learned[name].predict(inputs), targets, strict=True)
    ]
    np.testing.assert_allclose(learned[name].log_density(inputs, targets), expected, atol=1e-9)
    weights, _, _ = learned[name].predict_arrays(inputs)
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-12)


@pytest.mark.parametrize('name', NAMES)
def test_jacobians_are_central_differences(learned, branch_pairs, name):
    model, inputs = learned[name], branch_pairs[0][:6]
    numeric = np.stack(
        [
            (model.predict_arrays(inputs + e)[1] - model.predict_arrays(inputs - e)[1]) / 2e-5
            for e in 1e-5 * np.eye(inputs.shape[1])
        ],
        axis=3,
    )
    np.testing.assert_allclose(model.jacobians(inputs), numeric, atol=1e-6)


@pytest.mark.parametrize('name', NAMES)
def test_file_keeps_every_prediction(learned, branch_pairs, name, tmp_path):
    model, inputs = learned[name], branch_pairs[0][:9]
    path = model.save(tmp_path / 'model')
    again = type(model).load(path)
    for a, b in zip(model.predict_arrays(inputs), again.predict_arrays(inputs), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(model.jacobians(inputs), again.jacobians(inputs))
    np.testing.assert_array_equal(model.support(inputs), again.support(inputs))
    assert again.get_params() == model.get_params()


def test_same_seed_same_model(branch_pairs):
    a, b = (
        ConditionalExperts(3, seed=5, n_starts=2, width=1.0).fit(*branch_pairs) for _ in range(2)
    )
    for one, other in zip(
        a.predict_arrays(branch_pairs[0]), b.predict_arrays(branch_pairs[0]), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('name', ['conditional', 'joint'])
def test_regions_cover_new_samples(learned, name, make_branches):
    """The 90 % region of the nearest expert contains 80 to 97 % of new targets."""
    inputs, targets = make_branches(1000, 2)
    _, means, covariances = learned[name].predict_arrays(inputs)
    offsets = targets[:, None] - means
    square = np.einsum('nki,nkij,nkj->nk', offsets, np.linalg.inv(covariances), offsets)
    assert 0.80 < (square.min(1) < chi2.ppf(0.9, targets.shape[1])).mean() < 0.97


def test_support_vanishes_far_from_the_data(learned, branch_pairs):
    for name in NAMES:
        near, far = learned[name].support(np.vstack([branch_pairs[0][:1], 1e3 * np.ones((1, 6))]))
        assert near > 0.3
        assert far < 1e-6


# ---- hard cases


def test_empty_experts_are_pruned():
    rng = np.random.default_rng(0)
    inputs = np.repeat(rng.normal(size=(2, 2)), 20, axis=0)
    targets = np.repeat(rng.normal(size=(2, 1)), 20, axis=0) + 0.01 * rng.normal(size=(40, 1))
    for model in (ConditionalExperts, JointExperts):
        found = model(8, n_starts=2).fit(inputs, targets)
        assert 1 <= found.n_experts_ < 8
        assert np.isfinite(found.log_density(inputs, targets)).all()


def test_constant_columns_and_repeated_samples_are_learned():
    rng = np.random.default_rng(0)
    inputs = np.c_[rng.normal(size=30), np.full(30, 3.0)]
    targets = np.c_[np.sin(inputs[:, 0]), np.full(30, -7.0)]
    inputs, targets = np.repeat(inputs, 3, axis=0), np.repeat(targets, 3, axis=0)
    for model in MODELS:
        found = fresh(model).fit(inputs, targets)
        assert np.isfinite(found.log_density(inputs, targets)).all()
        np.testing.assert_allclose(found.predict_arrays(inputs)[1][..., 1], -7.0, atol=1e-6)


def test_as_many_samples_as_experts_are_enough():
    inputs = np.array([[0.0], [1.0], [2.0]])
    for model in (ConditionalExperts, JointExperts):
        found = model(3).fit(inputs, inputs**2)
        assert np.isfinite(found.log_density(inputs, inputs**2)).all()


@pytest.mark.parametrize('model', MODELS, ids=NAMES)
def test_bad_data_are_named(model, branch_pairs):
    inputs, targets = branch_pairs
    broken = targets.copy()
    broken[7, 1] = np.nan
    with pytest.raises(ValueError, match=r'targets have 1 values that are not finite.*row 7'):
        fresh(model).fit(inputs, broken)
    with pytest.raises(ValueError, match='300 inputs and 299 targets'):
        fresh(model).fit(inputs, targets[:-1])
    with pytest.raises(ValueError, match=r'inputs have shape \(300,\), wanted \(N, p\)'):
        fresh(model).fit(inputs[:, 0], targets)
    with pytest.raises(ValueError, match='negative or not finite'):
        fresh(model).fit(inputs, targets, -np.ones(300))
    with pytest.raises(ValueError, match='has not learned yet; call fit first'):
        fresh(model).predict(inputs)
    found = fresh(model, max_iterations=1).fit(inputs, targets)
    with pytest.raises(ValueError, match='inputs have 4 columns, wanted 6'):
        found.predict(inputs[:, :4])
    with pytest.raises(ValueError, match='one row for each input'):
        found.log_density(inputs, targets[:, :2])


def test_fewer_samples_than_experts_are_named():
    with pytest.raises(ValueError, match=r'3 samples, wanted at least 5 \(one an expert\)'):
        ConditionalExperts(5).fit(np.zeros((3, 2)), np.zeros((3, 2)))


@pytest.mark.parametrize(
    ('parameters', 'message'),
    [
        ({'basis': 'cubic'}, "basis is 'cubic'"),
        ({'scaling': 'no'}, "scaling is 'no'"),
        ({'n_experts': 0}, 'n_experts is 0'),
        ({'width': 0.0}, 'width is 0.0'),
    ],
)
def test_bad_parameters_are_named(parameters, message, branch_pairs):
    with pytest.raises(ValueError, match=message):
        JointExperts(**parameters).fit(*branch_pairs)
    with pytest.raises(ValueError, match="no parameter 'n_expert'"):
        JointExperts().set_params(n_expert=3)


def test_experts_come_near_the_truth_of_the_toy(toy_pairs, toy_test):
    """log p(y | x) in nats is 1.23 for the truth and 0.18 for one regression."""
    assert true_log_density(*toy_test).mean() == pytest.approx(1.227, abs=0.03)
    for model in (ConditionalExperts, JointExperts):
        found = model(3, seed=0).fit(*toy_pairs)
        assert found.log_density(*toy_test).mean() > 1.0
        # If the toy has one branch, its experts have the weight.
        weights, means, _ = found.predict_arrays(np.array([[-0.05], [0.0], [1.0], [1.05]]))
        heaviest = means[np.arange(4), weights.argmax(1)]
        near = np.abs(means - heaviest[:, None])[:, :, 0] < 0.15
        assert (weights * near).sum(1).mean() > 0.9
    one = ConditionalExperts(1, seed=0).fit(*toy_pairs)
    assert one.log_density(*toy_test).mean() < 0.3
