"""Errors and calibration of pose mixtures with synthetic truth."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hmt_ros.body import load_body
from hmt_ros.evaluation.pose_scores import (
    EVALUATED_JOINTS,
    HIPS,
    JointMixture,
    Scores,
    joint_mixtures,
    origin_joints,
    relative_positions,
    score,
)
from hmt_ros.inference import GaussianMixture


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


def pose_mixtures(body, count, seed=0, k=3, spread=0.05):
    """Mixtures around random poses, with correlated covariances."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(count):
        means = np.clip(rng.normal(0, 0.3, (k, body.dimension)), body.lower, body.upper)
        means[:, :3] = [0.1, 0.2, 4.0]
        root = spread * rng.normal(size=(k, body.dimension, body.dimension))
        root /= np.sqrt(body.dimension)
        covariances = root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(body.dimension)
        result.append(GaussianMixture(rng.dirichlet(np.ones(k)), means, covariances))
    return result


def test_errors_by_hand():
    joints = np.zeros((3, 2, 3))
    joints[0, 0, 0], joints[1, 1, 2] = 0.3, -0.1
    joints[2] = [[0.03, 0.04, 0.0], [0.0, 0.0, 0.0]]
    mixture = JointMixture(np.array([0.5, 0.3, 0.2]), joints)
    result = score([mixture], np.zeros((1, 2, 3)), ['a', 'b'])
    assert np.allclose(result.heaviest, [[0.3, 0.0]])
    assert np.allclose(result.best, [[0.05, 0.0]])
    assert np.allclose(result.expected, [[0.5 * 0.3 + 0.2 * 0.05, 0.3 * 0.1]])
    summary = result.summary()
    assert summary['heaviest_mm'] == pytest.approx(150)
    assert summary['best_mm'] == pytest.approx(25)
    assert summary['expected_mm'] == pytest.approx((160 + 30) / 2)
    assert summary['frames_lost'] == 0
    assert summary['modes'] == 3
    weights = mixture.weights
    assert summary['perplexity'] == pytest.approx(np.exp(-(weights * np.log(weights)).sum()))
    assert summary['negative_log_likelihood'] is None
    assert summary['coverage_90'] is None
    assert summary['by_joint']['a']['best_mm'] == pytest.approx(50)
    assert summary['by_joint']['a']['coverage_90'] is None


def test_frames_whose_best_component_is_far_off_are_lost():
    joints = np.full((1, 1, 3), [0.0, 0.0, 0.16])
    mixture = JointMixture(np.ones(1), joints)
    truth = np.array([[[0.0, 0, 0]], [[0, 0, 0.05]], [[0, 0, 0.16]]])
    summary = score([mixture] * 3, truth, ['a']).summary()
    assert summary['frames_lost'] == 1
    assert summary['fraction_tracked'] == pytest.approx(2 / 3)


@pytest.mark.parametrize('origin', [('pelvis',), HIPS])
def test_linearisation_agrees_with_sampling(body, origin):
    (mixture,) = pose_mixtures(body, 1, k=1, spread=0.02)
    (result,) = joint_mixtures(body, [mixture], model_sigma=0.03, origin=origin)
    poses = mixture.sample(40_000, np.random.default_rng(1))
    joints = body.joint_positions(poses)
    which, centre = (body.skeleton.joint_index(names) for names in (EVALUATED_JOINTS, origin))
    relative = joints[:, which] - joints[:, centre].sum(1, keepdims=True) / len(origin)
    relative = relative.reshape(len(poses), -1)
    own = np.repeat(body.joint_errors[which], 3) ** 2 + 0.03**2
    seen = np.cov(relative.T) + np.diag(own)
    assert result.covariances.shape == (1, 39, 39)
    scale = np.sqrt(np.outer(np.diag(seen), np.diag(seen)))
    assert np.abs(result.covariances[0] - seen).max() < 0.02 * scale.max()
    assert np.allclose(result.joints[0].ravel(), relative.mean(0), atol=1e-3)


def test_origin_is_the_pelvis_or_the_middle_of_the_hips():
    names = ('neck', *HIPS, 'left_knee')
    assert origin_joints((*names, 'pelvis')) == ('pelvis',)
    assert origin_joints(names) == HIPS
    with pytest.raises(ValueError, match='clip has neither a pelvis nor left_hip and right_hip'):
        origin_joints(('neck', 'left_hip'), 'clip')
    positions = np.array([[0.0, 0, 0], [2, 4, 6], [4, 0, 0], [1, 1, 1]])
    found = relative_positions(positions, names, ('neck', 'left_knee'), HIPS)
    assert np.array_equal(found, [[-3, -2, -3], [-2, -1, -2]])
    with pytest.raises(ValueError, match="no joints \\['pelvis', 'tail'\\]"):
        relative_positions(positions, names, ['tail'])


def test_translation_and_a_known_pelvis_change_nothing(body):
    (mixture,) = pose_mixtures(body, 1)
    moved = GaussianMixture(
        mixture.weights, mixture.means + np.eye(body.dimension)[2] * 0.7, mixture.covariances
    )
    first, second = joint_mixtures(body, [mixture, moved])
    assert np.allclose(first.joints, second.joints)
    assert np.allclose(first.covariances, second.covariances)


def test_batches_do_not_change_the_result(body):
    mixtures = pose_mixtures(body, 70)
    together = joint_mixtures(body, mixtures)
    alone = [joint_mixtures(body, [mixture])[0] for mixture in mixtures]
    for a, b in zip(together, alone):
        assert np.allclose(a.joints, b.joints)
        assert np.allclose(a.covariances, b.covariances, rtol=1e-12)


def test_density_is_that_of_scipy(body):
    mixtures = joint_mixtures(body, pose_mixtures(body, 4))
    truth = np.array([m.joints[0] + 0.02 for m in mixtures])
    result = score(mixtures, truth)
    for t, mixture in enumerate(mixtures):
        parts = [
            np.log(w) + multivariate_normal(x.ravel(), c).logpdf(truth[t].ravel())
            for w, x, c in zip(mixture.weights, mixture.joints, mixture.covariances)
        ]
        assert result.log_densities[t] == pytest.approx(np.logaddexp.reduce(parts), rel=1e-9)
    assert result.summary()['negative_log_likelihood'] == pytest.approx(
        -result.log_densities.mean()
    )


@pytest.mark.parametrize('inflation', [1.0, 0.4, 2.5])
def test_coverage_tells_honest_mixtures_from_others(body, inflation):
    """Coverage is correct for truth drawn from the mixtures, but not for wrong widths."""
    rng = np.random.default_rng(3)
    honest = joint_mixtures(body, pose_mixtures(body, 200, spread=0.1))
    truth = np.array([m.density().sample(1, rng)[0].reshape(-1, 3) for m in honest])
    said = [JointMixture(m.weights, m.joints, inflation**2 * m.covariances) for m in honest]
    summary = score(said, truth, samples=200).summary()
    error = np.sqrt(0.25 / len(truth))
    if inflation == 1.0:
        assert abs(summary['coverage_50'] - 0.5) < 3 * error
        assert abs(summary['coverage_90'] - 0.9) < 3 * 0.6 * error
        assert abs(summary['joint_coverage_50'] - 0.5) < 2 * error
        assert abs(summary['joint_coverage_90'] - 0.9) < 2 * error
        assert summary['calibration_error'] < 2 * error
    elif inflation < 1:
        assert summary['coverage_90'] < 0.05
        assert summary['joint_coverage_90'] < 0.5
    else:
        assert summary['coverage_50'] > 0.95
        assert summary['joint_coverage_50'] > 0.8


def test_the_same_seed_gives_the_same_numbers(body):
    mixtures = joint_mixtures(body, pose_mixtures(body, 5))
    truth = np.array([m.joints[1] for m in mixtures])
    first, again, other = (score(mixtures, truth, seed=s) for s in (0, 0, 1))
    assert np.array_equal(first.joint_levels, again.joint_levels)
    assert not np.array_equal(first.joint_levels, other.joint_levels)


def test_concatenated_scores(body):
    mixtures = joint_mixtures(body, pose_mixtures(body, 5))
    truth = np.array([m.joints[1] for m in mixtures])
    rng = np.random.default_rng(0)
    parts = [score(mixtures[:2], truth[:2], seed=rng), score(mixtures[2:], truth[2:], seed=rng)]
    whole = score(mixtures, truth, seed=0)
    joined = Scores.concatenate(parts)
    assert len(joined) == 5
    assert np.array_equal(joined.joint_levels, whole.joint_levels)
    bare = score([JointMixture(m.weights, m.joints) for m in mixtures[:2]], truth[:2])
    assert Scores.concatenate([bare, parts[1]]).levels is None


def test_shapes_that_do_not_fit_are_refused(body):
    with pytest.raises(ValueError, match='joints must be finite'):
        JointMixture(np.ones(1), np.full((1, 2, 3), np.nan))
    with pytest.raises(ValueError, match='covariances'):
        JointMixture(np.ones(1), np.zeros((1, 2, 3)), np.zeros((1, 5, 5)))
    with pytest.raises(ValueError, match='wanted'):
        score([], np.zeros((0, 13, 3)))
    with pytest.raises(KeyError, match='tail'):
        joint_mixtures(body, pose_mixtures(body, 1), ['tail'])
