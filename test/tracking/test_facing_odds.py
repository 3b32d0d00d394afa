"""The odds of the two ways to face."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.mirror import left_directions, reverse_depth
from hmt_ros.tracking.facing_odds import LEAST, NEW, RANGE, FacingOdds
from hmt_ros.tracking.proposals.headings import turned

AHEAD = np.array([0.0, 0.0, 4.0])


@pytest.fixture
def both(human32):
    """A pose seen from the front and its reversal, (2, d)."""
    pose = human32.prior_mean.copy()
    pose[:3] = AHEAD
    return np.concatenate([pose[None], reverse_depth(human32, pose[None])])


def followed(body, poses):
    odds = FacingOdds()
    odds.follow(body, poses[:1], np.zeros(1), np.zeros(1, dtype=bool))
    return odds


def test_the_way_is_given_up_after_lasting_evidence_not_after_one_image(human32, both):
    odds = followed(human32, both)
    back = odds.back(human32, both)
    assert list(back) == [False, True]
    known = np.ones(2, dtype=bool)
    images = 0
    while odds.log_odds > 0:
        odds.update(back, np.array([24.0, 20.0]), known, AHEAD, 0.1)
        images += 1
    assert images == pytest.approx(NEW / 0.4, abs=1.0)
    log_weights = odds.shared(back, np.log([0.9, 0.1]))
    assert np.exp(log_weights).sum() == pytest.approx(1.0)
    assert log_weights[1] > log_weights[0]
    odds.follow(human32, both, log_weights, back)
    assert odds.log_odds > 0
    assert list(odds.back(human32, both)) == [True, False]


def test_hypotheses_that_were_not_followed_are_no_evidence(human32, both):
    odds = followed(human32, both)
    odds.update(np.array([False, True]), np.array([99.0, 0.0]), np.array([True, False]), AHEAD, 1.0)
    assert odds.log_odds == NEW


def test_seen_from_the_side_the_way_is_hardly_known(human32, both):
    poses = turned(human32, both[0], 8)
    left = left_directions(human32, poses)
    side, front = int(np.argmax(np.abs(left[:, 2]))), 0
    for which, most in ((front, LEAST + RANGE), (side, LEAST)):
        odds = followed(human32, poses[[which]])
        nobody = np.zeros(1, dtype=bool)
        odds.log_odds = 100.0
        odds.update(nobody, np.zeros(1), ~nobody, poses[which, :3], 0.1)
        assert odds.log_odds == pytest.approx(most, abs=0.3)


def test_within_a_way_weights_keep_their_ratios(human32, both):
    odds = followed(human32, both)
    back = np.array([False, False, True])
    before = np.log([0.3, 0.1, 0.6])
    after = odds.shared(back, before)
    assert after[0] - after[1] == pytest.approx(before[0] - before[1])
    assert np.exp(after[2]) == pytest.approx(1.0 / (1.0 + np.exp(NEW)))
    one_way = odds.shared(np.zeros(3, dtype=bool), before)
    assert np.array_equal(one_way, before)
