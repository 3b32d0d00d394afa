"""The camera, compared with OpenCV and finite differences."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_ros.body import Camera
from hmt_ros.body.camera import (
    FAR_PERSON_DISTANCE,
    MIN_UNFOLDED_FRACTION,
    NEAR_PERSON_DISTANCE,
    USUAL_ANGLE_OF_VIEW,
    log_prior_of_distance,
    unfolded_share,
)

LENSES = {
    'none': ('plumb_bob', ()),
    'plumb_bob with four': ('plumb_bob', (-0.28, 0.09, 1e-3, -2e-3)),
    'plumb_bob with five': ('plumb_bob', (-0.28, 0.09, 1e-3, -2e-3, 0.01)),
    'rational_polynomial': (
        'rational_polynomial', (0.4, -0.2, 1e-3, -2e-3, 0.05, 0.7, -0.1, 0.02),
    ),
    'equidistant': ('equidistant', (-0.02, 0.01, -0.004, 0.001)),
}  # fmt: skip


@pytest.fixture(params=LENSES)
def camera(request) -> Camera:
    model, coefficients = LENSES[request.param]
    return Camera(610.0, 590.0, 322.5, 238.0, 640, 480, coefficients, model)


def points_in_view(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 8, n)
    return np.stack([z * rng.uniform(-0.5, 0.5, n), z * rng.uniform(-0.4, 0.4, n), z], axis=1)


def test_projection_equals_opencv(camera):
    points = points_in_view(200, 0)
    none = np.zeros((3, 1))
    if camera.distortion_model == 'equidistant':
        expected, _ = cv2.fisheye.projectPoints(
            points[:, None], none, none, camera.matrix, np.array(camera.distortion)
        )
    else:
        distortion = np.array(camera.distortion) if camera.distortion else None
        expected, _ = cv2.projectPoints(points, none, none, camera.matrix, distortion)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)


def test_derivative_equals_central_differences(camera):
    points = np.concatenate([points_in_view(40, 1), [[0.0, 0.0, 2.0], [1e-7, 0.0, 2.0]]]).T
    pixels, derivative = camera.project_with_derivative(points)
    np.testing.assert_allclose(pixels.T, camera.project(points.T), atol=1e-12)
    for k in range(3):
        step = np.zeros((3, 1))
        step[k] = 1e-6
        ahead, _ = camera.project_with_derivative(points + step)
        behind, _ = camera.project_with_derivative(points - step)
        np.testing.assert_allclose(derivative[:, k], (ahead - behind) / 2e-6, atol=2e-5)


def test_rays_undo_the_projection(camera):
    points = points_in_view(200, 2)
    rays = camera.rays(camera.project(points))
    expected = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(rays, expected, atol=1e-10)
    back = camera.project(3.0 * rays)
    np.testing.assert_allclose(back, camera.project(points), atol=1e-6)


@pytest.mark.parametrize('z', [0.01, 0.0, -1.0])
def test_a_point_behind_the_camera_has_no_image(camera, z):
    points = np.array([[0.1, 0.2, z], [0.1, 0.2, 1.0]])
    pixels = camera.project(points)
    assert np.isnan(pixels[0]).all()
    assert np.isfinite(pixels[1]).all()


@given(
    u=st.floats(0, 639),
    v=st.floats(0, 479),
    depth=st.floats(0.1, 50),
    lens=st.sampled_from(sorted(LENSES)),
)
def test_every_pixel_has_a_ray_that_projects_to_it(u, v, depth, lens):
    model, coefficients = LENSES[lens]
    camera = Camera(610.0, 590.0, 322.5, 238.0, 640, 480, coefficients, model)
    ray = camera.rays([u, v])
    assert np.linalg.norm(ray) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.project(depth * ray), [u, v], atol=1e-5)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'fx': 0.0}, 'focal lengths must be positive, saw 0.0 and 600'),
        ({'fy': -1.0}, 'focal lengths must be positive'),
        ({'cx': float('nan')}, 'must be finite'),
        ({'fx': float('inf')}, 'must be finite'),
        ({'width': 0}, 'image size must be positive, saw 0 x 480'),
        ({'distortion': (0.1, 0.2, 0.3)}, 'coefficients, saw 3'),
        ({'distortion': (0.1,) * 5, 'distortion_model': 'equidistant'}, 'coefficients, saw 5'),
        ({'distortion': (-5.0, 30.0, 0.0, 0.0)}, 'folds or overstretches the image of 640x480'),
        ({'distortion': (1e6, 1e6, 1e6, 1e6, 1e6)}, 'folds or overstretches'),
        ({'fx': 9e3, 'fy': 9e3, 'distortion': (-300.0, 0.0, 0.0, 0.0)}, 'folds or'),
        ({'distortion': (-0.8, 0.0, 0.0, 0.0)}, 'folds or overstretches'),
        ({'distortion_model': 'fisheye624'}, "unknown distortion model 'fisheye624'"),
    ],
)
def test_an_impossible_camera_is_refused(change, message):
    values = {'fx': 600.0, 'fy': 600.0, 'cx': 320.0, 'cy': 240.0, 'width': 640, 'height': 480}
    with pytest.raises(ValueError, match=message):
        Camera(**{**values, **change})


@pytest.mark.parametrize('depth', [0.5, 2.0, 7.0])
def test_magnification_is_pixels_for_a_metre(depth):
    camera = Camera(600.0, 600.0, 320.0, 240.0, 640, 480)
    a, b = camera.project([[0.0, 0.1, depth], [0.01, 0.1, depth]])
    assert camera.magnification(depth) == pytest.approx((b - a)[0] / 0.01)
    wide = Camera(600.0, 150.0, 320.0, 240.0, 640, 480)
    # The area of a square metre is correct for non-square pixels.
    assert wide.magnification(depth) ** 2 == pytest.approx(600.0 * 150.0 / depth**2)


@pytest.mark.parametrize(
    ('focal', 'size', 'model', 'coefficients'),
    [
        (517.3, (640, 480), 'plumb_bob', (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        (458.0, (752, 480), 'plumb_bob', (-0.2834, 0.0739, 0.0002, 0.0)),
        (191.0, (512, 512), 'equidistant', (0.0034, 0.0007, -0.0020, 0.0002)),
        (286.0, (848, 800), 'equidistant', (-0.0084, 0.0443, -0.0419, 0.0076)),
        (200.0, (1000, 1000), 'equidistant', (0.0, 0.0, 0.0, 0.0)),
        (370.0, (640, 480), 'plumb_bob', (-0.3319, 0.0683, -0.0029, 0.0049, 0.0)),
        (1727.0, (1920, 1080), 'plumb_bob', (0.17, -0.6973, -0.0029, -0.005, 0.0)),
        (
            915.0, (1920, 1080), 'rational_polynomial',
            (0.5, -2.6, 0.0007, -0.0002, 1.5, 0.38, -2.45, 1.44),
        ),
    ],
)  # fmt: skip
def test_distortions_of_real_cameras_do_not_fold(focal, size, model, coefficients):
    """Colour and grey cameras of public data sets, fisheyes that see more than half of a sphere."""
    width, height = size
    camera = Camera(focal, focal, width / 2, height / 2, width, height, coefficients, model)
    assert unfolded_share(camera) >= MIN_UNFOLDED_FRACTION


def test_scaled_camera_sees_the_same_through_larger_pixels():
    camera = Camera(610.0, 590.0, 322.5, 238.0, 640, 480, (-0.28, 0.09, 1e-3, -2e-3))
    half = camera.scaled(320, 240)
    points = points_in_view(50, 5)
    np.testing.assert_allclose(2 * (half.project(points) + 0.5), camera.project(points) + 0.5)
    assert camera.scaled(640, 480) == camera
    # Sizes are rounded to whole pixels: 853.3 x 480.
    assert Camera(900, 900, 640, 360, 1280, 720).scaled(853, 480).width == 853
    with pytest.raises(ValueError, match='640x480 pixels, which have another shape than 640x360'):
        camera.scaled(640, 360)


def test_distances_that_people_and_cameras_have():
    """A log-normal prior with 95 % between limits that scale with the focal length."""
    focal = 320.0 / np.tan(0.5 * USUAL_ANGLE_OF_VIEW)
    usual = Camera(focal, focal, 319.5, 239.5, 640, 480)
    far = replace(usual, fx=3.0 * focal, fy=3.0 * focal)
    middle = np.sqrt(NEAR_PERSON_DISTANCE * FAR_PERSON_DISTANCE)
    assert log_prior_of_distance(usual, middle) == pytest.approx(0.0)
    for limit in (NEAR_PERSON_DISTANCE, FAR_PERSON_DISTANCE):
        assert log_prior_of_distance(usual, limit) == pytest.approx(-2.0)
        assert log_prior_of_distance(far, 3.0 * limit) == pytest.approx(-2.0)
    assert -6.0 < log_prior_of_distance(usual, 50.0) < -5.0
