"""Calibration on held-out groups: its effects, invariants and files."""

from pathlib import Path

import numpy as np
import pytest

from hmt_learning.training.calibration_learning import LearningCalibration, calibration, folds_of
from hmt_ros.body.learned_file import nested
from hmt_ros.experts import ConditionalExperts, JointExperts, NearestNeighbours
from hmt_ros.experts.calibrated_experts import CalibratedExperts, Calibration
from hmt_ros.experts.conditional_density import Components

GROUPS, EACH = 12, 40


def grouped(seed: int, spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Targets on a line plus an offset shared by all samples of a group."""
    rng = np.random.default_rng(seed)
    groups = np.repeat(np.arange(GROUPS), EACH)
    places = np.linspace(-3.0, 3.0, GROUPS)[rng.permutation(GROUPS)]
    inputs = places[groups, None] + 0.1 * rng.normal(size=(len(groups), 1))
    offsets = spread * rng.normal(size=(GROUPS, 2))[groups]
    targets = np.c_[inputs, -inputs] + offsets + 0.05 * rng.normal(size=(len(groups), 2))
    return inputs, targets, groups


def test_what_motions_left_out_add() -> None:
    inputs, targets, groups = grouped(0, 0.5)
    model = LearningCalibration(NearestNeighbours(3))
    # Neighbours of the same group reveal its offset, so the plain model is overconfident.
    plain = NearestNeighbours(3).fit(inputs, targets)
    assert np.sqrt(np.trace(plain.noise_)) < 0.25
    model.fit(inputs, targets, groups=groups)
    found = np.sqrt(np.trace(model.calibration_.added))
    assert 0.5 < found < 2.0
    new_inputs, new_targets, _ = grouped(1, 0.5)
    before = plain.log_density(new_inputs, new_targets).mean()
    assert model.log_density(new_inputs, new_targets).mean() > before + 2.0


def test_one_expert_gets_the_covariance_that_was_missing() -> None:
    rng = np.random.default_rng(2)
    true = np.array([[2.0, 0.6], [0.6, 1.0]])
    targets = rng.multivariate_normal([0.0, 0.0], true, size=4000)
    zeros = np.zeros((4000, 1))
    claimed = Components(zeros, np.zeros((4000, 1, 2)), np.ones((4000, 1)), 0.1 * np.eye(2)[None])
    found = calibration([(claimed, targets)])
    np.testing.assert_allclose(
        found.factor * (found.added + 0.1 * np.eye(2)), true, rtol=0.1, atol=0.08
    )
    assert found.factor == pytest.approx(1.0, abs=0.06)


def test_gates_that_are_right_by_chance_are_softened() -> None:
    rng = np.random.default_rng(3)
    count = 1000
    branch, sign = rng.integers(0, 2, count), rng.integers(0, 2, count)
    targets = (4.0 * branch - 2.0)[:, None] + 0.3 * rng.normal(size=(count, 1))
    means = np.broadcast_to(np.array([[-2.0], [2.0]]), (count, 2, 1))
    sure = np.where(sign[:, None] == np.arange(2), 0.0, -12.0)  # says nothing of the branch
    noise = 0.09 * np.ones((2, 1, 1))
    found = calibration([(Components(sure, means, np.ones((count, 2)), noise), targets)])
    assert found.temperature == 6.0
    weights = np.exp(found.of(Components(sure, means, np.ones((count, 2)), noise)).log_weights)
    np.testing.assert_allclose(weights.sum(1), 1.0)
    assert weights.min() > 0.1


def test_means_stay_as_they_are() -> None:
    inputs, targets, groups = grouped(4, 0.2)
    model = LearningCalibration(JointExperts(2, 'linear')).fit(inputs, targets, groups=groups)
    plain = JointExperts(2, 'linear').fit(inputs, targets)
    np.testing.assert_array_equal(
        model.components(inputs[:9]).means, plain.components(inputs[:9]).means
    )
    np.testing.assert_array_equal(model.jacobians(inputs[:9]), plain.jacobians(inputs[:9]))
    np.testing.assert_array_equal(model.support(inputs[:9]), plain.support(inputs[:9]))


def test_a_file_brings_it_back(tmp_path: Path) -> None:
    inputs, targets, groups = grouped(5, 0.2)
    model = LearningCalibration(ConditionalExperts(1), folds=2)
    model.fit(inputs, targets, groups=groups)
    again = CalibratedExperts.load(model.save(tmp_path / 'model'))
    assert again.folds == 2
    np.testing.assert_allclose(
        again.log_density(inputs, targets), model.log_density(inputs, targets), rtol=1e-9
    )
    with pytest.raises(ValueError, match="it is none of kind 'joint_experts'"):
        JointExperts.load(tmp_path / 'model.npz')


def test_folds_leave_whole_groups_out() -> None:
    groups = np.repeat([7, 3, 5, 9, 1, 8], 4)
    folds = folds_of(groups, 3)
    assert all(len(set(folds[groups == name])) == 1 for name in np.unique(groups))
    assert set(folds) == {0, 1, 2}
    assert set(folds_of(np.array([0, 0, 1]), 3)) == {0, 1}


def test_bad_input() -> None:
    inputs, targets, groups = grouped(6, 0.2)
    model = LearningCalibration(NearestNeighbours(3))
    with pytest.raises(ValueError, match='one group only'):
        model.fit(inputs, targets, groups=np.zeros(len(inputs)))
    with pytest.raises(ValueError, match='groups have shape'):
        model.fit(inputs, targets, groups=groups[:-1])
    with pytest.raises(ValueError, match='folds is 1'):
        LearningCalibration(NearestNeighbours(3), folds=1).fit(inputs, targets)
    with pytest.raises(ValueError, match='has not learned'):
        LearningCalibration(NearestNeighbours(3)).components(inputs)
    with pytest.raises(ValueError, match='temperature must be at least 1'):
        Calibration(0.5, np.zeros((2, 2)), 1.0)


def test_files_that_nest_calibrated_models_are_refused() -> None:
    inputs, targets, groups = grouped(7, 0.2)
    arrays = (
        LearningCalibration(NearestNeighbours(3)).fit(inputs, targets, groups=groups).to_arrays()
    )
    own = {name: value for name, value in arrays.items() if not name.startswith('model/')}
    with pytest.raises(ValueError, match='calibrated model inside a calibrated model'):
        CalibratedExperts.from_arrays(own | nested('model', arrays))
