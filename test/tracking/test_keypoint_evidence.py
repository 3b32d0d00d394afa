"""What keypoints say of somebody's presence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking.keypoint_evidence import keypoint_evidence

NONE = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


def keypoints(count, confidence, extent=100.0):
    """They lie on a line down the image, px."""
    return Keypoints(
        tuple(f'joint_{i}' for i in range(count)),
        np.linspace((100.0, 20.0), (100.0, 20.0 + extent), count),
        np.tile(np.eye(2), (count, 1, 1)),
        np.full(count, confidence),
    )


@pytest.mark.parametrize(
    ('seen', 'wanted'),
    [
        (NONE, -1.0),
        (replace(keypoints(12, 1.0), pixels=np.full((12, 2), np.nan)), -1.0),
        (keypoints(12, 0.0), -1.0),
        (keypoints(3, 1 / 3), -1.0),
        (keypoints(3, 0.5), -0.5),
        (keypoints(4, 1.0), 0.0),
        (keypoints(10, 0.2), 0.0),
        (keypoints(10, 0.25), 0.5),
        (keypoints(6, 0.5), 1.0),
        (keypoints(12, 0.9), 1.0),
        (keypoints(12, 0.9, 75.0), 0.5),
        (keypoints(12, 0.9, 30.0), 0.0),
        (keypoints(12, 0.0, 30.0), -1.0),
    ],
)
def test_evidence(seen, wanted):
    assert keypoint_evidence(seen) == pytest.approx(wanted)
