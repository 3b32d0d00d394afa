"""Contours and visible points in the core, compared with numpy, and invalid arguments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.core import mark_visibility, see_points, trace_contour
from hmt_ros.image.surface import empty_contour, flesh_table_of
from hmt_ros.image.surface_points import SurfacePoints, coarse_mesh, seen_points
from test.oracles.numpy_contour import occluding_contour

CAMERA = Camera(500.0, 520.0, 319.5, 239.5, 640, 480, (0.1, -0.05, 0.001, -0.002, 0.01))


@pytest.fixture(scope='module')
def body():
    return load_body('human32')


@pytest.fixture(scope='module')
def frames(body):
    poses = 0.2 * np.random.default_rng(1).normal(size=(3, body.dimension))
    poses[:, 2] += 2.5
    return forward(body.skeleton, poses)


def as_arguments(body, frames):
    """Arguments of `trace_contour` at the first pose."""
    columns, origins = (array[0] for array in frames.by_pose())
    flesh = flesh_table_of(body)
    wanted = np.ones(len(flesh.part_segments), np.bool_)
    return [flesh, wanted, CAMERA.lens, columns, origins, empty_contour(len(flesh.ring_parts))]


def visibility_arguments(body, frames):
    flesh, wanted, _, columns, origins, contour = as_arguments(body, frames)
    flags = contour.valid, contour.covered, contour.hidden
    return [flesh, wanted, columns, origins, contour.parts, contour.points, *flags]


def point_arguments(body, frames):
    mesh, flesh = coarse_mesh(body), flesh_table_of(body)
    vertices = (mesh.vertices, mesh.normals, mesh.segments, mesh.parts)
    scene = (CAMERA.lens, (640, 480), np.zeros((0, 0), np.bool_))
    n = frames.count
    result = np.zeros(n, np.int64), np.zeros((n, 5), np.int64), np.zeros((n, 5, 3))
    return [flesh, vertices, scene, *frames.by_pose(), *result, np.zeros((n, 5, 2))]


@pytest.mark.parametrize('exponent', [1.0, 0.8])  # of an outline: an ellipse, and a boxy one
def test_contours_are_those_of_numpy(body, frames, exponent):
    shape = {'exponents': (1.0, exponent), 'taper': (0.1, 0.2)}
    person = replace(body, shapes=tuple(replace(part, **shape) for part in body.shapes))
    wanted = occluding_contour(person.flesh, frames)
    flesh, every, lens, _, _, contour = as_arguments(person, frames)
    columns, origins = frames.by_pose()
    for n in range(frames.count):
        trace_contour(flesh, every, lens, columns[n], origins[n], contour)
        assert np.array_equal(contour.valid, wanted.exists[:, n])
        seen = contour.valid
        np.testing.assert_allclose(contour.points[seen], wanted.points[seen, :, n], atol=1e-9)
        pixels = CAMERA.project(contour.points[seen])
        np.testing.assert_allclose(contour.pixels[seen], pixels, rtol=1e-12)
        across = contour.normals[seen] * (CAMERA.fx, CAMERA.fy)
        across /= np.linalg.norm(across, axis=1)[:, None]
        true = wanted.normals[seen, :2, n]
        np.testing.assert_allclose(across, true / np.linalg.norm(true, axis=1)[:, None], atol=1e-6)


def test_parts_that_are_not_wanted_have_no_contour(body, frames):
    flesh, wanted, *others, contour = as_arguments(body, frames)
    wanted[::2] = False
    trace_contour(flesh, wanted, *others, contour)
    assert contour.valid.any()
    assert not contour.valid[~wanted[contour.parts]].any()


def wrong(place, change):
    """Arguments with one entry changed, possibly a nested one."""

    def changed(arguments):
        first, *rest = place
        if rest:
            own = list(arguments[first])
            own[rest[0]] = change(own[rest[0]])
            arguments[first] = tuple(own)
        else:
            arguments[first] = change(arguments[first])
        return arguments

    return changed


def shorter(x):
    return x[:-1]


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (wrong((1,), shorter), 'wanted'),
        (wrong((1,), lambda x: x.astype(int)), 'wanted: .* array of bool'),
        (wrong((3,), shorter), 'origins'),
        (wrong((3,), lambda x: x.transpose(0, 2, 1)), 'columns: .*contiguous'),
        (wrong((3,), lambda x: x.astype(np.float32)), 'columns: .*float64'),
        (wrong((4,), lambda x: x[:, :2].copy()), 'origins'),
        (wrong((0, 0), lambda x: x + 100), 'part_segments'),
        (wrong((0, 3), lambda x: x - 1), 'ring_parts'),
        (wrong((0, 5), shorter), 'ring_radii'),
        (wrong((5, 1), shorter), 'points'),
        (wrong((5,), lambda x: empty_contour(3)), 'contour'),
        (wrong((2,), lambda x: x[:3]), 'lens'),
        (shorter, 'arguments'),
    ],
)
def test_contours_of_what_does_not_fit(body, frames, change, message):
    with pytest.raises((ValueError, TypeError), match=message):
        trace_contour(*change(as_arguments(body, frames)))


@pytest.mark.parametrize('place', range(1, 9))
def test_visibility_of_what_does_not_fit(body, frames, place):
    arguments = visibility_arguments(body, frames)
    arguments[place] = arguments[place][:-1]
    with pytest.raises(ValueError, match=r'wanted shape|from 0 up to'):
        mark_visibility(*arguments)


@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0])
def test_frames_without_sense_have_no_contour(body, frames, value):
    arguments = as_arguments(body, frames)
    arguments[3], arguments[4] = (np.full_like(x, value) for x in arguments[3:5])
    trace_contour(*arguments)
    assert not arguments[5].valid.any()
    others = visibility_arguments(body, frames)
    others[6][:] = True
    others[2], others[3], others[5] = (np.full_like(x, value) for x in (*others[2:4], others[5]))
    mark_visibility(*others)
    assert not others[8].any()


def test_a_body_without_flesh():
    flesh = [np.zeros(n, np.int64) if n == 0 else np.zeros((0, n)) for n in (0, 3, 3)]
    flesh += [np.zeros(0, np.int64), np.zeros((0, 3)), *np.zeros((3, 0, 2)), np.zeros(0)]
    flesh.append(np.zeros((0, 2)))
    columns, origins = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    none = np.zeros(0, np.bool_)
    contour = empty_contour(0)
    trace_contour(tuple(flesh), none, CAMERA.lens, columns, origins, contour)
    assert len(contour.points) == 0


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (wrong((3,), shorter), 'columns'),
        (wrong((4,), shorter), 'origins'),
        (wrong((5,), shorter), 'columns'),
        (wrong((6,), shorter), 'segments'),
        (wrong((7,), shorter), 'local'),
        (wrong((8,), shorter), 'pixels'),
        (wrong((1, 0), shorter), 'normals'),
        (wrong((1, 2), lambda x: x + 100), 'mesh.segments'),
        (wrong((2, 2), lambda x: np.zeros(3, np.bool_)), 'scene'),
    ],
)
def test_points_of_what_does_not_fit(body, frames, change, message):
    with pytest.raises((ValueError, TypeError), match=message):
        see_points(*change(point_arguments(body, frames)))


def test_points_where_nothing_is_to_be_seen(body, frames):
    arguments = point_arguments(body, frames)
    arguments[3] = np.full_like(arguments[3], np.nan)
    see_points(*arguments)
    assert not arguments[5].any()
    nobody = seen_points(body, CAMERA, frames, np.ones((480, 640), np.bool_))
    assert isinstance(nobody, SurfacePoints)
    assert not nobody.counts.any()
    # A mask of another size than the image, and no space for results.
    assert not seen_points(body, CAMERA, frames, np.ones((1, 1), np.bool_)).counts.any()
    assert not seen_points(body, CAMERA, frames, points=0).counts.any()
