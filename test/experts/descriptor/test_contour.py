from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.experts.descriptor.contour import NoSilhouetteError, person_blob, sample_contour


def disc(height: int, width: int, row: int, column: int, radius: int) -> np.ndarray:
    y, x = np.ogrid[:height, :width]
    return (y - row) ** 2 + (x - column) ** 2 <= radius**2


def figure(mask: np.ndarray, left: int, top: int) -> None:
    """A person of 60 x 100 px with arms and legs."""
    mask[top + 10 : top + 100, left + 22 : left + 38] = True
    mask[top + 20 : top + 30, left : left + 60] = True
    mask[top + 60 : top + 100, left + 28 : left + 32] = False
    mask[top : top + 12, left + 24 : left + 36] = True


def test_points_are_evenly_spaced_on_a_circle() -> None:
    points, directions = sample_contour(disc(101, 101, 50, 50, 40).astype(np.uint8), 80)
    radius = np.linalg.norm(points - 50, axis=1)
    np.testing.assert_allclose(radius, 40, atol=1.0)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    assert steps.std() < 0.06 * steps.mean()
    # The outline runs perpendicular to the radius.
    along = np.stack([np.cos(directions), np.sin(directions)], axis=1)
    inwards = (along * (points - 50)).sum(1) / radius
    assert np.abs(inwards).max() < 0.15


def test_holes_get_points_by_their_length() -> None:
    ring = disc(121, 121, 60, 60, 50) & ~disc(121, 121, 60, 60, 25)
    points, _ = sample_contour(ring.astype(np.uint8), 90)
    inner = np.linalg.norm(points - 60, axis=1) < 37
    assert len(points) == 90
    assert abs(int(inner.sum()) - 30) <= 1


def test_the_box_is_that_of_the_person() -> None:
    mask = np.zeros((200, 300), bool)
    figure(mask, 100, 50)
    blob = person_blob(mask)
    assert blob.box == (99.5, 49.5, 159.5, 149.5)
    assert blob.cut == (False, False, False, False)
    assert blob.remarks == ()
    np.testing.assert_array_equal(blob.mask, mask[50:150, 100:160])


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(NoSilhouetteError, match='empty'):
        person_blob(np.zeros((48, 64), np.uint8))


def test_specks_are_nobody() -> None:
    mask = np.zeros((48, 64), np.uint8)
    mask[10:13, 10:13] = 1
    with pytest.raises(NoSilhouetteError, match='9 px, wanted 60'):
        person_blob(mask)


def test_of_several_blobs_the_largest_person_is_used_and_it_is_said() -> None:
    mask = np.zeros((200, 640), bool)
    figure(mask, 100, 50)
    mask[10:190, 300:420] = True  # a full rectangle: larger, but not shaped like a person
    mask[180:190, 440:640] = True  # long as a cable
    blob = person_blob(mask)
    assert blob.box == (99.5, 49.5, 159.5, 149.5)
    assert blob.left_out == 2
    assert '2 other blobs left out' in blob.remarks[0]


def test_a_piece_torn_off_belongs_to_the_person() -> None:
    mask = np.zeros((200, 300), bool)
    figure(mask, 100, 50)
    mask[62:64, 100:160] = False  # the head and shoulders come off
    mask[120:123] = False
    blob = person_blob(mask)
    assert blob.left_out == 0
    assert blob.mask.shape == (100, 60)


def test_sides_that_the_border_cuts_are_marked() -> None:
    mask = np.zeros((200, 300), bool)
    figure(mask, 240, 120)
    blob = person_blob(mask)
    assert blob.cut == (False, False, True, True)
    assert blob.remarks == ('the person is cut by the border of the image (right, bottom)',)


def test_a_mask_has_two_axes() -> None:
    with pytest.raises(ValueError, match='two axes'):
        person_blob(np.zeros((4, 4, 3)))
