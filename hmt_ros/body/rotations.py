"""Conversion between rotation matrices and rotation vectors (axis times angle)."""

from __future__ import annotations

import numpy as np

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product


def rotation_vectors(rotations: Array) -> Array:
    """Rotation vectors (..., 3), rad, at most pi long, of rotation matrices (..., 3, 3)."""
    # The quaternion w x y z from its largest element, see Shepperd, 1978.
    r = rotations
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    squares = np.stack([trace, r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]], axis=-1)
    twist = np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1
    )
    products = r + r.swapaxes(-1, -2)
    rows = np.empty((*trace.shape, 4, 4))
    rows[..., 0, 0] = 1.0 + trace
    rows[..., 0, 1:] = rows[..., 1:, 0] = twist
    rows[..., 1:, 1:] = products
    for k in range(3):
        rows[..., k + 1, k + 1] = 1.0 - trace + 2.0 * r[..., k, k]
    largest = squares.argmax(axis=-1)[..., None, None]
    q = np.take_along_axis(rows, largest, axis=-2)[..., 0, :]
    q = q * np.where(q[..., :1] < 0.0, -1.0, 1.0)
    length = np.sqrt((q[..., 1:] ** 2).sum(-1, keepdims=True))
    angle = 2.0 * elementary.arctan2(length, q[..., :1])
    # For small angles, the ratio of angle to length is 2 / w.
    scale = np.divide(
        angle, length, out=2.0 / np.maximum(q[..., :1], 1e-300), where=length > 1e-12 * q[..., :1]
    )
    return np.asarray(scale * q[..., 1:])


def rotations_of(vectors: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad; Rodrigues' formula."""
    angle = np.sqrt((vectors**2).sum(-1))[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    half = elementary.sin(0.5 * safe) / safe
    first = np.where(small, 1.0, elementary.sin(safe) / safe)
    second = np.where(small, 0.5, 2.0 * half * half)
    return np.asarray(np.eye(3) + first * cross + second * product(cross, cross))
