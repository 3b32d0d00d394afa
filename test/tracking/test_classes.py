"""The way to face: a chain of two states against its equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit, logit

from hmt_ros.body import load_body
from hmt_ros.body.mirror import (
    faces_back,
    reverse_depth,
    root_angles,
    root_rotation_dofs,
    root_rotations,
)
from hmt_ros.tracking.classes import MOST, VALID, Facing, believed, log_turns
from hmt_ros.tracking.weighting import Continuity

DT = 0.1
REVERSALS = load_body('human37').symmetries['reversal']
KNOWN = np.ones(2, dtype=bool)


@pytest.fixture(scope='module')
def both(human32):
    """A pose seen from the front and its reversal, (2, d)."""
    pose = human32.prior_mean.copy()
    pose[:3] = (0.0, 0.0, 4.0)
    return np.concatenate([pose[None], reverse_depth(human32, pose[None])])


@pytest.fixture(scope='module')
def turned(human32):
    """Function (pose, angle) -> the pose (1, d) turned about the vertical of the image."""

    def turn(pose, angle):
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        result = pose[None].copy()
        rotations = rotation @ root_rotations(human32, result)
        result[:, root_rotation_dofs(human32.skeleton)] = root_angles(human32, rotations)
        return result

    return turn


@pytest.fixture(scope='module')
def weigh(human32, both):
    """Function (facing, evidence of the two poses, followed) -> their log weights a step on."""

    def step(facing, evidence, followed=KNOWN, before=None, poses=both, dt=DT):
        before = np.zeros(len(poses)) if before is None else before
        far = np.full((len(facing.back), len(poses)), -100.0)
        evidence = np.asarray(evidence, dtype=float)
        predicted = np.repeat(poses[:1], len(far), axis=0)
        return facing.weigh(
            human32, poses, far, before, evidence, np.asarray(followed), dt, predicted
        )

    return step


def begun(body, poses, log_odds=-MOST):
    facing = Facing()
    facing.start(body, poses, np.zeros(len(poses)))
    facing.lead(body, poses)
    facing.log_odds = log_odds
    return facing


def test_evidence_that_lasts_turns_the_track_about(human32, both, weigh):
    facing = begun(human32, both, log_odds=-4.0)
    images = 0
    while True:
        images += 1
        log_weights = weigh(facing, [20.5, 20.0])
        if log_weights[1] > log_weights[0]:
            break
        facing.lead(human32, both)
        assert images < 20
    # Half a nat an image, of which four fifths are believed, and what the chain forgets meanwhile.
    assert 6 < images <= 10
    # The other way leads from now on, and the odds are those of the way that was left.
    facing.lead(human32, both[::-1])
    assert -1.0 < facing.log_odds < 0.0
    assert list(facing.back) == [False, True]


def test_one_image_does_not_turn_the_track_about(human32, both, weigh):
    facing = begun(human32, both, log_odds=-4.0)
    log_weights = weigh(facing, [22.0, 20.0])
    assert log_weights[0] > log_weights[1] + 1.0
    assert facing.log_odds == pytest.approx(REVERSALS.after(-4.0, DT) + believed(2.0))


def test_hypotheses_that_were_not_followed_are_no_evidence(human32, both, weigh):
    facing = begun(human32, both, log_odds=-4.0)
    weigh(facing, [99.0, 0.0], followed=[True, False])
    assert facing.log_odds == pytest.approx(REVERSALS.after(-4.0, DT))


def test_the_best_motion_stands_for_its_way(human32, both, weigh):
    """The number of the modes of a way says nothing of it, nor do its bad ones."""
    many = np.concatenate([both[:1], np.repeat(both[1:], 3, axis=0)])
    facing = begun(human32, both, log_odds=-2.0)
    log_weights = weigh(facing, [20.0, 20.0, 30.0, 40.0], np.ones(4, dtype=bool), poses=many)
    wanted = expit(REVERSALS.after(-2.0, DT))
    assert np.exp(log_weights[1:]).sum() == pytest.approx(wanted)
    assert facing.log_odds == pytest.approx(REVERSALS.after(-2.0, DT))


def test_within_a_way_weights_keep_their_ratios(human32, both, weigh):
    poses = both[[0, 0, 1]]
    before = np.log([0.3, 0.1, 0.6]) - 7.0
    facing = begun(human32, both, log_odds=-3.0)
    found = weigh(facing, np.zeros(3), np.ones(3, dtype=bool), before, poses)
    assert found[0] - found[1] == pytest.approx(np.log(3.0))
    assert np.exp(found).sum() == pytest.approx(1.0)
    assert np.exp(found[2]) == pytest.approx(expit(REVERSALS.after(-3.0, DT)))
    # Where all face one way, there is nothing to share.
    one_way = weigh(facing, np.zeros(2), KNOWN, before[:2], poses[:2])
    assert np.array_equal(one_way, before[:2])


def test_one_image_says_only_as_much_as_it_may_be_believed():
    """Either it speaks of the person, with the probability v, or it says the opposite by chance."""
    for evidence in (-5.0, -0.3, 0.0, 0.3, 2.0):
        ratio = np.exp(evidence)
        wanted = np.log((VALID * ratio + 1.0 - VALID) / (VALID + (1.0 - VALID) * ratio))
        assert believed(evidence) == pytest.approx(wanted)
        assert believed(-evidence) == pytest.approx(-believed(evidence))
    assert believed(1e6) == pytest.approx(logit(VALID))
    assert believed(-np.inf) == pytest.approx(-logit(VALID))


def test_a_flash_does_not_turn_a_track_about(human32, both, weigh):
    facing = begun(human32, both, log_odds=-4.0)
    log_weights = weigh(facing, [1e6, 0.0])
    assert log_weights[0] > log_weights[1]


def test_odds_are_bounded(human32, both, weigh):
    facing = begun(human32, both)
    for _ in range(20):
        log_weights = weigh(facing, [0.0, 1e6])
        assert -MOST <= facing.log_odds <= MOST
        facing.lead(human32, both)
    # The chain forgets as fast as images tell, where they are certain.
    assert facing.log_odds == pytest.approx(
        REVERSALS.after(facing.log_odds, DT) - logit(VALID), abs=0.1
    )
    assert np.isfinite(log_weights).all()


def test_seen_from_the_side_either_way_may_go_on(human32, both, weigh):
    """Where a way is near the other one, what was known of the ways is gone."""
    facing = begun(human32, both[:1], log_odds=-8.0)
    transitions = np.array([[0.0, -0.01]])
    log_weights = facing.weigh(
        human32, both, transitions, np.zeros(2), np.zeros(2), KNOWN, DT, both[1:]
    )
    assert np.exp(log_weights) == pytest.approx(0.5, abs=0.01)
    assert facing.log_odds == pytest.approx(-0.01)


def test_nobody_turns_about_between_two_images(human32, both, turned):
    """However near the joints of the two ways are."""
    near = np.zeros((1, 2))
    for dt, known in ((0.03, True), (0.3, True), (30.0, False)):
        facing = begun(human32, both[:1], log_odds=-5.0)
        facing.weigh(human32, both, near, np.zeros(2), np.zeros(2), KNOWN, dt, both[:1])
        assert (facing.log_odds < -4.0) == known
    for angle in (0.1, 0.5, 3.0):
        (found,) = log_turns(human32, both[:1], turned(both[0], angle), 0.5)[0]
        variance = 0.5 * human32.rates[root_rotation_dofs(human32.skeleton)[0]]
        assert found == pytest.approx(-0.5 * angle**2 / variance, rel=1e-3)


def test_a_person_who_turns_away_leads_the_track_along(human32, both, turned):
    """Past the side, the hypothesis that goes on turning weighs as if nothing was known."""
    step = np.radians(16.0)
    side = next(
        a
        for a in np.arange(0.0, np.pi, 0.01)
        if faces_back(human32, turned(both[0], a + step), turned(both[0], a)[0])[0]
    )
    before = turned(both[0], side)
    facing = begun(human32, before, log_odds=-8.0)
    poses = np.concatenate([before, turned(both[0], side + step)])
    continuity = Continuity(human32, before, np.zeros(1), 1.0)
    transitions = continuity.log_transitions(poses)
    assert transitions[0, 1] > -0.5
    log_weights = facing.weigh(
        human32, poses, transitions, np.zeros(2), np.array([3.0, 0.0]), KNOWN, 1.0, before
    )
    assert log_weights[1] > log_weights[0] + 1.0
    # Also if nothing else is left.
    facing = begun(human32, before, log_odds=-8.0)
    facing.weigh(
        human32, poses[1:], transitions[:, 1:], np.zeros(1), np.zeros(1), KNOWN[:1], 1.0, before
    )
    facing.lead(human32, poses[1:])
    assert facing.log_odds == pytest.approx(transitions[0, 1])


def test_a_camera_that_moves_changes_no_odds(human32, both):
    facing = begun(human32, both, log_odds=-3.0)
    facing.carry(human32, both[::-1])
    assert facing.log_odds == -3.0
    assert list(facing.back) == [False, True]
    facing.lead(human32, both)
    assert facing.log_odds == 3.0


def test_a_start_says_which_way(human32, both):
    facing = Facing()
    facing.start(human32, both, np.log([0.8, 0.2]))
    assert facing.log_odds == pytest.approx(np.log(0.25))
    facing.start(human32, both[:1], np.zeros(1))
    assert facing.log_odds == -MOST
    facing.start(human32, both, np.array([0.0, -1e9]))
    assert facing.log_odds == -MOST


def test_the_only_way_that_is_left_leads(human32, both, weigh):
    facing = begun(human32, both, log_odds=-3.0)
    before = np.array([-1.0])
    found = weigh(facing, [5.0], [True], before, both[1:])
    assert np.array_equal(found, before)
    facing.lead(human32, both[1:])
    assert facing.log_odds == pytest.approx(REVERSALS.after(-3.0, DT))


def test_a_body_without_a_trunk_is_left_alone(human32, both):
    class Trunkless:
        trunk_pairs = ()

    facing = Facing()
    facing.start(Trunkless(), both, np.zeros(2))
    facing.lead(Trunkless(), both)
    before = np.log([0.2, 0.8])
    found = facing.weigh(
        Trunkless(), both, np.zeros((2, 2)), before, np.array([9.0, 0.0]), KNOWN, DT, both
    )
    assert found is before
    assert facing.log_odds == -MOST
