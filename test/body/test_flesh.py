"""Superquadric flesh: surface, normals, contours and mesh, compared with definitions."""

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.flesh import Flesh, Superquadric
from hmt_ros.body.kinematics import Frames, forward
from test.oracles.numpy_contour import occluding_contour, surface

HUMAN = load_body('human37')

PARTS = {
    'ellipsoid': Superquadric(0, (0.01, -0.02, -0.2), (0.06, 0.06, 0.22)),
    'flat': Superquadric(0, (0, 0, -0.2), (0.15, 0.10, 0.25), (0.6, 1.0)),
    'tapered': Superquadric(0, (0, 0, -0.2), (0.05, 0.05, 0.2), (0.8, 1.0), (-0.3, -0.3)),
    'unequal taper': Superquadric(0, (0, 0, -0.1), (0.04, 0.04, 0.12), (0.8, 1.0), (0.0, -0.4)),
    'bent': Superquadric(0, (0, 0, -0.2), (0.05, 0.06, 0.2), (0.9, 1.0), (0.1, 0.1), (0.03, -0.02)),
    'boxy': Superquadric(0, (0, 0, -0.2), (0.10, 0.07, 0.2), (0.7, 0.6)),
    'pinched': Superquadric(0, (0, 0, -0.2), (0.10, 0.07, 0.2), (1.2, 1.4)),
    'everything': Superquadric(
        0, (0.02, 0.01, -0.2), (0.09, 0.06, 0.2), (0.7, 0.8), (0.2, -0.2), (0.02, 0.02)
    ),
}


@pytest.fixture(params=PARTS)
def part(request):
    return PARTS[request.param]


def implicit(part, points):
    """Inside-outside function of points (..., 3): 1 on the surface, less inside."""
    s = (part.centre[2] - points[..., 2]) / part.radii[2]
    e1, e2 = part.exponents
    total = 0.0
    for i in range(2):
        middle = part.centre[i] + part.bend[i] * (1 - s * s)
        radius = part.radii[i] * (1 + part.taper[i] * s)
        total = total + np.abs((points[..., i] - middle) / radius) ** (2 / e2)
    return total ** (e2 / e1) + np.abs(s) ** (2 / e1)


def looks(n, seed):
    """Rotations (n, 3, 3) and positions (n, 3) of a segment in front of the camera."""
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    places = np.stack(
        [rng.uniform(-0.5, 0.5, n), rng.uniform(-0.5, 0.5, n), rng.uniform(1.5, 4, n)], 1
    )
    return q, places


def frames_of(rotations, places):
    n = len(places)
    placed = rotations.swapaxes(1, 2)[:, None].copy(), places[:, None].copy()
    return Frames(HUMAN.skeleton, np.empty((n, 0)), placed, (np.empty((n, 0, 3)),) * 2)


def test_surface_points_satisfy_the_implicit_equation(part):
    rng = np.random.default_rng(0)
    s, w = rng.uniform(-0.99, 0.99, 500), rng.uniform(-np.pi, np.pi, 500)
    point, normal = surface(part, s, w)
    np.testing.assert_allclose(implicit(part, point), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    assert (implicit(part, point + 1e-4 * normal) > 1).all()
    assert (implicit(part, point - 1e-4 * normal) < 1).all()


def test_contour_equals_a_search_over_all_angles(part):
    rotations, places = looks(25, 3)
    flesh = Flesh((part,), (5,))
    contour = occluding_contour(flesh, frames_of(rotations, places))
    rings = np.sin(np.linspace(-0.42, 0.42, 5) * np.pi)
    w = np.linspace(-np.pi, np.pi, 7201)
    for ring, s in enumerate(rings):
        local, normal = surface(part, np.full(len(w), s), w)
        for n in range(len(places)):
            point = local @ rotations[n].T + places[n]
            facing = (normal @ rotations[n].T * point).sum(1)
            crossings = np.flatnonzero(np.diff(np.sign(facing)) != 0)
            exists = contour.exists[[ring, ring + 5], n]
            assert exists.all() == exists.any()
            if np.abs(facing).min() > 1e-3:  # neither end of the ring is close to the ray
                assert exists.any() == (len(crossings) > 0)
            if exists.any() and len(crossings) == 2:
                found = contour.points[[ring, ring + 5], :, n]
                searched = 0.5 * (point[crossings] + point[crossings + 1])
                gaps = np.linalg.norm(found[:, None] - searched, axis=2)
                assert gaps.min(axis=0).max() < 1e-3
                assert gaps.min(axis=1).max() < 1e-3


def test_contour_of_the_whole_body(random_poses):
    poses = random_poses(HUMAN, 40, 4)
    flesh = HUMAN.flesh
    frames = forward(HUMAN.skeleton, poses)
    contour = occluding_contour(flesh, frames)
    count = 2 * sum(flesh.ring_count)
    assert contour.points.shape == (count, 3, 40)
    np.testing.assert_allclose(
        contour.points, frames_points(frames, contour.segments, contour.local), atol=1e-12
    )
    across = (contour.normals * contour.points).sum(1) / np.linalg.norm(contour.points, axis=1)
    np.testing.assert_allclose(across[contour.exists], 0.0, atol=1e-5)
    for part in range(len(flesh.parts)):
        rows = contour.parts == part
        value = implicit(flesh.parts[part], contour.local[rows].transpose(0, 2, 1))
        np.testing.assert_allclose(value, 1.0, atol=1e-9)


def frames_points(frames, segments, local):
    rotations = frames.rotations()  # (N, S, 3, 3)
    turned = np.einsum('npij,pjn->pin', rotations[:, segments], local)
    return turned + frames.origins[segments]


def test_mesh_of_every_part_is_closed_and_oriented_outward():
    flesh = HUMAN.flesh
    mesh = flesh.mesh(stacks=7, slices=10)
    per_part = 7 * 10 + 2
    assert mesh.vertices.shape == (per_part * len(flesh.parts), 3)
    assert np.array_equal(mesh.segments, [flesh.parts[p].segment for p in mesh.parts])
    for part in range(len(flesh.parts)):
        faces = mesh.triangles[mesh.parts[mesh.triangles[:, 0]] == part]
        assert (mesh.parts[faces] == part).all()
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        directed = {tuple(e) for e in edges.tolist()}
        assert len(directed) == len(edges)  # no edge twice in one direction
        assert all((b, a) in directed for a, b in directed)  # each with its opposite: closed
        assert len(np.unique(faces)) - len(edges) // 2 + len(faces) == 2  # Euler: a sphere
        a, b, c = mesh.vertices[faces].transpose(1, 0, 2)
        volume = (np.cross(a, b) * c).sum() / 6
        radii = flesh.parts[part].radii
        assert 0.5 < volume / (4 / 3 * np.pi * np.prod(radii)) < 1.4
        facing = np.cross(b - a, c - a)
        mean_normal = mesh.normals[faces].sum(1)
        assert ((facing * mean_normal).sum(1) > 0).all()


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'radii': (0.1, 0.0, 0.1)}, 'radii .* must be positive'),
        ({'exponents': (0.0, 1.0)}, r'exponents must lie in \(0, 2\]'),
        ({'exponents': (1.0, 2.5)}, r'exponents must lie in \(0, 2\]'),
        ({'taper': (1.0, 0.0)}, r'tapers must lie in \(-1, 1\)'),
    ],
)
def test_an_impossible_part_is_refused(change, message):
    values = {'segment': 0, 'centre': (0, 0, 0), 'radii': (0.1, 0.1, 0.1)}
    with pytest.raises(ValueError, match=message):
        Superquadric(**{**values, **change})
