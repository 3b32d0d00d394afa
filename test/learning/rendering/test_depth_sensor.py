import numpy as np
import pytest

from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import NOISE, sensed_depth
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera

CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


def wall(depth):
    return np.full((240, 320), float(depth))


@pytest.mark.parametrize('z', [1.0, 2.0, 4.0, 8.0])
def test_the_error_grows_with_the_square_of_the_depth(z):
    seen = 1e-3 * sensed_depth(wall(z), CAMERA, seed=1)
    known = seen[seen > 0]
    assert np.std(known) == pytest.approx(NOISE * z * z, rel=0.15, abs=5e-4)
    assert np.mean(known) == pytest.approx(z, rel=0.01)


def test_something_near_casts_a_shadow_on_one_side():
    scene = wall(4.0)
    scene[:, 150:200] = 1.5
    seen = sensed_depth(scene, CAMERA, seed=1)
    # 330 px * 0.05 m * (1 / 1.5 - 1 / 4) is 7 px.
    assert (seen[:, 144:149] == 0).mean() > 0.95
    assert (seen[:, 202:212] == 0).mean() < 0.1


def test_the_same_seed_gives_the_same_depths():
    one, other = (sensed_depth(wall(3.0), CAMERA, seed=5, frame=2) for _ in range(2))
    assert np.array_equal(one, other)
    assert not np.array_equal(one, sensed_depth(wall(3.0), CAMERA, seed=5, frame=3))
    assert not np.array_equal(one, sensed_depth(wall(3.0), CAMERA, seed=6, frame=2))


def test_the_depth_of_an_empty_scene():
    """The floor agrees with the camera's height, and furniture stands in front of the wall."""
    camera = Camera(330.0, 330.0, 159.5, 119.5, 320, 240, (-0.2, 0.05, 0.001, 0.0))
    scene = Scene(viewpoint=Viewpoint(distance=3.0, height=1.5, pitch=0.3), seed=1)
    depth = scene.depth(camera)
    rays = camera.rays(np.array([[160.0, 239.0]]))
    place = scene.viewpoint.to_world(rays / rays[:, 2:] * depth[239, 160])
    assert place[0, 2] == pytest.approx(0.0, abs=1e-9)
    without = Scene(viewpoint=scene.viewpoint, seed=1, clutter=0).depth(camera)
    assert (depth <= without + 1e-9).all()
    assert (depth < without - 0.1).any()
