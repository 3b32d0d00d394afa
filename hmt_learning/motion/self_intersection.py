"""Overlap of body parts in many poses at once, which rendered motions must avoid."""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.self_intersection import overlaps_of
from hmt_ros.core import add_overlaps
from hmt_ros.inference.arrays import Array


def self_intersection_energy(body: Body, poses: Array, *, sigma: float = 0.02) -> Array:
    """Energies (N,) of poses (N, d); sigma as for `SelfIntersection`."""
    overlaps, d = overlaps_of(body, sigma), body.dimension
    frames = forward(body.skeleton, poses)
    placed = zip(*frames.by_pose(), *frames.dofs_by_pose(), strict=True)
    value, gradient, hessian = np.zeros((len(poses), 1)), np.zeros(d), np.zeros((d, d))
    for own, place in zip(value, placed, strict=True):
        add_overlaps(overlaps, *place, False, own, gradient, hessian)
    return value[:, 0]
