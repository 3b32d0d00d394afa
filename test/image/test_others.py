"""Pixels covered by other people count neither for a pose nor against it."""

import cv2
import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render, render_people
from hmt_learning.rendering.scene import Scene
from hmt_ros.body.camera import Camera
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import observe
from hmt_ros.image.terms.registry import TERMS
from test.oracles.single_terms import image_energy

VIEW = Viewpoint(distance=3.2)
SCENE = Scene(viewpoint=VIEW, seed=2)


@pytest.fixture(scope='module')
def camera():
    return Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope='module')
def pose(human32):
    return procedural_motion('reach', human32, 0.2, 10.0, 3, viewpoint=VIEW)[0]


@pytest.fixture(scope='module')
def seen(human32, camera, pose):
    """Image and silhouette of a person, and the half of the image that is unknown."""
    picture = render(human32, pose, camera, SCENE)
    others = np.zeros(picture.mask.shape, bool)
    middle = int(np.nonzero(picture.mask)[1].mean())
    others[:, :middle] = True
    return picture.image, picture.mask, others


def energies(human32, camera, poses, image, mask, others):
    """Energies by the name of the term."""
    silhouette = mask if others is None else mask & ~others
    observation = observe(image, silhouette, others=others)
    alone = {x.name: LikelihoodSettings.of_terms(**{x.name: x.settings}) for x in TERMS}
    return {
        name: image_energy(ImageLikelihood(human32, camera, settings), poses, observation).value
        for name, settings in alone.items()
    }


def test_nothing_changes_where_others_change(human32, camera, pose, seen):
    """Any content of the unknown half gives the same energies."""
    image, mask, others = seen
    poses = np.tile(pose, (3, 1))
    poses[1, 0] += 0.1
    poses[2, 7] += 0.3
    found = []
    for fill in (0, 255):
        other = image.copy()
        # Blurs and edges reach slightly beyond the border of the unknown region.
        inner = cv2.erode(others.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
        other[inner] = fill
        found.append(energies(human32, camera, poses, other, mask, others)['edges'])
    np.testing.assert_allclose(*found, rtol=1e-6)
    assert np.ptp(found[0]) > 0.1


def test_half_a_silhouette_does_not_punish_the_other_half(human32, camera, pose, seen):
    image, mask, others = seen
    known = energies(human32, camera, pose[None], image, mask & ~others, None)
    unknown = energies(human32, camera, pose[None], image, mask, others)
    whole = energies(human32, camera, pose[None], image, mask, None)
    # The border through the person is not an outline.
    assert unknown['coverage'] - whole['coverage'] < 0.2 * (known['coverage'] - whole['coverage'])


def test_a_silhouette_without_others(human32, camera, pose, seen):
    image, _, others = seen
    empty = np.rint(SCENE.background(camera)).astype(np.uint8)
    model = BackgroundModel.from_image(empty)
    whole, part = model.split(image).foreground, model.split(image, None, others).foreground
    assert (whole & ~others).sum() > 0.9 * part.sum() > 0
    assert not part[others].any()
    # The same image again needs no subtraction; another one does.
    changed = model.changed
    model.split(empty)
    assert model.changed < changed


def test_people_hide_each_other_as_a_whole(human32, camera, pose):
    behind = pose.copy()
    behind[2] += 1.0
    for order in ([pose, behind], [behind, pose]):
        image, owners = render_people([human32] * 2, order, camera, SCENE)
        near = [np.array_equal(x, pose) for x in order].index(True)
        alone = render(human32, pose, camera, SCENE).mask
        np.testing.assert_array_equal(owners == near, alone)
        assert image.shape == (240, 320, 3)
        assert (owners == 1 - near).any()
