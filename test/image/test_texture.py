"""Textures: places on the surface, what is seen there, and limbs mirrored."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.observation import observe
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.texture import (
    FACING,
    Textures,
    capture_textures,
    no_textures,
    with_swapped_sides,
)

PAIRS = (('left_arm', 'right_arm'), ('left_leg', 'right_leg'))


@pytest.fixture(scope='module')
def intensity(shot) -> ImageMap:
    return observe(shot.images[1], shot.masks[1], wanted=('intensity',)).intensity


@pytest.fixture(scope='module')
def poses(shot):
    return shot.near(3, 0)


@pytest.fixture(scope='module')
def textures(shot, poses, intensity) -> Textures:
    return capture_textures(shot.body, shot.camera, forward(shot.body.skeleton, poses), intensity)


def used(textures, k):
    """Segments, places, pixels and colours of one pose, without the rest of its row."""
    return tuple(x[k, : textures.counts[k]] for x in textures[1:])


def in_space(body, pose, segments, local):
    frames = forward(body.skeleton, pose[None])
    rotations, origins = frames.rotations()[0], frames.origins[..., 0]
    return origins[segments] + np.einsum('pij,pj->pi', rotations[segments], local)


def inside(part, local):
    """Implicit function of a superquadric without bending [Barr 1984]; 1 on its surface."""
    e1, e2 = part.exponents
    x, y, z = ((local - np.array(part.centre)) / np.array(part.radii)).T
    # Tapering widens towards negative z, the far end of a segment.
    x, y = x / (1 - part.taper[0] * z), y / (1 - part.taper[1] * z)
    across = (np.abs(x) ** (2 / e2) + np.abs(y) ** (2 / e2)) ** (e2 / e1)
    return across + np.abs(z) ** (2 / e1)


def test_points_lie_on_the_surface(shot, textures):
    parts = {part.segment: part for part in shot.body.flesh.parts}
    assert len(parts) == len(shot.body.flesh.parts)
    assert not any(any(part.bend) for part in parts.values())
    for k in range(3):
        segments, local, _, _ = used(textures, k)
        assert textures.counts[k] == 120
        for segment in np.unique(segments):
            values = inside(parts[segment], local[segments == segment])
            assert np.allclose(values, 1.0, atol=1e-9)


def test_points_project_to_their_pixels(shot, poses, textures):
    for k, pose in enumerate(poses):
        segments, local, pixels, _ = used(textures, k)
        places = in_space(shot.body, pose, segments, local)
        assert np.abs(shot.camera.project(places) - pixels).max() < 1e-9
        assert (pixels >= 0).all()
        assert (pixels < [shot.camera.width, shot.camera.height]).all()


def test_a_lens_bends_the_pixels(shot, poses, intensity):
    c = shot.camera
    fisheye = Camera(
        c.fx, c.fy, c.cx, c.cy, c.width, c.height, (0.02, -0.01, 0.003, 0.001), 'equidistant'
    )
    textures = capture_textures(shot.body, fisheye, forward(shot.body.skeleton, poses), intensity)
    segments, local, pixels, _ = used(textures, 0)
    places = in_space(shot.body, poses[0], segments, local)
    assert np.abs(fisheye.project(places) - pixels).max() < 1e-9
    assert np.abs(c.project(places) - pixels).max() > 1.0


def test_colours_are_those_of_the_image(shot, textures, intensity):
    """Bilinear, by four weighted neighbours of the blurred image."""
    for k in range(3):
        _, _, pixels, colours = used(textures, k)
        u, v = pixels[:, 0] - intensity.left, pixels[:, 1] - intensity.top
        h, w = intensity.values.shape[1:]
        known = (u >= 0) & (u < w - 1.01) & (v >= 0) & (v < h - 1.01)
        assert known.sum() > 100
        u, v, colours = u[known], v[known], colours[known]
        j, i = np.floor(u).astype(int), np.floor(v).astype(int)
        wanted = np.zeros_like(colours)
        for down in (0, 1):
            for right in (0, 1):
                share = (1 - np.abs(u - j - right)) * (1 - np.abs(v - i - down))
                wanted += share[:, None] * intensity.values[:, i + down, j + right].T
        assert np.allclose(colours, wanted, atol=1e-3)


def test_colours_of_a_ramp_are_the_pixels(shot, poses):
    v, u = np.mgrid[: shot.camera.height, : shot.camera.width].astype(np.float32)
    ramp = ImageMap(np.stack([u, v, u + v]))
    textures = capture_textures(shot.body, shot.camera, forward(shot.body.skeleton, poses), ramp)
    for k in range(3):
        _, _, pixels, colours = used(textures, k)
        # Beyond the centres of the last pixels their values are continued.
        seen = np.minimum(pixels, [shot.camera.width - 1, shot.camera.height - 1])
        wanted = np.column_stack([seen, seen.sum(1)])
        assert np.abs(colours - wanted).max() < 3e-3


def test_points_face_the_camera_and_nothing_is_before_them(shot, poses, textures):
    """Along the ray to a point, short of it, no other part is met."""
    body = shot.body
    for k, pose in enumerate(poses):
        frames = forward(body.skeleton, pose[None])
        rotations, origins = frames.rotations()[0], frames.origins[..., 0]
        segments, local, _, _ = used(textures, k)
        places = in_space(body, pose, segments, local)
        ways = np.linspace(0.7, 0.99, 120)
        along = (ways[:, None, None] * places).reshape(-1, 3)
        owner = np.tile(segments, len(ways))
        for part in body.flesh.parts:
            turn = rotations[part.segment]
            seen_from = (along - origins[part.segment]) @ turn
            ellipsoid = (seen_from - np.array(part.centre)) / np.array(part.radii)
            met = (ellipsoid**2).sum(1) < 1
            assert not met[owner != part.segment].any()
            # The surface faces the camera: normals from the implicit function's slope.
            own = segments == part.segment
            if not own.any():
                continue
            rays = places[own] / np.linalg.norm(places[own], axis=1)[:, None]
            at_camera = rays @ turn
            steps = 1e-6 * np.eye(3)
            slopes = np.stack(
                [inside(part, local[own] + s) - inside(part, local[own] - s) for s in steps], axis=1
            )
            normals = slopes / np.linalg.norm(slopes, axis=1)[:, None]
            assert (-(normals * at_camera).sum(1)).min() > FACING - 1e-4


def test_few_points_are_spread_over_all(shot, poses, intensity, textures):
    """A coarser texture is a subset of the finest, from its beginning to its end."""
    frames = forward(shot.body.skeleton, poses)
    everything = capture_textures(shot.body, shot.camera, frames, intensity, points=5000)
    assert (everything.counts < 1000).all()
    few = capture_textures(shot.body, shot.camera, frames, intensity, points=20)
    for k in range(3):
        total = everything.counts[k]
        assert total >= 120
        for coarse, count in ((few, 20), (textures, 120)):
            assert coarse.counts[k] == count
            picked = np.arange(count) * total // count
            for a, b in zip(used(coarse, k), used(everything, k)):
                assert np.array_equal(a, b[picked])


def test_poses_are_captured_one_by_one(shot, poses, intensity, textures):
    for k, pose in enumerate(poses):
        alone = capture_textures(
            shot.body, shot.camera, forward(shot.body.skeleton, pose[None]), intensity
        )
        assert all(np.array_equal(a[0], b[k]) for a, b in zip(alone, textures))
    none = no_textures()
    assert all(len(x) == 0 for x in none)


def test_nobody_in_the_image_has_no_texture(shot, poses, intensity):
    away = poses.copy()
    away[0, 0] += 50.0
    away[1, 2] = -3.0
    textures = capture_textures(
        shot.body, shot.camera, forward(shot.body.skeleton, away), intensity
    )
    assert textures.counts[0] == textures.counts[1] == 0
    assert textures.counts[2] == 120


def mirrored(body, pose):
    """The pose of a person in a mirror across x = 0: sides change, turns about y and z reverse."""
    result = np.empty_like(pose)
    for i, name in enumerate(body.dof_names):
        if name.startswith('left_'):
            name = name.replace('left_', 'right_', 1)
        elif name.startswith('right_'):
            name = name.replace('right_', 'left_', 1)
        reversed_ = name == 'root_tx' or name.endswith(('_y', '_z'))
        result[i] = pose[body.dof_names.index(name)] * (-1 if reversed_ else 1)
    return result


@pytest.mark.parametrize('pair', PAIRS)
def test_swapped_sides_are_those_of_the_mirrored_person(shot, poses, textures, pair):
    body = shot.body
    sides = [body.chains[chain] for chain in pair]
    flip = np.array([-1.0, 1.0, 1.0])
    for k, pose in enumerate(poses):
        other = mirrored(body, pose)
        # The oracle first: joints of the mirrored pose are mirrored joints of the other side.
        names = [n.replace('left_', 'L').replace('right_', 'left_') for n in body.joint_names]
        names = [n.replace('L', 'right_') for n in names]
        there = body.joint_positions(other[None])[0, body.skeleton.joint_index(names)]
        assert np.allclose(there, flip * body.joint_positions(pose[None])[0], atol=1e-12)
        swapped = with_swapped_sides(textures, k, *sides)
        segments, local, pixels, colours = used(swapped, 3)
        before = used(textures, k)
        on_limbs = np.isin(before[0], np.concatenate(sides))
        assert 10 < on_limbs.sum() < 120
        here = in_space(body, pose, before[0], before[1])[on_limbs]
        found = in_space(body, other, segments, local)[on_limbs]
        assert np.allclose(found, flip * here, atol=1e-9)
        # What is on no limb stays, and so do all pixels and colours.
        assert np.array_equal(segments[~on_limbs], before[0][~on_limbs])
        assert np.array_equal(local[~on_limbs], before[1][~on_limbs])
        assert np.array_equal(pixels, before[2])
        assert np.array_equal(colours, before[3])


@pytest.mark.parametrize('pair', PAIRS)
def test_swapping_twice_gives_the_original(shot, textures, pair):
    sides = [shot.body.chains[chain] for chain in pair]
    once = with_swapped_sides(textures, 1, *sides)
    assert [len(x) for x in once] == [4] * 5
    assert not np.array_equal(once.segments[3], textures.segments[1])
    twice = with_swapped_sides(once, 3, *sides)
    for a, b in zip(twice, textures):
        assert np.array_equal(a[:3], b)
        assert np.array_equal(a[4], b[1])


def test_segments_beyond_those_in_the_image(textures):
    """Limbs that nothing is seen of have no place in the texture's numbers, and need none."""
    last = int(textures.segments.max())
    swapped = with_swapped_sides(textures, 0, [last + 1], [last + 2])
    for a, b in zip(swapped, textures):
        assert np.array_equal(a[3], b[0])
