"""Maps computed from an image, against brute force and known answers."""

import numpy as np
import pytest

from hmt_ros.image.observation import MARGIN, observe
from hmt_ros.image.terms.edges import ORIENTATIONS
from hmt_ros.image.terms.image_term import ImageWindow
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.silhouette import outline

SIZE = (120, 160)


def grey(size=SIZE, value=90):
    return np.full((*size, 3), value, dtype=np.uint8)


def disc(centre=(80, 60), radius=25, size=SIZE):
    v, u = np.mgrid[: size[0], : size[1]]
    return (u - centre[0]) ** 2 + (v - centre[1]) ** 2 < radius**2


def whole(image_map, channel=0, size=SIZE, fill=np.nan):
    """A map on the grid of the whole image; `fill` where its window does not reach."""
    result = np.full(size, fill)
    values, left, top = image_map
    h, w = values.shape[1:]
    result[top : top + h, left : left + w] = values[channel]
    return result


def test_the_window_holds_the_silhouette_and_its_margin():
    size = (240, 320)
    mask = disc((160, 120), size=size)
    values, left, top = observe(grey(size), mask).evidence['edges']
    assert (left, top) == (160 - 24 - MARGIN, 120 - 24 - MARGIN)
    assert values.shape == (ORIENTATIONS, 49 + 2 * MARGIN, 49 + 2 * MARGIN)


def test_outline_points_are_even_and_their_normals_point_outwards():
    window = ImageWindow(grey(), 0, 0, disc().astype(np.uint8), None)
    pixels, normals, beliefs = outline(window, 60)
    assert len(pixels) == 60
    assert (beliefs == 1.0).all()
    offset = pixels - [80, 60]
    radius = np.linalg.norm(offset, axis=1)
    assert np.allclose(radius, 25, atol=0.8)
    assert ((offset / radius[:, None]) * normals).sum(1).min() > 0.98
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    gaps = np.linalg.norm(np.roll(pixels, -1, axis=0) - pixels, axis=1)
    assert gaps.max() < 1.5 * gaps.mean()


def test_the_border_of_what_may_be_the_person_is_doubted():
    mask = disc()
    unsure = np.zeros_like(mask)
    unsure[:, 80:] = disc(radius=40)[:, 80:] & ~mask[:, 80:]
    sure, found = (observe(grey(), mask, unsure=x) for x in (None, unsure))
    pixels, _, beliefs = found.outline
    right, left = pixels[:, 0] > 84, pixels[:, 0] < 76
    assert (beliefs[left] == 1.0).all()
    assert (beliefs[right] < 0.5).all()
    assert (sure.outline.beliefs == 1.0).all()


@pytest.mark.parametrize('quarter', range(ORIENTATIONS))
def test_edges_stand_in_the_bin_of_their_normal(quarter):
    """A dark half-plane whose normal is at quarter * 45 degrees."""
    angle = quarter * np.pi / ORIENTATIONS
    normal = np.array([np.cos(angle), np.sin(angle)])
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    signed = (u - 80) * normal[0] + (v - 60) * normal[1]
    image = grey(value=40)
    image[signed > 0] = 200
    edges = observe(image).evidence['edges']
    interior = (slice(20, 100), slice(20, 140))
    own = whole(edges, quarter)[interior]
    across = whole(edges, (quarter + 2) % ORIENTATIONS)[interior]
    assert np.abs(own - np.abs(signed[interior])).max() < 3.0
    # There is no edge in the perpendicular direction.
    assert across.min() >= 100


@pytest.mark.parametrize(
    'mask',
    [disc((0, 60)), disc((159, 119)), disc((80, 60), 400), disc((80, 60), 2), disc((3, 3), 2)],
    ids=['left', 'corner', 'everywhere', 'tiny', 'tiny in a corner'],
)
def test_a_person_cut_by_the_border_or_hardly_seen(mask):
    image = grey()
    image[mask] = 30
    observation = observe(image, mask, last_image=grey())
    assert np.isfinite(observation.evidence['edges'].values).all()
    assert np.isfinite(observation.outline.pixels).all()
    assert np.isfinite(observation.outline.normals).all()
    height, width = observation.evidence['edges'].values.shape[1:]
    assert height >= 2
    assert width >= 2
    assert observation.evidence['edges'].left >= 0
    assert observation.evidence['edges'].left + width <= SIZE[1]


def test_input_that_contradicts_itself_is_refused():
    with pytest.raises(ValueError, match=r'image must be \(H, W, 3\) uint8'):
        observe(np.zeros(SIZE, dtype=np.uint8))
    with pytest.raises(ValueError, match=r'image must be \(H, W, 3\) uint8'):
        observe(np.zeros((*SIZE, 3)))
    with pytest.raises(ValueError, match='silhouette'):
        observe(grey(), np.zeros((10, 10), dtype=bool))
    with pytest.raises(ValueError, match='2 keypoints'):
        Keypoints(('a', 'b'), np.zeros((3, 2)), np.zeros((2, 2, 2)), np.ones(2))
