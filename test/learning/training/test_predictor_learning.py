import numpy as np
import pytest

from hmt_learning.training.predictor_learning import (
    KINDS,
    affinities,
    new_model,
    target_basis,
)
from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.body import load_body
from hmt_ros.experts import CalibratedExperts
from hmt_ros.experts.pose_encoding import PoseEncoding


def test_models_by_name():
    for name in KINDS:
        assert isinstance(new_model(name), CalibratedExperts)
    few = new_model('joint', samples=200)
    assert isinstance(few, CalibratedExperts)
    assert few.model.get_params()['n_experts'] == 5
    with pytest.raises(ValueError, match="no model 'forest'"):
        new_model('forest')


def test_affinities():
    vectors = np.random.default_rng(0).normal(size=(20, 3))
    found = affinities(vectors)
    np.testing.assert_allclose(found, found.T)
    np.testing.assert_allclose(np.diag(found), 1.0)
    off = found[~np.eye(20, dtype=bool)]
    assert np.median(off) == pytest.approx(np.exp(-0.5), rel=0.05)


def test_the_metric_of_targets_is_that_of_joints():
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
