"""Tracks with synthetic truth: matching by timestamp, windows, batches, errors of modes."""

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.evaluation.pose_scores import BATCH_SIZE, EVALUATED_JOINTS, HIPS, joint_mixtures, score
from hmt_ros.evaluation.track_scores import Estimate, TrackScorer, Truth, mode_errors
from hmt_ros.inference import GaussianMixture

TIMES = 2 * BATCH_SIZE + 5


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def poses(body):
    """True poses (T, d)."""
    rng = np.random.default_rng(0)
    poses = np.clip(rng.normal(0, 0.2, (TIMES, body.dimension)), body.lower, body.upper)
    poses[:, 2] = 4.0
    return poses


@pytest.fixture(scope='module')
def truth(body, poses):
    return Truth('made', body.joint_names, dict(enumerate(body.joint_positions(poses))))


def estimate(body, stamp, pose, *, covariances=True, with_body=True):
    means = pose + np.array([[0.02], [-0.05]])
    mixture = GaussianMixture([0.6, 0.4], means, np.tile(0.003 * np.eye(len(pose)), (2, 1, 1)))
    return Estimate(
        stamp,
        mixture.weights,
        mixture if covariances else None,
        body.joint_positions(means),
        body.joint_names,
        body if with_body else None,
    )


def test_batches_give_the_scores_of_all_times_together(body, poses, truth):
    scorer = TrackScorer('track', truth, seed=3)
    estimates = [estimate(body, stamp, pose) for stamp, pose in enumerate(poses)]
    for one in [*estimates, estimates[7], estimate(body, TIMES + 1, poses[0])]:
        scorer.take(one)
    found = scorer.finish()
    true = body.joint_positions(poses)
    which = body.skeleton.joint_index(EVALUATED_JOINTS)
    relative = true[:, which] - true[:, body.skeleton.joint_index(['pelvis'])]
    wanted = score(joint_mixtures(body, [one.mixture for one in estimates]), relative, seed=3)
    for name in ('heaviest', 'best', 'expected', 'log_densities', 'joint_levels'):
        assert np.allclose(getattr(found.scores, name), getattr(wanted, name), rtol=1e-12), name
    assert (found.missing, found.without_truth, found.note) == (0, 1, '')


def test_the_newest_window_counts(body, poses, truth):
    scorer = TrackScorer('track', truth)
    wrong = [estimate(body, stamp, poses[stamp] + 0.3) for stamp in range(4)]
    right = [estimate(body, stamp, poses[stamp]) for stamp in range(2, 6)]
    scorer.take_window(wrong)
    scorer.take_window(right)
    found = scorer.finish()
    errors = found.scores.heaviest.mean(1)
    assert found.missing == TIMES - 6
    assert errors[:2].min() > 2 * errors[2:].max()


@pytest.mark.parametrize(
    ('lost', 'note'), [('covariances', 'no covariances'), ('with_body', 'its body is unknown')]
)
def test_without_covariances_or_body_there_are_errors_only(body, poses, truth, lost, note):
    scorer = TrackScorer('track', truth)
    scorer.take(estimate(body, 0, poses[0], **{lost: False}))
    found = scorer.finish()
    complete = TrackScorer('track', truth)
    complete.take(estimate(body, 0, poses[0]))
    assert np.allclose(found.scores.heaviest, complete.finish().scores.heaviest)
    assert found.scores.levels is None
    assert found.note == note


@pytest.mark.parametrize('with_pelvis', [True, False])
def test_errors_of_modes_by_hand(body, poses, with_pelvis):
    """One wrist is off, and the person has moved; without a pelvis the hips are aligned."""
    names = body.joint_names if with_pelvis else body.joint_names[1:]
    assert ('pelvis' in names) == with_pelvis
    joints = body.joint_positions(poses[:1])
    truth = Truth('made', names, {5: joints[0, body.skeleton.joint_index(names)] + 0.7})
    modes = np.repeat(joints, 2, axis=0)
    modes[1, body.joint_names.index('left_wrist')] += [0.3, 0.0, 0.4]
    (found,) = mode_errors({4: modes, 5: modes}, body.joint_names, truth).values()
    assert np.allclose(found, [0.0, 0.5 / len(EVALUATED_JOINTS)], atol=1e-12)


def test_hips_that_are_off_move_the_origin(body, poses):
    """Both hips of the mode are 0.2 m off: all other joints get that error, the hips none."""
    joints = body.joint_positions(poses[:1])
    truth = Truth('made', body.joint_names[1:], {5: joints[0, 1:]})
    modes = joints.copy()
    modes[:, body.skeleton.joint_index(HIPS)] += [0.0, 0.2, 0.0]
    (found,) = mode_errors({5: modes}, body.joint_names, truth).values()
    assert np.allclose(found, 0.2 * (len(EVALUATED_JOINTS) - 2) / len(EVALUATED_JOINTS))


def test_truth_that_can_not_be_used(body, poses):
    positions = body.joint_positions(poses[:1])[0]
    with pytest.raises(ValueError, match='made has no frames'):
        Truth('made', body.joint_names, {})
    with pytest.raises(ValueError, match='joints at 3 ns are not finite'):
        Truth('made', body.joint_names, {3: np.full_like(positions, np.nan)})
    with pytest.raises(ValueError, match='wanted at least 4'):
        TrackScorer('track', Truth('made', body.joint_names[:3], {3: positions[:3]}))
    # Nobody was found: there is nothing to score.
    nobody = TrackScorer('track', Truth('made', body.joint_names, {3: positions})).finish()
    assert (len(nobody.scores), nobody.missing) == (0, 1)
