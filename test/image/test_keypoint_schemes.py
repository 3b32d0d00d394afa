"""Names and offsets of keypoint schemes."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.image.keypoint_schemes import (
    noise_of,
    recognised,
    scheme_of,
    schemes,
)
from hmt_ros.image.terms.keypoints import Keypoints

COUNTS = {
    'coco17': 17, 'halpe26': 26, 'body25': 25, 'mediapipe33': 33, 'h36m17': 17, 'skeleton2d': 18,
    'smpl24': 24, 'mhr70': 70, 'wholebody23': 23, 'body25b': 25, 'kinect25': 25, 'mpi17': 17,
    'mpii16': 16,
}  # fmt: skip


def keypoints(names, **fields):
    n = len(names)
    fields.setdefault('covariances', np.tile(np.eye(2), (n, 1, 1)))
    fields.setdefault('confidences', np.ones(n))
    return Keypoints(tuple(names), np.zeros((n, 2)), **fields)


def test_every_scheme_has_its_landmarks_at_joints_of_the_body():
    assert {name: len(scheme.names) for name, scheme in schemes().items()} == COUNTS
    joints = load_body('human37').joint_names
    for scheme in schemes().values():
        assert len(set(scheme.names)) == len(scheme.names)
        assert {x.joint for x in scheme.landmarks} <= {*joints, ''}


@pytest.mark.parametrize('name', sorted(COUNTS))
def test_a_scheme_is_recognised_by_its_names(name):
    names = schemes()[name].names
    found = recognised(names)
    assert found is not None
    assert set(found.names) >= set(names)
    assert found.landmark(names[5]).joint == schemes()[name].landmarks[5].joint


def test_the_left_is_the_mirror_image_of_the_right():
    scheme = schemes()['mediapipe33']
    left, right = scheme.landmark('left_ear'), scheme.landmark('right_ear')
    np.testing.assert_array_equal(left.offset, right.offset * (-1, 1, 1))
    assert right.offset[0] > 0


def test_an_unknown_scheme_is_named():
    with pytest.raises(ValueError, match=r"no keypoint scheme 'coco', wanted one of .*coco17"):
        scheme_of(['nose'], 'coco')


def test_keypoints_of_a_scheme_have_offsets_and_noise():
    body, unknown = load_body('human37'), np.full((3, 2, 2), np.nan)
    names = ['left_wrist', 'left_eye', 'nose']
    given = keypoints(names, covariances=unknown, confidences=np.array([0.1, 1.0, 1.0]))
    known, strange = given.named_for(body, 'coco17')
    assert (known.names, strange) == (('left_wrist', 'head'), [])
    offset = schemes()['coco17'].landmark('left_wrist').offset
    np.testing.assert_allclose(known.offsets[0], body.stature / 1.7 * offset)
    assert np.isfinite(known.covariances).all()
    assert known.noise[0] > 2.0 * noise_of(np.ones(1))[0]


def test_known_covariances_and_joints_stay_as_they_are():
    known, _ = keypoints(['left_wrist']).named_for(load_body('human37'), 'joints')
    np.testing.assert_array_equal(known.covariances, np.eye(2)[None])
    assert known.noise is None
    assert known.offsets is None
