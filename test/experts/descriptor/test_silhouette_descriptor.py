from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.training.descriptor_learning import learned_descriptor
from hmt_ros.body import Camera, load_body
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.experts.descriptor.contour import NoSilhouetteError, centred_view, person_blob
from hmt_ros.experts.descriptor.internal_edges import EDGES
from hmt_ros.experts.descriptor.silhouette_descriptor import (
    SilhouetteDescriptor,
    silhouette_parts,
)

CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope='module')
def masks() -> np.ndarray:
    body = load_body('human37')
    views = Viewpoint(distance=3.4)
    return np.concatenate(
        [
            render_silhouettes(
                body, procedural_motion(name, body, 6, 5, 1, viewpoint=views), CAMERA
            )
            for name in ('walk', 'dance')
        ]
    )


@pytest.fixture(scope='module')
def descriptor(masks: np.ndarray) -> SilhouetteDescriptor:
    return learned_descriptor([silhouette_parts(x) for x in masks], codebook_size=30, components=40)


def described(descriptor: SilhouetteDescriptor, mask: np.ndarray) -> np.ndarray:
    return descriptor.describe([silhouette_parts(mask)])[0]


def spread(descriptor: SilhouetteDescriptor, masks: np.ndarray) -> float:
    rows = np.array([described(descriptor, m) for m in masks])
    return float(np.median(np.linalg.norm(rows[:, None] - rows[None], axis=2)))


def test_place_and_size_change_nothing(descriptor: SilhouetteDescriptor, masks: np.ndarray) -> None:
    typical = spread(descriptor, masks[::6])
    for mask in masks[::12]:
        vector = described(descriptor, mask)
        np.testing.assert_allclose(
            described(descriptor, np.pad(mask, ((40, 0), (0, 70)))), vector, atol=1e-9
        )
        large = cv2.resize(mask.astype(np.uint8), None, fx=2.5, fy=2.5)
        assert np.linalg.norm(described(descriptor, large) - vector) < 0.25 * typical


def test_the_mirror_image_is_another(descriptor: SilhouetteDescriptor, masks: np.ndarray) -> None:
    away = [
        np.linalg.norm(described(descriptor, m[:, ::-1]) - described(descriptor, m))
        for m in masks[35::6]
    ]
    assert np.median(away) > 0.3 * spread(descriptor, masks[::6])


def test_neighbours_in_time_are_neighbours(
    descriptor: SilhouetteDescriptor, masks: np.ndarray
) -> None:
    rows = np.array([described(descriptor, m) for m in masks[:30]])
    near = np.median(np.linalg.norm(np.diff(rows, axis=0), axis=1))
    assert near < spread(descriptor, masks[:30:3])


def test_an_uneven_outline_changes_little(
    descriptor: SilhouetteDescriptor, masks: np.ndarray
) -> None:
    rng = np.random.default_rng(0)
    typical = spread(descriptor, masks[::6])
    for mask in masks[::12]:
        noisy = cv2.medianBlur((mask ^ (rng.random(mask.shape) < 0.02)).astype(np.uint8), 5)
        away = np.linalg.norm(described(descriptor, noisy) - described(descriptor, mask))
        assert away < 0.4 * typical


def test_arrays_bring_it_back(descriptor: SilhouetteDescriptor, masks: np.ndarray) -> None:
    again = SilhouetteDescriptor.from_arrays(descriptor.to_arrays(), 100)
    assert again.size == descriptor.size == 40
    np.testing.assert_allclose(
        described(again, masks[3]), described(descriptor, masks[3]), rtol=1e-4, atol=1e-4
    )


def test_it_learns_the_same_from_the_same(
    descriptor: SilhouetteDescriptor, masks: np.ndarray
) -> None:
    again = learned_descriptor(
        [silhouette_parts(x) for x in masks], codebook_size=30, components=40
    )
    np.testing.assert_array_equal(again.basis, descriptor.basis)


@pytest.mark.parametrize('name', ['basis', 'scale'])
def test_damaged_arrays(descriptor: SilhouetteDescriptor, name: str) -> None:
    arrays = descriptor.to_arrays()
    with pytest.raises(ValueError, match='wanted'):
        SilhouetteDescriptor.from_arrays(arrays | {name: arrays[name][:-1]}, 100)
    spoilt = arrays[name].copy()
    spoilt[0] = np.nan
    with pytest.raises(ValueError, match='finite'):
        SilhouetteDescriptor.from_arrays(arrays | {name: spoilt}, 100)


def test_nobody(descriptor: SilhouetteDescriptor) -> None:
    with pytest.raises(NoSilhouetteError):
        described(descriptor, np.zeros((240, 320)))


def test_one_silhouette_is_too_few(masks: np.ndarray) -> None:
    with pytest.raises(ValueError, match='2 silhouettes'):
        learned_descriptor([silhouette_parts(masks[0])])


def test_the_centred_view_undoes_place_and_lens() -> None:
    """The same person on the axis, and off axis through a distorting lens."""
    from hmt_ros.experts.pose_encoding import PoseEncoding

    body = load_body('human37')
    encoding = PoseEncoding(body)
    pose = procedural_motion('dance', body, 1, 1, 2)
    target = encoding.encode(pose)
    straight = encoding.decode(target, np.array([[0.0, 0.0, 4.0]]))
    aside = encoding.decode(target, 4.0 * np.array([[0.4, 0.1, np.sqrt(1 - 0.17)]]))
    lens = Camera(800.0, 800.0, 639.5, 479.5, 1280, 960, (-0.25, 0.06, 0.0, 0.0))
    plain = Camera(800.0, 800.0, 639.5, 479.5, 1280, 960)
    wanted = silhouette_parts(render_silhouettes(body, straight, plain)[0])
    for camera in (plain, lens):
        blob = person_blob(render_silhouettes(body, aside, camera)[0])
        assert not any(blob.cut)
        found, raw = silhouette_parts(centred_view(blob, camera)[0]), silhouette_parts(blob.mask)
        error, without = (np.abs(x.distances - wanted.distances).mean() for x in (found, raw))
        assert error < 0.006  # radii of gyration
        assert error < 0.62 * without


def test_parts_have_their_sizes(masks: np.ndarray) -> None:
    parts = silhouette_parts(masks[0], 70)
    assert parts.contexts.shape == (70, 60)
    assert parts.distances.shape == (256,)
    assert parts.moments.shape == (12,)
    assert np.isfinite(parts.moments).all()
    assert parts.moments[0] + parts.moments[1] == pytest.approx(1.0)


def test_unknown_edges_are_the_usual_ones(
    descriptor: SilhouetteDescriptor, masks: np.ndarray
) -> None:
    rng = np.random.default_rng(0)
    parts = [silhouette_parts(x) for x in masks]
    seen = [replace(x, edges=rng.random(EDGES)) for x in parts[::2]]
    mixed = learned_descriptor([*seen, *parts[1::2]], codebook_size=30, components=40)
    usual = np.mean([x.edges for x in seen], axis=0)
    found = mixed.describe([parts[0], replace(parts[0], edges=usual)])
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)


def test_the_image_of_a_person_in_a_corner(masks: np.ndarray) -> None:
    grey = np.tile(np.arange(320, dtype=np.uint8), (240, 1))
    whole = silhouette_parts(masks[3], grey=grey)
    rows, columns = np.nonzero(masks[3])
    cut = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    np.testing.assert_array_equal(
        silhouette_parts(masks[3][cut], grey=grey[cut]).edges, whole.edges
    )
