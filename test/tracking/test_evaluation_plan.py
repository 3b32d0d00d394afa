"""How the evaluations of an image are allocated."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from hmt_ros.image.background import BackgroundModel
from hmt_ros.sessions.tracking_parameters import LIVE_BUDGET
from hmt_ros.tracking import Subject, Tracker, TrackerSettings
from hmt_ros.tracking.optimisation import is_surprising
from hmt_ros.tracking.settings import (
    ACCURATE_BUDGET,
    SURPRISING_RATIO,
)

FRAME = 100_000_000


def test_more_budget_is_never_less_of_anything():
    before = astuple(TrackerSettings(evaluation_budget=1).plan)
    for budget in range(2, 3000, 7):
        plan = astuple(TrackerSettings(evaluation_budget=budget).plan)
        assert all(a >= b for a, b in zip(plan, before, strict=True)), budget
        before = plan


@pytest.mark.parametrize('seconds', [0.03, 0.3])
def test_a_motion_surprises_by_what_the_image_tells_of_it(seconds):
    rng, d, count = np.random.default_rng(2), 12, 4000
    spread, factor = rng.normal(size=(2, d, d))
    prior = seconds * (spread @ spread.T + np.eye(d))
    precision = np.linalg.inv(prior)
    hessian = precision + 100.0 * factor @ factor.T
    moves = rng.multivariate_normal(np.zeros(d), prior - np.linalg.inv(hessian), size=count)
    mean = np.einsum('ni,ij,nj->n', moves, precision, moves).mean()
    usual = moves[0] * np.sqrt(SURPRISING_RATIO * mean / (moves[0] @ precision @ moves[0]))
    assert not is_surprising(0.9 * usual, precision, hessian)
    assert is_surprising(1.1 * usual, precision, hessian)
    # An uninformative image moves nothing.
    assert not is_surprising(np.zeros(d), precision, precision)


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses, images and the empty scene of a walking person."""
    return filmed('walk', 0.8, camera)


@pytest.mark.parametrize('budget', [40, 150, LIVE_BUDGET, ACCURATE_BUDGET])
def test_an_image_keeps_to_its_budget(film, human32, camera, keypoints_of, budget):
    poses, images, empty = film
    settings = TrackerSettings(evaluation_budget=budget)
    tracker = Tracker(human32, camera, settings, BackgroundModel.from_image(empty))
    first = keypoints_of(human32, poses[0])
    tracker.reset(Subject(0, first, dict(human32.segment_lengths)))
    spent = []
    for i, image in enumerate(images):
        posterior, _ = tracker.step(image, i * FRAME)
        assert posterior is not None
        spent.append(tracker.estimate.evaluations)
        if i > 0:
            # Postures of an unseen limb share the root of their mode.
            modes = np.unique(posterior.means[:, :6], axis=0)
            assert len(modes) <= settings.plan.hypotheses
    assert max(spent[1:]) < 1.5 * budget + 10
    assert np.mean(spent[1:]) < 1.2 * budget
