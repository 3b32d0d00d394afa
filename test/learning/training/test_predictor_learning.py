from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.training.predictor_learning import (
    KINDS,
    affinities,
    multimodality,
    new_model,
    target_basis,
)
from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.body import load_body
from hmt_ros.experts import CalibratedExperts
from hmt_ros.experts.pose_encoding import PoseEncoding


def test_models_by_name() -> None:
    for name in KINDS:
        assert isinstance(new_model(name), CalibratedExperts)
    few = new_model('joint', samples=200)
    assert isinstance(few, CalibratedExperts)
    assert few.model.get_params()['n_experts'] == 5
    with pytest.raises(ValueError, match="no model 'forest'"):
        new_model('forest')


def test_affinities() -> None:
    vectors = np.random.default_rng(0).normal(size=(20, 3))
    found = affinities(vectors)
    np.testing.assert_allclose(found, found.T)
    np.testing.assert_allclose(np.diag(found), 1.0)
    off = found[~np.eye(20, dtype=bool)]
    assert np.median(off) == pytest.approx(np.exp(-0.5), rel=0.05)


def test_multimodality_counts_branches() -> None:
    rng = np.random.default_rng(1)
    groups = np.repeat(np.arange(6), 40)
    inputs = np.stack([10.0 * groups, 0 * groups], axis=1) + 0.01 * rng.normal(size=(240, 2))
    branch = np.where(groups < 3, 0, np.arange(240) % 2)  # three groups have two poses each
    targets = np.stack([10.0 * groups, 100.0 * branch], axis=1) + 0.01 * rng.normal(size=(240, 2))
    found = multimodality(inputs, targets, 9, seed=3)
    assert len(found) >= 2
    assert found.sum() <= 9
    alone = multimodality(inputs, inputs, 6, seed=3)
    np.testing.assert_array_equal(alone, [6])
    with pytest.raises(ValueError, match='clusters'):
        multimodality(inputs, targets, 241)


def test_the_metric_of_targets_is_that_of_joints() -> None:
    body = load_body('human37')
    encoding = PoseEncoding(body)
    poses = procedural_sequence('dance', body, 3.0, 1).poses
    basis = target_basis(encoding, encoding.encode(poses))
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(20):
        other = poses.copy()
        other[:, 6:] += 0.05 * rng.normal(size=other[:, 6:].shape)
        moved = body.joint_positions(other) - body.joint_positions(poses)
        actual = (moved**2).sum((1, 2)) / (len(body.joint_names) - 1)
        guess = (((encoding.encode(other) - encoding.encode(poses)) @ basis) ** 2).sum(1)
        ratios.append(guess.mean() / actual.mean())
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
