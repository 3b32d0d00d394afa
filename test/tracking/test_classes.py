"""Facing: a chain of two states, compared with its equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logit

from hmt_ros.body import load_body
from hmt_ros.body.mirror import (
    faces_back,
    reverse_depth,
    root_angles,
    root_rotation_dofs,
    root_rotations,
)
from hmt_ros.core import believed
from hmt_ros.tracking.classes import first_facing, ways, weigh_ways
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.settings import FACING_VALIDITY, MAX_FACING_NATS
from hmt_ros.tracking.weighting import TransitionPrior

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
    """Function (pose, angle) -> the pose (1, d) rotated about the vertical of the image."""

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
    """Function (modes, evidence of the two poses, followed) -> log weights, next modes."""

    def step(modes, evidence, followed=KNOWN, before=None, poses=both, dt=DT):
        before = np.zeros(len(poses)) if before is None else before
        far = np.full((len(modes), len(poses)), -100.0)
        predicted = np.repeat(poses[:1], len(far), axis=0)
        return weighed(human32, modes, predicted, poses, far, before, evidence, followed, dt)

    return step


def weighed(body, modes, predicted, poses, transitions, before, evidence, followed, dt):
    """Log weights of poses, and the poses as modes."""
    transition_prior = TransitionPrior(body, predicted, np.zeros(len(modes)), dt)
    log_weights, facing, _ = weigh_ways(
        modes, transition_prior, body.joint_positions(poses), transitions, before,
        np.asarray(evidence, dtype=float), np.asarray(followed),
    )  # fmt: skip
    return log_weights, begun(body, poses, facing)


def begun(body, poses, facing=None, log_odds=-MAX_FACING_NATS):
    """Modes with the first leading, and log odds that the person faces the other way."""
    joints = body.joint_positions(poses)
    back = ways(body, joints, joints[0])
    if facing is None:
        facing = np.where(back, log_odds, -log_odds)
    return replace(Modes.blank(*poses.shape), poses=poses, back=back, facing=facing)


def log_odds_of(modes):
    """Log odds that the person does not face as in the first mode."""
    return -modes.facing[0]


def led_by(body, modes, first):
    """The modes with another leading mode."""
    order = np.argsort(np.arange(len(modes)) != first, kind='stable')
    return begun(body, modes.poses[order], modes.facing[order])


def test_evidence_that_lasts_turns_the_track_about(human32, both, weigh):
    modes = begun(human32, both, log_odds=-4.0)
    images = 0
    while True:
        images += 1
        log_weights, modes = weigh(modes, [20.5, 20.0])
        if log_weights[1] > log_weights[0]:
            break
        assert images < 20
    # Half a nat per image, discounted to four fifths, minus the chain's forgetting.
    assert 6 < images <= 10
    # The other facing leads now, and the odds are those of the previous one.
    modes = led_by(human32, modes, 1)
    assert -1.0 < log_odds_of(modes) < 0.0
    assert list(modes.back) == [False, True]


def test_one_image_does_not_turn_the_track_about(human32, both, weigh):
    log_weights, modes = weigh(begun(human32, both, log_odds=-4.0), [22.0, 20.0])
    assert log_weights[0] > log_weights[1] + 1.0
    assert log_odds_of(modes) == pytest.approx(
        REVERSALS.after(-4.0, DT) + believed(2.0, FACING_VALIDITY)
    )


def test_hypotheses_that_were_not_followed_are_no_evidence(human32, both, weigh):
    modes = begun(human32, both, log_odds=-4.0)
    _, modes = weigh(modes, [99.0, 0.0], followed=[True, False])
    assert log_odds_of(modes) == pytest.approx(REVERSALS.after(-4.0, DT))


def test_one_image_says_only_as_much_as_it_may_be_believed():
    """With probability v its evidence is about the person, otherwise it is random."""
    for evidence in (-5.0, -0.3, 0.0, 0.3, 2.0):
        ratio = np.exp(evidence)
        wanted = np.log(
            (FACING_VALIDITY * ratio + 1.0 - FACING_VALIDITY)
            / (FACING_VALIDITY + (1.0 - FACING_VALIDITY) * ratio)
        )
        assert believed(evidence, FACING_VALIDITY) == pytest.approx(wanted)
        assert believed(-evidence, FACING_VALIDITY) == pytest.approx(
            -believed(evidence, FACING_VALIDITY)
        )
    assert believed(1e6, FACING_VALIDITY) == pytest.approx(logit(FACING_VALIDITY))
    assert believed(-np.inf, FACING_VALIDITY) == pytest.approx(-logit(FACING_VALIDITY))


def test_seen_from_the_side_either_way_may_go_on(human32, both):
    """When both facings are close to each other, the earlier evidence is lost."""
    modes, near = begun(human32, both[:1], log_odds=-8.0), np.array([[0.0, -0.01]])
    nothing = np.zeros(2)
    log_weights, modes = weighed(human32, modes, both[1:], both, near, nothing, nothing, KNOWN, DT)
    assert np.exp(log_weights) == pytest.approx(0.5, abs=0.01)
    assert log_odds_of(modes) == pytest.approx(-0.01)


def test_a_person_who_turns_away_leads_the_track_along(human32, both, turned):
    """Past the side view, the turning hypothesis is weighted as without earlier evidence."""
    step = np.radians(16.0)
    side = next(
        a
        for a in np.arange(0.0, np.pi, 0.01)
        if faces_back(
            human32,
            human32.joint_positions(turned(both[0], a + step)),
            human32.joint_positions(turned(both[0], a))[0],
        )[0]
    )
    before = turned(both[0], side)
    first = begun(human32, before, log_odds=-8.0)
    poses = np.concatenate([before, turned(both[0], side + step)])
    transition_prior = TransitionPrior(human32, before, np.zeros(1), 1.0)
    transitions = transition_prior.log_transitions(human32.joint_positions(poses))
    assert transitions[0, 1] > -0.5
    log_weights, _ = weighed(
        human32, first, before, poses, transitions, np.zeros(2), [3.0, 0.0], KNOWN, 1.0
    )
    assert log_weights[1] > log_weights[0] + 1.0
    # Also if it is the only one left.
    _, modes = weighed(
        human32, first, before, poses[1:], transitions[:, 1:], np.zeros(1), [0.0], KNOWN[:1], 1.0
    )
    assert log_odds_of(modes) == pytest.approx(transitions[0, 1])


def test_a_start_says_which_way(human32, both):
    joints = human32.joint_positions(both)
    facing = first_facing(human32, joints, np.log([0.8, 0.2]))
    assert facing == pytest.approx(np.log([4.0, 0.25]))
    assert first_facing(human32, joints[:1], np.zeros(1)) == pytest.approx([MAX_FACING_NATS])
    assert first_facing(human32, joints, np.array([0.0, -1e9])) == pytest.approx(
        [MAX_FACING_NATS, -MAX_FACING_NATS]
    )


def test_a_body_without_a_trunk_is_left_alone(both):
    class Trunkless:
        trunk_pairs = ()

        def joint_positions(self, poses):
            return np.zeros((len(poses), 1, 3))

    modes = begun(Trunkless(), both, first_facing(Trunkless(), both, np.zeros(2)))
    before = np.log([0.2, 0.8])
    found, modes = weighed(
        Trunkless(), modes, both, both, np.zeros((2, 2)), before, [9.0, 0.0], KNOWN, DT
    )
    assert found is before
    assert log_odds_of(modes) == -MAX_FACING_NATS
