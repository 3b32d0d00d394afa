"""Silhouettes by background subtraction, for synthetic scenes and a rendered person."""

import cv2
import numpy as np
import pytest

from hmt_ros.image.background import BackgroundModel, BackgroundSettings

METHODS = ('mog2', 'knn')


@pytest.fixture(scope='module')
def scene():
    """An empty scene (120, 160, 3) with some texture."""
    rng = np.random.default_rng(0)
    return cv2.GaussianBlur(rng.integers(60, 200, (120, 160, 3)).astype(np.uint8), (0, 0), 3)


def noisy(image, seed, sigma=2.0):
    noise = np.random.default_rng(seed).normal(0, sigma, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def model(scene, method):
    return BackgroundModel.from_image(scene, BackgroundSettings(method=method))


@pytest.mark.parametrize('method', METHODS)
def test_what_differs_is_found_and_the_empty_scene_is_empty(scene, method):
    background = model(scene, method)
    assert not background.silhouette(noisy(scene, 1)).any()
    image = noisy(scene, 2)
    image[30:90, 60:90] = (10, 240, 30)
    found = background.silhouette(image)
    assert found.dtype == bool
    wanted = np.zeros(found.shape, dtype=bool)
    wanted[30:90, 60:90] = True
    assert (found ^ wanted).sum() <= 4


@pytest.mark.parametrize('method', METHODS)
def test_shadow_is_no_foreground(scene, method):
    background = model(scene, method)
    image = scene.copy()
    image[20:100, 10:50] = (0.6 * image[20:100, 10:50]).astype(np.uint8)
    image[30:90, 60:90] = (10, 240, 30)
    found = background.silhouette(image)
    assert found[20:100, 10:50].mean() < 0.01
    assert found[30:90, 60:90].mean() > 0.99
    strict = BackgroundModel.from_image(
        scene, BackgroundSettings(method=method, shadow_threshold=0.9)
    )
    assert strict.silhouette(image)[20:100, 10:50].mean() > 0.9


def test_what_is_found_does_not_depend_on_images_before():
    scene = np.full((60, 80, 3), 100, np.uint8)
    # A difference just above the threshold, which any drift of the variance would change.
    image = scene + 10
    background = model(scene, 'mog2')
    assert background.foreground(image).all()
    for brighter in (6, 4, 6):
        background.foreground(scene + brighter)
    assert background.foreground(image.copy()).all()


@pytest.mark.parametrize('method', METHODS)
def test_background_learned_while_a_person_walks_through(scene, method):
    background = BackgroundModel(BackgroundSettings(method=method))
    with pytest.raises(ValueError, match='no background has been learned'):
        background.silhouette(scene)
    for i in range(40):
        image = noisy(scene, i)
        image[30:90, 4 * i : 4 * i + 20] = (10, 240, 30)
        background.learn(image)
    assert background.frames == 40
    image = noisy(scene, 99)
    image[40:100, 100:130] = (200, 20, 30)
    found = background.silhouette(image)
    assert found[40:100, 100:130].mean() > 0.97
    found[38:102, 98:132] = False
    assert found.mean() < 0.01


@pytest.mark.parametrize('method', METHODS)
def test_asking_for_a_silhouette_does_not_teach(scene, method):
    background = model(scene, method)
    image = scene.copy()
    image[30:90, 60:90] = (10, 240, 30)
    first = background.silhouette(image)
    for _ in range(20):
        last = background.silhouette(image)
    assert np.array_equal(first, last)


def test_small_and_distant_pieces_are_left_out(scene):
    background = BackgroundModel.from_image(
        scene, BackgroundSettings(smallest_part=0.02, largest_gap=0.2)
    )
    image = scene.copy()
    image[30:90, 60:90] = (10, 240, 30)  # 60 high: pieces within 12 px are the person's
    image[40:60, 96:106] = (10, 240, 30)
    image[40:60, 130:140] = (10, 240, 30)
    image[75:80, 98:103] = (10, 240, 30)
    found = background.silhouette(image)
    assert found[40:60, 96:106].mean() > 0.9
    assert not found[:, 120:].any()
    assert not found[70:85, 92:110].any()


@pytest.mark.parametrize('method', METHODS)
def test_an_image_of_another_size_is_refused_and_changes_nothing(scene, method):
    background = model(scene, method)
    image = scene.copy()
    image[30:90, 60:90] = (10, 240, 30)
    before = background.silhouette(image)
    for wrong in (scene[:60], scene[:, :80], scene[:, :, 0]):
        with pytest.raises(ValueError, match=r'\(60|80|120'):
            background.silhouette(np.ascontiguousarray(wrong))
    assert np.array_equal(background.silhouette(image), before)
    assert before.sum() > 1700


@pytest.mark.parametrize('method', METHODS)
def test_a_background_with_a_person_in_it_is_put_together_anew(scene, method):
    """The person stood at the left during learning, and walks to the right."""
    background = BackgroundModel(BackgroundSettings(method=method))

    def shown(left, seed):
        image = noisy(scene, seed)
        image[30:90, left : left + 30] = (10, 240, 30)
        person = np.zeros(image.shape[:2], dtype=bool)
        person[25:95, max(left - 5, 0) : left + 35] = True
        return image, person

    for i in range(10):
        background.learn(shown(40, i)[0])
    assert background.unknown is None
    image, person = shown(40, 10)
    assert background.silhouette(image)[30:90, 40:70].mean() < 0.02
    background.complete(image, person)
    assert background.unknown is None
    background.forget()
    assert background.unknown.all()
    assert not background.foreground(image).any()
    for i in range(10):
        background.complete(*shown(40, 20 + i))
    # Only the area always covered by the person is unknown, and it is not foreground.
    assert np.array_equal(background.unknown, person)
    assert not background.silhouette(image).any()
    image[5:20, 100:130] = (10, 240, 30)
    assert background.foreground(image).sum() == pytest.approx(450, abs=5)
    for i in range(10):
        background.complete(*shown(100, 30 + i))
    assert background.unknown is None
    image, person = shown(60, 50)
    found = background.silhouette(image)
    assert found[30:90, 60:90].mean() > 0.99
    assert not found[~person].any()


def test_unknown_method_is_refused():
    with pytest.raises(ValueError, match="'median'"):
        BackgroundSettings(method='median')


@pytest.mark.parametrize('method', METHODS)
def test_rendered_person_with_shadow_and_noise(shot, method):
    background = BackgroundModel.from_image(shot.background, BackgroundSettings(method=method))
    for image, mask in zip(shot.images, shot.masks):
        found = background.silhouette(image)
        overlap = (found & mask).sum() / (found | mask).sum()
        assert overlap > 0.8


@pytest.mark.parametrize('method', METHODS)
def test_what_may_be_a_shadow_is_told_apart(scene, method):
    background = model(scene, method)
    image = scene.copy()
    image[20:100, 10:50] = (0.6 * image[20:100, 10:50]).astype(np.uint8)
    image[30:90, 60:90] = (10, 240, 30)
    found = background.split(image)
    assert np.array_equal(found.foreground, background.silhouette(image))
    assert found.unsure[22:98, 12:48].mean() > 0.95
    assert not (found.unsure & found.foreground).any()
    assert found.unsure[:, 100:].mean() < 0.01


def test_edges_of_the_background_that_move_by_a_pixel_are_no_foreground():
    empty = np.full((80, 120, 3), 90, np.uint8)
    empty[:, 60:] = (200, 60, 30)
    background = BackgroundModel.from_image(empty)
    moved = np.roll(empty, 1, axis=1)
    moved[:, 0] = 90
    # A person stands beside the edge.
    moved[20:60, 20:40] = (20, 220, 20)
    found = background.silhouette(moved)
    assert found[20:60, 20:40].all()
    assert not found[:, 50:].any()


@pytest.fixture(scope='module', params=[(480, 640), (481, 643), (720, 1280), (1080, 1920)], ids=str)
def large(request):
    """A large empty scene, an elliptical person in it, the mask, and the shorter half axis."""
    height, width = request.param
    rng = np.random.default_rng(3)
    coarse = rng.integers(60, 200, (24, 32, 3)).astype(np.uint8)
    empty = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    somebody = np.zeros((height, width), np.uint8)
    axes = (height // 12, height // 4)
    cv2.ellipse(somebody, (width // 2, height // 2), axes, 20.0, 0.0, 360.0, 1, -1)
    image = empty.copy()
    image[somebody > 0] = (10, 240, 30)
    return empty, noisy(image, 4), somebody > 0, axes[0]


@pytest.mark.parametrize('method', METHODS)
def test_large_images_are_made_smaller_and_the_outline_is_smooth(large, method):
    empty, image, wanted, _ = large
    background = model(empty, method)
    assert background.empty.shape[0] < 400
    found, unsure = background.split(image)
    assert found.shape == unsure.shape == wanted.shape
    # The outline is within one pixel of the reduced image from the true one.
    around = np.ones((3, 3), np.uint8)
    step = round(len(image) / 240)
    within = cv2.dilate(wanted.astype(np.uint8), around, iterations=step)
    inside = cv2.erode(wanted.astype(np.uint8), around, iterations=step)
    assert not (found & (within == 0)).any()
    assert found[inside > 0].all()
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.03)
