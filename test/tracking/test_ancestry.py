"""Likelihoods contain the chain of the modes: weights, identities and ancestry."""

from typing import NamedTuple

import numpy as np
import pytest

from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import Status, Tracker, TrackerSettings
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.laplace_approximation import Likelihood

STEP = 100_000_000  # ns
CUT, EMPTY, JUMP, IMAGES = (1, 2), (3, 16, 17), 6, 22
CUES = LikelihoodSettings()
SETTINGS = TrackerSettings(
    candidates=8,
    likelihood=LikelihoodSettings.of_terms(keypoints=CUES.keypoints, coverage=CUES.coverage),
    flow_weight=0.0,
    estimate_shape=False,
    lifter='',
)


class Seen(NamedTuple):
    """State after an image."""

    stamp: int
    modes: Modes
    postures: int
    likelihood: Likelihood
    foreseen: bool
    lost: bool


@pytest.fixture(scope='module')
def images(human32, camera, motion, keypoints_of):
    """Images with cut-off legs, an empty mask, jumps until the track is lost, then its end."""
    tracker = Tracker(human32, camera, SETTINGS)
    tracker.reset(GaussianMixture(np.ones(1), motion[:1], 0.01 * np.eye(32)[None]))
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    elsewhere = motion[11].copy()
    elsewhere[0] += 1.2
    elsewhere[3] += 2.5
    result = []
    for i in range(IMAGES):
        keypoints = keypoints_of(human32, motion[i] if i < JUMP else elsewhere, 1.0, i)
        if i in CUT:
            legs = [any(x in y for x in ('knee', 'ankle', 'toe')) for y in keypoints.names]
            keypoints.pixels[legs], keypoints.confidences[legs] = np.nan, 0.0
        mask = np.zeros(black.shape[:2], np.bool_) if i in EMPTY else None
        stamp = (i + 1) * STEP
        tracker.step(black, stamp, None if i in EMPTY else keypoints, mask=mask)
        e = tracker.estimate
        lost, postures = e.status is Status.LOST, len(e.published)
        result.append(Seen(stamp, e.modes, postures, e.likelihood, e.foreseen, lost))
    # All tested events have occurred.
    assert [i for i, one in enumerate(result) if one.foreseen] == [3]
    assert [len(result[i].modes) > 1 for i in (5, 15, 17, 21)] == [True, True, False, True]
    assert all(result[i].postures > len(result[i].modes) for i in CUT)
    assert any(one.lost for one in result)
    return result


@pytest.fixture(scope='module')
def begins(images):
    """Images with first modes: those of a new track, and after a lost one is found."""
    result = [i for i, x in enumerate(images) if len(x.modes) and not x.modes.origins.shape[1]]
    assert [len(images[i - 1].modes) > 0 for i in result[1:]] == [True, False]
    assert images[result[1] - 1].lost
    return result


def test_components_are_the_modes(images):
    for one in images:
        found, modes = one.likelihood, one.modes
        if not len(modes):
            continue
        assert sorted(found.identities) == sorted(modes.identities)
        assert len(set(modes.identities.tolist())) == len(modes)
        assert np.array_equal(found.identities, modes.identities[found.modes])
        assert np.array_equal(found.posterior_weights, modes.mixture.weights[found.modes])
        assert found.posterior_weights.sum() == pytest.approx(1.0, abs=1e-12)
        assert len(found.mixture) == len(modes)
    orders = [one.likelihood.modes.tolist() for one in images]
    assert any(order != sorted(order) for order in orders)


def test_components_continue_those_of_the_image_before(images, begins):
    for i, one in enumerate(images):
        found = one.likelihood
        if not len(one.modes):
            continue
        if i in begins:
            assert found.origins.shape == (len(one.modes), 0)
            assert (len(found.ancestors), found.ancestry_stamp) == (0, None)
            continue
        before = images[i - 1]
        assert np.array_equal(found.ancestors, before.likelihood.identities)
        assert found.ancestry_stamp == before.stamp
        assert found.origins.sum(1) == pytest.approx(np.ones(len(one.modes)), abs=1e-12)
        if one.foreseen:
            kept = found.ancestors == found.identities[:, None]
            assert np.array_equal(found.origins, kept.astype(float))


def test_backward_weights_are_those_of_the_chain_of_the_modes(images, begins):
    """Compared by identities, for any order of components, within each part of the track."""
    differ = 0.0
    for first, end in zip(begins, [*begins[1:], len(images)], strict=True):
        stretch = [one for one in images[first:end] if len(one.modes)]
        last = stretch[-1]
        weights, wanted = last.likelihood.posterior_weights, last.modes.mixture.weights
        for one in reversed(stretch):
            found = one.likelihood
            of_modes = dict(zip(one.modes.identities.tolist(), wanted, strict=True))
            in_order = [of_modes[x] for x in found.identities.tolist()]
            assert weights == pytest.approx(in_order, abs=1e-12)
            differ = max(differ, np.abs(weights - found.posterior_weights).max())
            weights = weights @ found.origins
            wanted = wanted if one.foreseen else wanted @ one.modes.origins
    assert differ > 0.05
