"""The depth term, compared with numpy, finite differences, and scenes of known depth."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from hmt_learning.rendering.renderer import render, sensed_depth
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.core import ASIDE, BEHIND, COVER, DEPTH_JUMP, MIN_COSINE, MIN_POINTS
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Beliefs, observe
from hmt_ros.image.surface import flesh_table_of
from hmt_ros.image.terms.depth import DEPTH, usable_depths
from test.oracles.numpy_contour import signed_power
from test.oracles.single_terms import image_energy

ALONE = LikelihoodSettings.of_terms(depth=DEPTH.settings)


@pytest.fixture(scope='module')
def true_depth(shot):
    """Depth from a perfect sensor at the second pose; inf if nothing is there."""
    return render(shot.body, shot.poses[1], shot.camera, Scene(seed=2)).depth


@pytest.fixture(scope='module')
def sensed(shot, true_depth):
    """Depth from a sensor, with a wall at 5 m, m."""
    return 1e-3 * sensed_depth(np.minimum(true_depth, 5.0), shot.camera, seed=4)


@pytest.fixture(scope='module')
def likelihood(shot):
    return ImageLikelihood(shot.body, shot.camera, ALONE)


def seen(shot, depth, **more):
    return observe(shot.images[1], shot.masks[1], depth=depth, **more)


# A plain numpy twin, one pose and one point at a time.


def front_points(body, pose):
    """(segment, part, local position, local normal) of the points that face the camera."""
    frames = forward(body.skeleton, pose[None])
    rings, parts = body.flesh.rings, body.flesh.ring_parts
    noise = flesh_table_of(body).ring_noise
    found = []
    for side, r in product((-1, 1), range(len(parts))):
        segment = body.flesh.parts[parts[r]].segment
        rotation, origin = frames.columns[segment, :, :, 0].T, frames.origins[segment, :, 0]
        to_centre = rotation.T @ origin + rings.centre[r]
        lateral = (to_centre[:2] - to_centre[2] * rings.lean[r]) / rings.radius[r]
        angle = np.arctan2(-lateral[1], -lateral[0]) + side * ASIDE
        circle = np.array([np.cos(angle), np.sin(angle)])
        place = rings.centre[r].copy()
        place[:2] += rings.radius[r] * signed_power(circle, rings.exponent[r])
        across = signed_power(circle, 2.0 - rings.exponent[r]) / rings.radius[r]
        along = -(rings.slope[r] @ circle**2) - across @ rings.lean[r]
        normal = np.append(across, along)
        deviation = np.hypot(*(circle * noise[r]))
        found.append((segment, parts[r], place, normal / np.linalg.norm(normal), deviation))
    return found


def is_hidden(body, frames, part, point):
    """Whether the ellipsoid of another part is in front of a point (3,)."""
    for b, other in enumerate(body.flesh.parts):
        if b == part:
            continue
        axes = frames.columns[other.segment, :, :, 0].T
        centre = frames.origins[other.segment, :, 0] + axes @ np.array(other.centre)
        shape = axes.T / (COVER * np.array(other.radii))[:, None]
        m, k = shape @ point, shape @ centre
        root = (m @ k) ** 2 - m @ m * (k @ k - 1.0)
        if root > 0 and m @ k - np.sqrt(root) < (1.0 - BEHIND) * (m @ m):
            return True
    return False


def measured_at(depth, u, v):
    """Depth at a pixel, bilinear on a surface, nearest at its ends; 0 if not measured."""
    height, width = depth.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return 0.0
    i, j = min(int(v), height - 2), min(int(u), width - 2)
    cell, dv, du = depth[i : i + 2, j : j + 2].astype(float), v - i, u - j
    if cell.min() <= 0 or np.ptp(cell) > DEPTH_JUMP * cell.min():
        return cell[int(dv >= 0.5), int(du >= 0.5)]
    return np.array([1 - dv, dv]) @ cell @ np.array([1 - du, du])


def oracle_energy(body, camera, settings, depth, pose, held=None, factors=None):
    """The energy of a pose; `held` are points of another pose, fixed on the skin.

    `factors` (S,) are the factors of the segments; None means 1.
    """
    points = oracle_points(body, camera, settings, depth, pose) if held is None else held
    frames = forward(body.skeleton, pose[None])
    costs = []
    for segment, place, sigma in points:
        point = frames.points(np.array([segment]), place[None])[0, :, 0]
        z = measured_at(depth, *camera.project(point[None])[0])
        error = (z - point[2]) / sigma if z > 0 else 1.0
        factor = 1.0 if factors is None else factors[segment]
        costs.append(factor * 0.5 * error**2 / (1.0 + error**2 / settings.scale**2))
    return settings.weight * np.sum(costs) / max(len(points), MIN_POINTS)


def oracle_points(body, camera, settings, depth, pose):
    """(segment, local position, residual deviation) of the visible points of a pose."""
    frames = forward(body.skeleton, pose[None])
    points = []
    for segment, part, place, normal, deviation in front_points(body, pose):
        point = frames.points(np.array([segment]), place[None])[0, :, 0]
        ahead = frames.points(np.array([segment]), (place + normal)[None])[0, :, 0] - point
        cosine = -(ahead @ point) / np.linalg.norm(point)
        if cosine > MIN_COSINE and point[2] > 0.1 and not is_hidden(body, frames, part, point):
            z = measured_at(depth, *camera.project(point[None])[0])
            variance = settings.sigma**2 + (settings.growth * z * z) ** 2
            points.append((segment, place, np.sqrt(variance + (deviation / cosine) ** 2)))
    return points


@pytest.mark.parametrize('distortion', [(), (-0.25, 0.06, 0.002, -0.001, 0.01)])
def test_the_kernel_equals_numpy(shot, sensed, distortion):
    c = shot.camera
    camera = Camera(c.fx, c.fy, c.cx, c.cy, c.width, c.height, distortion)
    likelihood = ImageLikelihood(shot.body, camera, ALONE)
    poses = np.concatenate([shot.near(5, 1), shot.near(3, 2, spread=0.5)])
    found = image_energy(likelihood, poses, seen(shot, sensed)).value
    # Outside the evaluated window nothing is known.
    whole = observe(shot.images[1], depth=sensed)
    found = image_energy(likelihood, poses, whole).value
    depth = usable_depths(sensed)
    wanted = [oracle_energy(shot.body, camera, DEPTH.settings, depth, pose) for pose in poses]
    assert np.allclose(found, wanted, rtol=1e-9)
    assert np.ptp(wanted) > 1.0


def with_factors(shot, sensed):
    """Depths with a reliability factor for each segment, and these factors."""
    factors = np.random.default_rng(3).uniform(0.0, 2.0, len(shot.body.skeleton.parents))
    beliefs = Beliefs(1.0, np.ones(3), 1.0, {'depth': factors})
    return replace(observe(shot.images[1], depth=sensed), beliefs=beliefs), factors


def test_the_kernel_equals_numpy_where_segments_have_factors(shot, sensed, likelihood):
    poses = shot.near(4, 1)
    # Points without a measurement have a cost, too.
    for given in (sensed, 0.0 * sensed + 2.0 * (np.arange(sensed.shape[1]) < 160)):
        observation, factors = with_factors(shot, given)
        depth = usable_depths(given)
        wanted = [
            oracle_energy(shot.body, shot.camera, DEPTH.settings, depth, pose, None, factors)
            for pose in poses
        ]
        assert np.allclose(image_energy(likelihood, poses, observation).value, wanted, rtol=1e-9)


@pytest.mark.parametrize('weighed', [False, True], ids=['usual', 'factors'])
def test_gradient_at_material_points(shot, sensed, likelihood, weighed):
    """The gradient is that of points fixed on the skin, with fixed deviations."""
    poses, step = shot.near(2, 7), 1e-6
    depth = usable_depths(sensed)
    observation, factors = observe(shot.images[1], depth=sensed), None
    if weighed:
        observation, factors = with_factors(shot, sensed)
    found = image_energy(likelihood, poses, observation).gradient
    for pose, gradient in zip(poses, found):
        held = oracle_points(shot.body, shot.camera, DEPTH.settings, depth, pose)
        wanted = np.empty(len(pose))
        for j in range(len(pose)):
            shift = step * (np.arange(len(pose)) == j)
            up, down = (
                oracle_energy(shot.body, shot.camera, DEPTH.settings, depth, x, held, factors)
                for x in (pose + shift, pose - shift)
            )
            wanted[j] = (up - down) / (2 * step)
        assert np.abs(gradient - wanted).max() < 1e-5 * np.abs(wanted).max()


def test_the_hessian_is_positive_semidefinite(shot, sensed, likelihood):
    found = image_energy(likelihood, shot.near(6, 5, spread=0.3), seen(shot, sensed)).hessian
    assert np.allclose(found, found.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(found).min() > -1e-8 * np.abs(found).max()


# Information of the term.


def test_the_noise_grows_with_the_square_of_the_distance(shot, true_depth):
    """An error of 5 % costs less far away; without growth only the flesh's noise counts."""
    costs = []
    for growth in (0.0, 0.002, 0.02):
        settings = replace(ALONE, depth=replace(DEPTH.settings, growth=growth))
        likelihood = ImageLikelihood(shot.body, shot.camera, settings)
        depth = np.where(np.isfinite(true_depth), true_depth + 0.05, 0.0)
        costs.append(image_energy(likelihood, shot.poses[1:], seen(shot, depth)).value[0])
    z = shot.poses[1, 2]
    assert costs[0] > costs[1] > costs[2]
    # At growth 0.02 the deviation is 0.2 m, which is all that counts; the rest is what is cut off.
    assert costs[2] == pytest.approx(0.5 * 30.0 * (0.05 / (0.02 * z * z)) ** 2, abs=1.5)


@pytest.mark.parametrize('other', [0.4, 9.0], ids=['occluder', 'background'])
def test_other_surfaces_cost_at_most_what_the_kernel_allows(shot, sensed, likelihood, other):
    """A hidden pose, or one in front of an empty scene, is not pulled to other surfaces."""
    depth = np.full_like(sensed, other)
    found = image_energy(likelihood, shot.poses[1:], seen(shot, depth))
    most = 0.5 * DEPTH.settings.weight * DEPTH.settings.scale**2
    assert 0.9 * most < found.value[0] <= most
    right = image_energy(
        likelihood, shot.poses[1:] + 0.05 * (np.arange(37) == 2), seen(shot, sensed)
    )
    assert np.abs(found.gradient).max() < 0.05 * np.abs(right.gradient).max()


def test_depth_tells_which_way_a_forearm_points(shot, true_depth, likelihood):
    """Forearms towards and away from the camera look the same, but their depths differ."""
    body, camera = shot.body, shot.camera
    pose = np.clip(np.zeros(body.dimension), body.lower, body.upper)
    pose[:3] = [0.0, 0.0, 3.0]
    names = list(body.dof_names)
    towards, away = pose.copy(), pose.copy()
    towards[names.index('left_shoulder_x')] = 0.6
    away[names.index('left_shoulder_x')] = -0.6
    seen_depth = render(body, towards, camera, Scene(seed=1)).depth
    observation = observe(shot.images[1], depth=np.where(np.isfinite(seen_depth), seen_depth, 5.0))
    value = image_energy(likelihood, np.stack([towards, away]), observation).value
    assert value[1] - value[0] > 5.0


def test_depth_of_somebody_else_says_nothing(shot, sensed):
    """Depth of people who occlude the person is not the person's."""
    others = np.zeros(shot.masks[1].shape, dtype=bool)
    others[:, 100:180] = True
    nearer = np.where(others, 0.5 * sensed, sensed)
    found = seen(shot, nearer, others=others).evidence['depth']
    values = found.values[0][:, 100 - found.left : 180 - found.left]
    assert values.size
    assert not values.any()
    assert found.values.any()
