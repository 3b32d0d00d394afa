"""The area a person covers, and which pieces of a silhouette have the shape of a person."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import Camera
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.image.person_shape import (
    covered,
    largest_person,
    looks_like_person,
)


@pytest.fixture(scope='module')
def camera() -> Camera:
    return Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope='module')
def film(camera, human32):
    """Poses and silhouettes of one second."""
    view = Viewpoint(distance=3.2)
    poses = procedural_motion('reach', human32, 1.0, 10.0, 3, viewpoint=view)
    return poses, render_silhouettes(human32, poses, camera)


def test_the_model_covers_what_it_shows(film, human32, camera):
    for pose, mask in zip(film[0][:3], film[1][:3], strict=True):
        found = covered(human32, camera, pose)
        assert (found & mask).sum() / (found | mask).sum() > 0.93
        coarse = covered(human32, camera, pose, 3)
        assert coarse.shape == (80, 107)
        assert coarse.mean() == pytest.approx(mask.mean(), rel=0.2)


def test_shapes_of_persons(film):
    masks = film[1]
    assert all(looks_like_person(mask) for mask in masks)
    box = np.zeros((240, 320), dtype=np.bool_)
    assert not looks_like_person(box)
    box[40:200, 100:200] = True
    assert not looks_like_person(box)
    line = np.zeros((240, 320), dtype=np.bool_)
    line[40:200, 100:103] = True
    assert not looks_like_person(line)
    small = np.zeros((240, 320), dtype=np.bool_)
    small[40:80, 100:140] = masks[0][60:100, 140:180]
    assert not looks_like_person(small & (np.arange(240) < 70)[:, None])


def test_the_largest_piece_is_that_of_a_person(film):
    """A larger box beside the person is not taken for the person, whatever is near it."""
    mask = film[1][0].copy()
    piece = largest_person(mask)
    assert piece.area == pytest.approx(mask.sum(), rel=0.02)
    assert not piece.cut
    mask[20:230, 0:80] = True
    assert largest_person(mask).area == pytest.approx(piece.area, rel=0.02)
    assert largest_person(np.zeros_like(mask)) is None
    half = mask.copy()
    half[:, :160] = False
    cut = largest_person(np.roll(half, -160, axis=1))
    assert cut is not None
    assert cut.cut
