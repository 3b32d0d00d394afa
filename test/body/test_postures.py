"""Limbs without evidence spread over usual postures, and the others keep their poses."""

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.mirror import mirror_order
from hmt_ros.body.postures import PREDICTION_SHARE, postures_of
from hmt_ros.inference.mixture import GaussianMixture


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def modes(body):
    """Two poses of a person who stands, 3 m away."""
    poses = np.tile(body.prior_mean, (2, 1))
    poses[:, 2] = 3.0
    poses[1, body.dof_names.index('left_elbow')] += 0.6
    return GaussianMixture(np.array([0.7, 0.3]), poses, np.tile(1e-3 * np.eye(37), (2, 1, 1)))


def times(body, words, seconds=np.inf):
    return np.array([seconds if any(x in y for x in words) else 0.0 for y in body.dof_names])


LEGS = ('hip_', 'knee', 'ankle')


def test_the_table_has_a_mirror_image_of_every_posture_and_shares_of_all(body):
    postures = postures_of(body)
    order, signs = mirror_order(body.skeleton)
    assert postures.shares.sum() == pytest.approx(1.0)
    for mean, share in zip(postures.means, postures.shares, strict=True):
        image = np.abs(postures.means - mean[order] * signs).max(1)
        assert postures.shares[image.argmin()] == share
        assert image.min() < 1e-12
    assert (postures.means >= body.lower)[:, 3:].all()
    assert (postures.means <= body.upper)[:, 3:].all()


def test_legs_that_nothing_ever_showed_are_the_modes_or_those_of_the_table(body, modes):
    postures, unseen = postures_of(body), times(body, LEGS)
    spread, rows, which = postures.spread(modes, unseen)
    legs = unseen > 0
    # The heavier mode has a component in every posture; shares do not depend on the pose.
    own = spread[(rows == 0) & (which > 0)].normalised()
    table = which[(rows == 0) & (which > 0)] - 1
    assert sorted(table) == list(range(len(postures.shares)))
    assert own.weights == pytest.approx(postures.shares[table])
    assert own.mean()[legs] == pytest.approx(postures.shares @ postures.means[:, legs])
    whole = GaussianMixture(
        postures.shares, postures.means[:, legs],
        np.array([np.diag(s**2) for s in postures.sigmas[:, legs]]),
    )  # fmt: skip
    assert own.covariance()[np.ix_(legs, legs)] == pytest.approx(whole.covariance())
    # Visible limbs are unchanged and not correlated with the unseen ones.
    assert spread.means[:, ~legs] == pytest.approx(modes.means[rows][:, ~legs])
    assert (spread.covariances[:, ~legs][:, :, legs] == 0.0).all()
    assert np.bincount(rows, spread.weights) == pytest.approx([0.7, 0.3])
    assert (np.diff(spread.weights) <= 0.0).all()
    # The mode itself remains one of the components.
    for k in range(2):
        (mine,) = np.flatnonzero((rows == k) & (which == 0))
        assert spread.means[mine] == pytest.approx(modes.means[k])
        assert spread.weights[mine] == pytest.approx(PREDICTION_SHARE * modes.weights[k], rel=0.1)


def test_a_pelvis_that_nothing_shows_turns_below_shoulders_that_stay(body, modes):
    spread, rows, _ = postures_of(body).spread(modes, times(body, ('trunk',)))
    assert sorted(rows.tolist()) == [0, 0, 1, 1]
    jacobians = body.joint_jacobians(spread.means)
    more = spread.covariances - modes.covariances[rows]
    deviations = np.sqrt(np.abs(np.einsum('kjai,kim,kjam->kj', jacobians, more, jacobians)))
    of = dict(zip(body.joint_names, deviations[0], strict=True))
    assert max(of['neck'], of['left_shoulder']) < 0.03
    assert of['left_ankle'] > 0.15


def test_knees_that_are_seen_tell_who_sits(body, modes):
    postures = postures_of(body)
    sitting = int(postures.means[:, body.dof_names.index('left_hip_x')].argmax())
    poses = modes.means.copy()
    hips = [body.dof_names.index(f'{side}_hip_x') for side in ('left', 'right')]
    poses[:, hips] = postures.means[sitting, hips]
    seated = GaussianMixture(modes.weights, poses, modes.covariances)
    spread, _, which = postures.spread(seated, times(body, ('knee', 'ankle')))
    assert spread.weights[which == sitting + 1].sum() > 0.9 * spread.weights[which > 0].sum()


@pytest.mark.parametrize(
    ('seconds', 'least', 'most'), [(1e-4, 0.03, 0.04), (0.1, 0.05, 0.2), (9.0, 0.2, 0.8)]
)
def test_what_was_seen_a_moment_ago_is_known_still(body, modes, seconds, least, most):
    knee = body.dof_names.index('left_knee')
    spread, _, _ = postures_of(body).spread(modes, times(body, ('left_knee',), seconds))
    assert least < np.sqrt(spread.covariance()[knee, knee]) < most
