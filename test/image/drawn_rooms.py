"""Drawings of scenes of straight lines, in a level frame: x to the right, y down, z forward."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from hmt_ros.body import Camera

ROOM_CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
# Furniture: place of its front left foot, x to the right and z forward, width, depth and height, m,
# and turn about the vertical, rad.
ROOM = (
    (-2.2, 4.0, 1.0, 0.6, 2.0, 0.3),
    (0.8, 3.5, 0.8, 0.8, 0.9, -0.5),
    (-0.8, 5.0, 1.2, 0.5, 1.6, 0.1),
    (1.6, 5.5, 0.9, 0.4, 2.2, 0.1),
    (-1.6, 2.8, 0.5, 0.5, 0.6, 0.8),
)


def turn(pitch: float, roll: float) -> np.ndarray:
    """Rotation from the level frame to a camera that looks down and is rolled, angles in rad."""
    c, s = np.cos(pitch), np.sin(pitch)
    down = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    c, s = np.cos(roll), np.sin(roll)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ down


def drawn(lines: np.ndarray, rotation: np.ndarray, camera: Camera = ROOM_CAMERA) -> np.ndarray:
    """An image of lines (N, 2, 3) in the level frame, before noise."""
    image = np.full((camera.height, camera.width, 3), 120, np.uint8)
    for line in lines @ rotation.T:
        near = line[:, 2] > 0.3
        if not near.all():
            continue
        first, second = camera.project(line)
        if max(np.abs([*first, *second])) < 5000:
            cv2.line(
                image,
                tuple(map(int, first)),
                tuple(map(int, second)),
                (40, 60, 220),
                camera.width // 320,
            )
    noise = np.random.default_rng(0).normal(0.0, 4.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def room() -> np.ndarray:
    """Edges (N, 2, 3) of furniture on a floor 1.4 m below the camera."""
    edges = []
    for x, z, width, depth, height, angle in ROOM:
        across, ahead = (
            np.array([np.cos(angle), np.sin(angle)]),
            np.array([-np.sin(angle), np.cos(angle)]),
        )
        feet = [
            np.array([x, z]) + a * width * across + b * depth * ahead
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        for (x0, z0), (x1, z1) in pairwise([*feet, feet[0]]):
            edges += [[[x0, y, z0], [x1, y, z1]] for y in (1.4, 1.4 - height)]
            edges.append([[x0, 1.4, z0], [x0, 1.4 - height, z0]])
    return np.array(edges)
