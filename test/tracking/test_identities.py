"""Identities of modes, which persist from image to image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import Tracker, TrackerSettings
from hmt_ros.tracking.hypotheses import Hypotheses, Identities, Modes, new_hypotheses

FRAME = 100_000_000  # ns


def jumps(*rows: str) -> np.ndarray:
    """Which degrees of freedom jumped (N, 2), marked by 'x'."""
    return np.array([[c == 'x' for c in row] for row in rows])


def descendants(ancestors: list[int], jumped: np.ndarray) -> Hypotheses:
    """Hypotheses that descend from the given modes, heaviest first."""
    new = new_hypotheses(np.zeros(jumped.shape), np.zeros(len(jumped)))
    return replace(new, ancestors=np.array(ancestors), jumped=jumped)


@pytest.mark.parametrize(
    ('ancestors', 'jumped', 'expected'),
    [
        # All continue, in another order.
        ([2, 0, 1], jumps('..', '..', '..'), [3, 1, 2]),
        # Of two descendants of one mode, the heavier keeps the identity.
        ([1, 1, 0], jumps('..', '..', '..'), [2, 4, 1]),
        # One that moved keeps the identity before a heavier one that jumped.
        ([1, 1, 0], jumps('x.', '..', '..'), [4, 2, 1]),
        # Where a limb of each has jumped, the heaviest keeps the identity.
        ([1, 1, 0], jumps('x.', '.x', '..'), [2, 4, 1]),
        # Modes that were placed again have no ancestor.
        ([1, 2, 0], jumps('xx', '..', '.x'), [4, 3, 1]),
    ],
)
def test_the_heaviest_descendant_keeps_the_number(ancestors, jumped, expected):
    identities = Identities()
    before = identities.of(descendants([0, 1, 2], jumps('..', '..', '..')), None)
    assert before.tolist() == [1, 2, 3]
    modes = replace(Modes.blank(3, 2), identities=before)
    found = identities.of(descendants(ancestors, jumped), modes)
    assert found.tolist() == expected
    # A number is given only once, even after its mode has ended.
    modes = replace(modes, identities=found)
    after = identities.of(descendants([0, 0], jumps('..', '..')), modes)
    assert after.tolist() == [expected[0], max(3, *expected) + 1]


def test_numbers_of_a_track(human32, camera, filmed):
    poses, images, empty = filmed('reach', 0.8, camera)
    settings = TrackerSettings(
        candidates=8, max_hypotheses=4, searched_chains=1, estimate_shape=False
    )
    start = GaussianMixture(np.ones(1), poses[:1], 1e-3 * np.eye(human32.dimension)[None])
    runs = []
    for _ in range(2):
        tracker = Tracker(human32, camera, settings, BackgroundModel.from_image(empty))
        tracker.reset(start)
        found = []
        for i, image in enumerate(images):
            tracker.step(image, i * FRAME)
            found.append(tracker.estimate.modes.identities.tolist())
        runs.append(found)
        assert found[0][0] == 1
        # A new track starts with 1 again.
        tracker.reset(start)
        tracker.step(images[0], 0)
        assert tracker.estimate.modes.identities[0] == 1
        assert tracker.estimate.velocities is None
    assert runs[0] == runs[1]
    seen: set[int] = set()
    for before, now in zip(runs[0], runs[0][1:], strict=False):
        seen |= set(before)
        assert len(set(now)) == len(now)
        assert set(before) & set(now), 'no mode lasts'
        assert all(number in before or number not in seen for number in now)
