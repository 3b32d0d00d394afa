"""Pixels and rays: invalid arguments are refused; test/body/test_camera.py checks values."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.core import find_pixels, find_rays
from test.core.arguments import assert_arguments_are_checked

CAMERA = Camera(600.0, 600.0, 320.0, 240.0, 640, 480)


def test_arguments_are_checked():
    points = np.random.default_rng(1).uniform(1.0, 2.0, (5, 3))
    pixels = {'lens': CAMERA.lens, 'points': points, 'pixels': np.empty((5, 2))}
    assert_arguments_are_checked(find_pixels, pixels, 'pixels')
    rays = {'lens': CAMERA.lens, 'pixels': points[:, :2].copy(), 'rays': np.empty((5, 3))}
    assert_arguments_are_checked(find_rays, rays, 'rays')
