"""The evidence of keypoints for the presence of a person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.image.keypoint_evidence import keypoint_evidence
from hmt_ros.image.terms.keypoints import Keypoints

NONE = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


def keypoints(count, confidence):
    return Keypoints(
        tuple(f'joint_{i}' for i in range(count)),
        np.full((count, 2), 100.0),
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
    ],
)
def test_evidence(seen, wanted, human32):
    assert keypoint_evidence(seen, human32) == pytest.approx(wanted)


@pytest.mark.parametrize(('metre', 'wanted'), [(100.0, 1.0), (33.0, 0.5), (15.0, 0.0)])
@pytest.mark.parametrize('part', ['', 'shoulder elbow wrist'])
def test_a_small_person_is_a_mistake(human32, metre, wanted, part):
    """At any place, seen whole or in part; it is not evidence of an empty image, either."""
    joints = human32.joint_positions(human32.prior_mean[None])[0]
    rows = [i for i, x in enumerate(human32.joint_names) if any(y in x for y in part.split(' '))]
    seen = Keypoints(
        tuple(human32.joint_names[i] for i in rows),
        metre * joints[rows, :2] + [200.0, 100.0],
        np.tile(np.eye(2), (len(rows), 1, 1)),
        np.full(len(rows), 0.9),
    )
    assert keypoint_evidence(seen, human32) == pytest.approx(wanted)
    assert keypoint_evidence(replace(seen, confidences=0.0 * seen.confidences), human32) == -1.0
