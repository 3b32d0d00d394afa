from dataclasses import replace

import cv2
import numpy as np
import pytest

from hmt_learning.motion.limb_motions import arm_posture
from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render, render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera, load_body
from hmt_ros.body.flesh import Flesh
from hmt_ros.body.kinematics import forward
from hmt_ros.body.rasterisation import render_silhouettes
from test.oracles.numpy_contour import occluding_contour, surface

VIEW = Viewpoint(distance=3.2)
BARE = Scene(viewpoint=VIEW, noise=0.0, shadow=0.0, clutter=2)


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def poses(body):
    return np.concatenate(
        [procedural_motion(name, body, 2.4, 2.5, 3, viewpoint=VIEW) for name in ('walk', 'dance')]
    )


def camera(factor=1.0, distortion=()):
    focal, size = 330.0 * factor, (round(320 * factor), round(240 * factor))
    return Camera(focal, focal, 160.0 * factor - 0.5, 120.0 * factor - 0.5, *size, distortion)


def standing(body, **angles):
    pose = np.zeros(body.dimension)
    pose[:3] = VIEW.to_camera([0.0, 0.0, 0.95])
    for name, angle in angles.items():
        pose[body.dof_names.index(name)] = angle
    return pose


def distance_to(mask):
    """Distance of every pixel to the nearest one in the mask, px."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


@pytest.mark.parametrize('distortion', [(), (-0.25, 0.06, 0.002, -0.001)])
def test_mask_ends_at_the_occluding_contour(body, poses, distortion):
    view = camera(2.0, distortion)
    flesh = Flesh(body.flesh.parts, (80,) * len(body.flesh.parts))
    for pose, mask in zip(poses, render_silhouettes(body, poses, view)):
        contour = occluding_contour(flesh, forward(body.skeleton, pose[None]))
        pixels = view.project(contour.points[contour.exists[:, 0], :, 0])
        inside = np.all((pixels > 1) & (pixels < [view.width - 2, view.height - 2]), axis=1)
        u, v = np.rint(pixels[inside]).astype(int).T
        gaps = distance_to(mask)[v, u]
        assert np.quantile(gaps, 0.999) <= 1.5
        assert gaps.max() <= 2.0

        # And vice versa, except for the tips of the parts, which have no ring.
        drawn = np.zeros_like(mask)
        drawn[v, u] = True
        edge = mask & (distance_to(~mask) <= 1.0)
        edge[[0, -1]] = edge[:, [0, -1]] = False
        away = distance_to(drawn)[edge]
        assert np.mean(away <= 1.5) > 0.97
        assert away.max() < 9.0


def test_depth_is_that_of_the_surface(body):
    near = Viewpoint(distance=1.6)
    pose = standing(body)
    pose[:3] = near.to_camera([0.0, 0.0, 0.95])
    view = camera(1.5)
    shown = render(body, pose, view, Scene(viewpoint=near, clutter=0))
    frames = forward(body.skeleton, pose[None])
    rng = np.random.default_rng(0)
    checked = 0
    for index, part in enumerate(body.flesh.parts):
        local, normal = surface(part, rng.uniform(-0.95, 0.95, 200), rng.uniform(0, 2 * np.pi, 200))
        segments = np.full(200, part.segment)
        points = frames.points(segments, local)[:, :, 0]
        normals = frames.directions(segments, normal)[:, :, 0]
        facing = -(normals * points).sum(1) / np.linalg.norm(points, axis=1) > 0.6
        pixels = view.project(points[facing])
        seen = np.all((pixels > 0) & (pixels < [view.width - 1, view.height - 1]), axis=1)
        u, v = np.rint(pixels[seen]).astype(int).T
        z = points[facing][seen, 2]
        own = shown.parts[v, u] == index
        # Hiding surfaces are in front of it.
        assert np.all(shown.depth[v, u] < z + 0.006)
        error = np.abs(shown.depth[v, u] - z)[own]
        assert np.all(error < 0.006)
        checked += own.sum()
    assert checked > 300
    assert np.all(np.isinf(shown.depth[~shown.mask]))
    assert shown.depth.dtype == np.float32
    assert np.array_equal(shown.mask, np.isfinite(shown.depth))


def test_part_in_front_hides_the_other(body):
    # The right forearm points to the left in front of the trunk.
    hang, across = np.array([0.2, 0.2, -0.96]), np.array([-0.85, 0.5, 0.16])
    arms = arm_posture(body, [hang * [-1, 1, 1], hang], [hang * [-1, 1, 1], across])
    pose = standing(body, **arms)
    view = camera()
    shown = render(body, pose, view, BARE)
    names = [body.skeleton.segment_names[p.segment] for p in body.flesh.parts]
    joints = body.joint_positions(pose[None])[0]

    def label(a, b, share):
        i, j = body.skeleton.joint_index((a, b))
        point = joints[i] + share * (joints[j] - joints[i])
        u, v = np.rint(view.project(point)).astype(int)
        return names[shown.parts[v, u]]

    assert label('right_elbow', 'right_wrist', 0.5) == 'right_forearm'
    assert label('left_elbow', 'left_wrist', 0.5) == 'left_forearm'
    assert label('left_knee', 'left_ankle', 0.5) == 'left_shin'
    assert label('pelvis', 'neck', 0.9) == 'trunk'
    assert label('neck', 'head', 1.0) == 'head'
    # Seen from behind, the trunk hides the forearm.
    pose[body.dof_names.index('root_z')] = np.pi
    joints = body.joint_positions(pose[None])[0]
    shown = render(body, pose, view, BARE)
    assert label('right_elbow', 'right_wrist', 0.7) == 'trunk'


@pytest.mark.parametrize('place', [(20.0, 0.0, 5.0), (0.0, 0.0, -3.0), (0.0, -30.0, 2.0)])
@pytest.mark.parametrize('distortion', [(), (-0.3, 0.1, 0.0, 0.0)])
def test_nobody_in_view(body, place, distortion):
    pose = standing(body)
    pose[:3] = place
    view = camera(0.5, distortion)
    shown = render(body, pose, view, BARE)
    assert not shown.mask.any()
    assert np.all(shown.parts == -1)
    assert np.array_equal(shown.image, BARE.add_noise(BARE.background(view), 0))
    assert not render_silhouettes(body, pose[None], view).any()
    shaded = replace(BARE, shadow=0.8)
    assert np.array_equal(
        render(body, pose, view, shaded).image, shaded.add_noise(shaded.background(view), 0)
    )


def test_same_seed_same_bytes(body, poses):
    view, scene = camera(), Scene(viewpoint=VIEW, seed=5, clutter=3)
    first = list(render_frames(body, poses[:2], view, scene))
    again = render(
        load_body('human37'), poses[1], view, Scene(viewpoint=VIEW, seed=5, clutter=3), 1
    )
    for name in ('image', 'mask', 'parts', 'depth'):
        assert getattr(first[1], name).tobytes() == getattr(again, name).tobytes()
    other = render(body, poses[1], view, Scene(viewpoint=VIEW, seed=6, clutter=3), 1)
    assert np.array_equal(other.mask, again.mask)
    assert not np.array_equal(other.image, again.image)


def test_shadow_falls_on_the_floor_only(body, poses):
    view = camera()
    dark = Scene(viewpoint=VIEW, noise=0.0, shadow=0.9, clutter=2)
    shown, plain = render(body, poses[0], view, dark), render(body, poses[0], view, BARE)
    floor = dark.floor(view)
    # The scenes also differ in shadows of boxes, so each is compared with its empty place.
    empty = dark.add_noise(dark.background(view), 0).astype(int)
    away = distance_to(shown.mask) > 1.5
    change = (shown.image - empty).sum(2)
    assert np.all(change[away] <= 0)
    assert not change[away & (floor == 0)].any()
    assert change[away & (floor == 1)].min() < -60
    assert np.array_equal(shown.mask, plain.mask)


def test_clothes_stay_on_the_surface(body):
    """A point of the trunk has the same colour after the person has moved."""
    view = camera(1.5)
    scene = Scene(viewpoint=VIEW, noise=0.0, ambient=1.0, clutter=0)
    before = standing(body)
    after = standing(body, root_y=0.3)
    part = next(i for i, p in enumerate(body.flesh.parts) if p.taper == (0.1, 0.1))
    s, w = (x.ravel() for x in np.meshgrid(np.linspace(-0.6, 0.6, 15), np.linspace(-2.2, -0.9, 15)))
    local, _ = surface(body.flesh.parts[part], s, w)
    colours = []
    for pose in (before, after):
        points = forward(body.skeleton, pose[None]).points(
            np.full(len(local), body.flesh.parts[part].segment), local
        )
        shown = render(body, pose, view, scene)
        pixels = view.project(points[:, :, 0]).astype(np.float32)
        u, v = np.rint(pixels).astype(int).T
        assert np.all(shown.parts[v, u] == part)
        colours.append(cv2.remap(shown.image, pixels[:, None], None, cv2.INTER_LINEAR)[:, 0])
    difference = np.abs(colours[0].astype(float) - colours[1])
    assert colours[0].std() > 20
    assert np.median(difference) < 8
