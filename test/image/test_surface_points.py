"""Points on the surface: where they are, and which of them the camera sees."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.kinematics import forward
from hmt_ros.core import MIN_FACING
from hmt_ros.image.surface_points import SurfacePoints, seen_points
from test.oracles import numpy_likelihood as oracle


@pytest.fixture(scope='module')
def poses(shot):
    return shot.near(3, 0)


@pytest.fixture(scope='module')
def points(shot, poses) -> SurfacePoints:
    return seen_points(shot.body, shot.camera, forward(shot.body.skeleton, poses))


def used(points, k):
    """Segments, places and pixels of one pose, without the unused rest of its row."""
    return tuple(x[k, : points.counts[k]] for x in points[1:])


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


def test_points_lie_on_the_surface(shot, points):
    parts = {part.segment: part for part in shot.body.flesh.parts}
    assert len(parts) == len(shot.body.flesh.parts)
    assert not any(any(part.bend) for part in parts.values())
    for k in range(3):
        segments, local, _ = used(points, k)
        assert points.counts[k] == 120
        for segment in np.unique(segments):
            values = inside(parts[segment], local[segments == segment])
            assert np.allclose(values, 1.0, atol=1e-9)


def test_points_project_to_their_pixels(shot, poses, points):
    for k, pose in enumerate(poses):
        segments, local, pixels = used(points, k)
        places = in_space(shot.body, pose, segments, local)
        assert np.abs(shot.camera.project(places) - pixels).max() < 1e-9
        assert (pixels >= 0).all()
        assert (pixels < [shot.camera.width, shot.camera.height]).all()


def test_points_face_the_camera_and_nothing_is_before_them(shot, poses, points):
    """The ray from the camera to a point meets no other part before it."""
    body = shot.body
    for k, pose in enumerate(poses):
        frames = forward(body.skeleton, pose[None])
        rotations, origins = frames.rotations()[0], frames.origins[..., 0]
        segments, local, _ = used(points, k)
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
            assert (-(normals * at_camera).sum(1)).min() > MIN_FACING - 1e-4


def test_what_others_hide_is_not_seen(shot, poses, points):
    others = np.zeros((shot.camera.height, shot.camera.width), dtype=bool)
    middle = int(np.median(used(points, 0)[2][:, 0]))
    others[:, :middle] = True
    frames = forward(shot.body.skeleton, poses)
    found = seen_points(shot.body, shot.camera, frames, others)
    for k in range(3):
        assert 10 < found.counts[k] <= points.counts[k]
        assert used(found, k)[2][:, 0].min() >= middle - 0.5
    assert not seen_points(shot.body, shot.camera, frames, np.ones_like(others)).counts.any()


def test_they_equal_numpy(shot):
    frames = forward(shot.body.skeleton, shot.near(6, 4, spread=0.3))
    found = seen_points(shot.body, shot.camera, frames)
    wanted = oracle.seen_points(shot.body, shot.camera, frames)
    assert np.array_equal(found.counts, wanted.counts)
    assert found.counts.min() > 40
    assert np.array_equal(found.segments, wanted.segments)
    for a, b in zip(found[2:], wanted[2:]):
        assert np.allclose(a, b, rtol=1e-12, atol=1e-9)
