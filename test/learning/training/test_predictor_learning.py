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


def degenerate_pairs():
    """Inputs, targets and motions with less information than their number suggests."""
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(200, 8))
    targets = np.tanh(inputs @ rng.normal(size=(8, 5)))
    quarter = np.repeat(np.arange(4), 50)
    return {
        'one motion': (inputs, targets, None),
        'copies of one motion': (
            np.tile(inputs[:20], (10, 1)), np.tile(targets[:20], (10, 1)), np.repeat(range(10), 20)
        ),
        'two poses': (
            np.repeat(inputs[:2], 100, axis=0), np.repeat(targets[:2], 100, axis=0), quarter
        ),
        'one input': (np.ones((200, 8)), targets, quarter),
        'equal columns': (np.repeat(inputs[:, :1], 8, axis=1), targets, quarter),
    }  # fmt: skip


@pytest.mark.parametrize('case', degenerate_pairs())
@pytest.mark.parametrize('name', [x for x in KINDS if x != 'network'])
def test_degenerate_pairs_are_learned(name, case):
    """Mixtures are finite and wide enough to be valid, and have no support far away."""
    inputs, targets, motions = degenerate_pairs()[case]
    model = new_model(name, samples=len(inputs)).fit(inputs, targets, groups=motions)
    far = inputs[:1] + 100.0
    weights, means, covariances = model.predict_arrays(np.concatenate([inputs[:3], far]))
    np.testing.assert_allclose(weights.sum(1), 1.0)
    assert np.isfinite(means).all()
    assert np.linalg.eigvalsh(covariances).min() > 0.0
    assert model.support(far)[0] < 1e-3
