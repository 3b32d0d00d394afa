"""Reliabilities of cues and of a track, compared with hidden Markov models."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from scipy.linalg import expm

from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.inference.error_model import share_of_time
from hmt_ros.tracking.misfit import KEYPOINTS, OUTLINE, SILHOUETTE, Misfit, of_points
from hmt_ros.tracking.settings import (
    MAX_CUE_NATS,
    MISFIT_TIME,
    PLACED_PROBABILITY,
    RATES,
    VALIDITY_COUNT,
    VALIDITY_NATS,
)
from hmt_ros.tracking.validity import (
    CHAINS,
    DEPTH,
    DETECTOR,
    UNDECIDED_MISFITS,
    VALIDITY_CHAIN,
    ByKeypoints,
    Validity,
    evidence_of,
)

RECOVERS, FAILS = RATES['track and cues']
RATE, USUAL = 30.0, VALIDITY_CHAIN.usual[1]


def whole(share, groups=1):
    """A cue with this unexplained share."""
    return Misfit(np.full(groups, share), np.full(groups, VALIDITY_COUNT))


def seconds(validity, misfits, until, rate=RATE, longest=5.0):
    """Time of equal images until a condition holds, s; NaN if it never does."""
    for i in range(int(longest * rate)):
        if until(validity):
            return i / rate
        validity.predict(1.0 / rate)
        validity.update(misfits, 1.0 / rate)
    return np.nan


def test_images_are_those_of_a_hidden_markov_model():
    """The joint states of track, detector, silhouette and groups of keypoints, written out."""
    rng = np.random.default_rng(0)
    fails = np.full(6, FAILS)
    fails[DETECTOR] = RATES['detector'][1]
    rates = [np.array([[-RECOVERS, RECOVERS], [x, -x]]) for x in fails]
    states = np.array(list(itertools.product((0, 1), repeat=6)))
    usual = RECOVERS / (fails + RECOVERS)
    p = np.where(states == 1, usual, 1.0 - usual).prod(1)
    validity = Validity()
    for dt in (0.03, 0.1, 0.4, 0.03, 2.0):
        p = p @ functools.reduce(np.kron, [expm(x * dt) for x in rates])
        shares = rng.uniform(0.1, 0.6, 5)
        counts = np.full(3, VALIDITY_COUNT)
        misfits = {
            OUTLINE: whole(shares[0]),
            SILHOUETTE: whole(shares[1]),
            KEYPOINTS: Misfit(shares[2:], counts),
        }
        each = [evidence_of(name, misfit) for name, misfit in misfits.items()]
        says = np.clip(
            share_of_time(dt, MISFIT_TIME) * np.concatenate(each), -MAX_CUE_NATS, MAX_CUE_NATS
        )
        track, detector, cues = states[:, 0], states[:, 1], states[:, 2:].copy()
        cues[:, 1:] *= detector[:, None]
        p *= np.exp(track * (says[0] + cues @ says[1:]))
        p /= p.sum()
        validity.predict(dt)
        validity.update(misfits, dt)
        assert validity.track == pytest.approx(p @ track)
        assert validity.cues[SILHOUETTE] == pytest.approx(p @ cues[:, :1])
        assert validity.cues[KEYPOINTS] == pytest.approx(p @ cues[:, 1:])


def test_what_measurements_say():
    few = Misfit(np.array([0.0, 1.0, 1.0]), np.array([0, 1, 100]))
    undecided = UNDECIDED_MISFITS[KEYPOINTS]
    wanted = VALIDITY_NATS * np.array([0.0, (undecided - 1) / VALIDITY_COUNT, undecided - 1])
    assert evidence_of(KEYPOINTS, few, begun=False) == pytest.approx(wanted)
    # A correct mode may have a misplaced part.
    most = np.log(PLACED_PROBABILITY / (1 - PLACED_PROBABILITY))
    for e in (1e3, -1e3):
        counts, share = np.array([VALIDITY_COUNT]), undecided - e / VALIDITY_NATS
        found = evidence_of(KEYPOINTS, Misfit(np.array([share]), counts))
        assert found == pytest.approx(np.sign(e) * most)


@pytest.mark.parametrize('rate', [60.0, 15.0, 5.0])
def test_what_a_second_says_does_not_depend_on_the_rate(rate):
    """Except for the image of the change."""
    for cue in (DEPTH, SILHOUETTE):
        validity, usual = Validity(), Validity()
        for each, r in ((validity, rate), (usual, RATE)):
            seconds(each, {cue: whole(0.0)}, lambda v: False, r, longest=2.0)
        bad = {cue: whole(0.8), KEYPOINTS: whole(0.0, 3)}
        times = [
            seconds(each, bad, lambda v, cue=cue: not v.is_trusted(cue), r)
            for each, r in ((validity, rate), (usual, RATE))
        ]
        assert times[0] == pytest.approx(times[1], abs=1.5 / min(rate, RATE))
        assert 0.05 < times[1] < 1.0


@pytest.mark.parametrize('cue', [SILHOUETTE, DEPTH, KEYPOINTS])
def test_a_cue_is_believed_again_within_a_second(cue):
    groups = len(Validity().cues[cue])
    validity = Validity()
    other = KEYPOINTS if cue != KEYPOINTS else SILHOUETTE
    fine = {other: whole(0.0, len(validity.cues[other]))}
    bad = {cue: whole(1.0, groups)} | fine
    seconds(validity, bad, lambda v: False, longest=10.0)
    assert not validity.is_trusted(cue)
    assert not validity.lost
    good = {cue: whole(0.0, groups)} | fine
    assert seconds(validity, good, lambda v: v.is_trusted(cue)) < 1.0


def test_groups_fail_one_by_one():
    """A detector with wrong arms."""
    validity = Validity()
    misfits = {
        KEYPOINTS: Misfit(np.array([0.0, 1.0, 0.0]), np.full(3, 4)),
        SILHOUETTE: whole(0.1),
    }
    seconds(validity, misfits, lambda v: False, longest=2.0)
    beliefs = validity.beliefs
    assert (beliefs.keypoints > 0.9).tolist() == [True, False, True]
    assert beliefs.keypoints[1] < 0.3
    assert beliefs.silhouette > 0.9
    assert not validity.lost


@pytest.mark.parametrize('rate', [30.0, 10.0, 3.0])
@pytest.mark.parametrize(
    'cues', [(KEYPOINTS,), (SILHOUETTE, OUTLINE), (KEYPOINTS, SILHOUETTE, OUTLINE)]
)
def test_a_track_is_lost_when_no_cue_is_explained(rate, cues):
    """Then the track is doubted, not the cues."""
    validity = Validity()
    sizes = {KEYPOINTS: 3}
    fine, gone = ({name: whole(share, sizes.get(name, 1)) for name in cues} for share in (0.0, 1.0))
    seconds(validity, fine, lambda v: False, rate, longest=2.0)
    assert 0.05 < seconds(validity, gone, lambda v: v.lost, rate) < 0.3 + 3.0 / rate
    assert validity.lost
    assert all(validity.cues[cue].min() > 0.4 for cue in gone if cue != OUTLINE)
    validity.search()
    assert not validity.lost
    seconds(validity, fine, lambda v: False, longest=0.2)
    assert validity.track > 0.95


@pytest.mark.parametrize(('right', 'wrong'), [(SILHOUETTE, KEYPOINTS), (KEYPOINTS, SILHOUETTE)])
def test_one_cue_that_is_explained_keeps_a_track(right, wrong):
    validity = Validity()
    sizes = {name: len(p) for name, p in validity.cues.items()}
    misfits = {right: whole(0.1, sizes[right]), wrong: whole(1.0, sizes[wrong])}
    assert np.isnan(seconds(validity, misfits, lambda v: v.lost))
    assert validity.is_trusted(right)
    assert not validity.is_trusted(wrong)


@pytest.mark.parametrize('rate', [30.0, 10.0, 3.0])
def test_a_silhouette_that_keypoints_contradict_is_doubted(rate):
    """The modes follow the silhouette and explain it; a keypoint-only pose fits the keypoints."""
    validity = Validity()
    fine = {SILHOUETTE: whole(0.0), OUTLINE: whole(0.0), KEYPOINTS: whole(0.0, 3)}
    seconds(validity, fine, lambda v: False, rate, longest=2.0)
    misfits = fine | {KEYPOINTS: whole(0.8, 3)}
    for i in range(max(round(rate), 4)):
        if not validity.is_trusted(SILHOUETTE):
            break
        validity.predict(1.0 / rate)
        # The first image determines which cue left the person.
        alone = ByKeypoints(whole(0.0, 3), 2.0 if i == 0 else 0.0)
        validity.update(misfits, 1.0 / rate, alone)
    assert not validity.is_trusted(SILHOUETTE)
    assert validity.cues[KEYPOINTS].min() > 0.6
    assert validity.track > 0.9


def test_keypoints_that_leave_the_person_are_doubted():
    """A pose that fits them would be far from the modes, which have not followed."""
    validity = Validity()
    misfits = {SILHOUETTE: whole(0.0), OUTLINE: whole(0.0), KEYPOINTS: whole(0.8, 3)}
    alone = ByKeypoints(whole(0.0, 3), -3.0)
    for i in range(60):
        validity.predict(1 / RATE)
        # The first image determines which cue left the person.
        validity.update(misfits, 1 / RATE, alone if i == 0 else ByKeypoints(whole(0.0, 3), 0.0))
    assert validity.cues[SILHOUETTE].min() > 0.6
    assert validity.cues[KEYPOINTS].max() < 0.3


@pytest.mark.parametrize('gain', [-1.0, 0.0, 2.0])
def test_the_pose_by_keypoints_stands_for_the_states_without_the_silhouette(gain):
    """Enumerates silhouette and one group of keypoints, at modes and keypoint-only poses."""
    validity, dt = Validity(), 0.1
    before = validity.joint.reshape((2,) * CHAINS).copy()
    share = share_of_time(dt, MISFIT_TIME)
    none = Misfit(np.zeros(3), np.array([0, 4, 0]))
    groups = Misfit(np.array([0.0, 0.9, 0.0]), np.array([0, 4, 0]))
    at_modes = share * evidence_of(KEYPOINTS, groups)[1]
    assert at_modes < 0
    validity.update({SILHOUETTE: whole(0.1), KEYPOINTS: groups}, dt, ByKeypoints(none, gain))
    for v in itertools.product((0, 1), repeat=before.ndim):
        track, silhouette, group = v[0], v[2], v[1] * v[4]
        # A cue that a pose was fitted to is no evidence for it.
        wanted = at_modes * group if silhouette else gain
        before[v] *= np.exp(wanted if track else 0.0)
    np.testing.assert_allclose(validity.joint, before.ravel() / before.sum(), atol=1e-12)


def test_nothing_measured_says_nothing():
    validity = Validity()
    nothing = Misfit(np.ones(3), np.zeros(3))
    before = validity.track
    validity.update({KEYPOINTS: nothing}, 0.1)
    assert validity.track == pytest.approx(before)
    assert validity.cues[KEYPOINTS] == pytest.approx(Validity().cues[KEYPOINTS])


def seen(pixels):
    n = len(pixels)
    return SurfacePoints(
        np.array([n]), np.zeros((1, n), int), np.zeros((1, n, 3)), np.array([pixels], float)
    )


def test_points_that_are_no_foreground():
    """Ten points in column 1, ten in column 3; half of them are visible."""
    points = [(1, i) for i in range(10)] + [(3, i) for i in range(10)]
    foreground = np.zeros((10, 5), dtype=bool)
    foreground[:, 1], foreground[:5, 3] = True, True
    shares, counts = of_points(seen(points), 0, foreground)
    assert shares.tolist() == [0.25]
    assert counts.tolist() == [20.0]
