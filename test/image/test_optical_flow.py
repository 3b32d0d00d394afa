"""The optical flow between two images, and the energy of poses against it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hmt_ros.body import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.observation import observe
from hmt_ros.image.optical_flow import FlowTerm
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import seen_points
from hmt_ros.inference.energy import Derivatives
from test.oracles import numpy_likelihood as oracle
from test.oracles.single_terms import energy_of

WEIGHT = 5.0
LENSES = {
    'pinhole': ((), 'plumb_bob'),
    'plumb_bob': ((-0.25, 0.06, 0.002, -0.001, 0.01), 'plumb_bob'),
    'fisheye': ((0.02, -0.01, 0.003, 0.001), 'equidistant'),
}


def term_of(shot, camera, flow, poses):
    frames = forward(shot.body.skeleton, poses)
    points = seen_points(shot.body, camera, frames)
    return FlowTerm(points, flow, WEIGHT)


@pytest.fixture(scope='module')
def flow(shot) -> ImageMap:
    return observe(shot.images[1], shot.masks[1], last_image=shot.images[0]).flow


@pytest.fixture(scope='module')
def before(shot):
    """Three poses in the image before."""
    return np.concatenate([shot.poses[:1], shot.near(2, 9)])


def relative_difference(found, wanted):
    return np.abs(found - wanted).max() / np.abs(wanted).max()


def test_the_flow_is_the_shift_between_the_images():
    rng = np.random.default_rng(1)
    noise = np.kron(rng.integers(0, 255, (40, 50)), np.ones((4, 4))).astype(np.uint8)
    big = np.repeat(noise[:, :, None], 3, axis=2)
    first, last = big[10:130, 10:170].copy(), big[7:127, 5:165].copy()
    flow = observe(last, last_image=first).flow
    middle = [np.median(channel[40:80, 60:100]) for channel in flow.values]
    assert middle == pytest.approx([5.0, 3.0], abs=0.5)


@pytest.mark.parametrize('lens', LENSES)
@pytest.mark.parametrize('spread', [0.05, 0.5])
def test_energies_equal_numpy(shot, flow, before, lens, spread):
    """This holds also where limbs leave the image or are behind the camera."""
    c = shot.camera
    camera = Camera(c.fx, c.fy, c.cx, c.cy, c.width, c.height, *LENSES[lens])
    term = term_of(shot, camera, flow, before)
    poses, rows = shot.near(24, 1, spread=spread), np.arange(24) % 3
    poses[:4, 2] -= 3.0
    frames = forward(shot.body.skeleton, poses)
    found = energy_of(term, shot.body, poses, rows, camera=camera)
    wanted = oracle.flow_energy(frames, camera, term.points, rows, flow, WEIGHT)
    for a, b in zip(found, wanted):
        assert relative_difference(a, b) <= 1e-9
    values = energy_of(term, shot.body, poses, rows, camera=camera, derivatives=Derivatives.NONE)
    assert np.array_equal(values.value, found.value)
    assert values.gradient is None


def test_the_gradient_is_that_of_the_energy(shot, flow, before):
    term = term_of(shot, shot.camera, flow, before)
    poses, rows, step = shot.near(8, 6), np.zeros(8, dtype=np.intp), 1e-6

    def value(x):
        return energy_of(term, shot.body, x, rows, camera=shot.camera).value

    found = energy_of(term, shot.body, poses, rows, camera=shot.camera).gradient
    wanted = np.empty_like(poses)
    for j, shift in enumerate(step * np.eye(poses.shape[1])):
        wanted[:, j] = (value(poses + shift) - value(poses - shift)) / (2 * step)
    assert relative_difference(found, wanted) < 1e-6


def test_where_the_points_went_costs_nothing(shot, before):
    """The flow of the pose's own motion costs nothing; a pose that did not move pays for all."""
    pose = before[:1]
    moved = pose.copy()
    moved[0, 0] += 0.05
    term = term_of(shot, shot.camera, ImageMap(np.zeros((2, 2, 2), np.float32)), pose)
    shift = shot.camera.fx * 0.05 / pose[0, 2]
    flow = np.zeros((2, shot.camera.height, shot.camera.width), np.float32)
    flow[0] = shift
    term = FlowTerm(term.points, ImageMap(flow), WEIGHT)
    there, stayed = (
        energy_of(term, shot.body, x, camera=shot.camera).value[0] for x in (moved, pose)
    )
    assert there < 0.05 * stayed


def test_the_flow_is_of_the_window_around_the_person(shot, flow):
    """A margin around the silhouette, as all evidence."""
    rows, columns = np.nonzero(shot.masks[1])
    height, width = flow.values.shape[1:]
    assert flow.left < columns.min() <= columns.max() < flow.left + width
    assert flow.top < rows.min() <= rows.max() < flow.top + height
    grey = [cv2.cvtColor(x, cv2.COLOR_BGR2GRAY) for x in shot.images]
    moved = np.abs(grey[1].astype(int) - grey[0]) > 20
    assert np.abs(flow.values).max() > 0.5 or not moved.any()
