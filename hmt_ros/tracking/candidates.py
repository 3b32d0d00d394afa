"""Poses that are about to be optimised, and what is known of how they came about."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.image.texture import Textures
from hmt_ros.inference.bounded_newton import Minimum

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses to be optimised.

    Attributes:
        poses: (N, d).
        parents: (N,) the mode that each comes from.
        log_priors: (N,) log probability given the modes before.
        centres: (N, d) where each is expected.
        jumped: (N, d) what did not move there.
        textures: of the last image.
        texture_rows: (N,) row of the textures that each carries.
    """

    poses: Array
    parents: Index
    log_priors: Array
    centres: Array
    jumped: NDArray[np.bool_]
    textures: Textures | None
    texture_rows: Index


def some_minima(minima: Minimum, which: Index) -> Minimum:
    """Some rows of minima."""
    return Minimum(*(getattr(minima, f.name)[which] for f in fields(Minimum)))


def joined_minima(a: Minimum, b: Minimum) -> Minimum:
    """The rows of both."""
    return Minimum(
        *(np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(Minimum))
    )


def joined_candidates(a: Candidates, b: Candidates) -> Candidates:
    """Both; the textures of the second contain those of the first."""
    joined = {
        name: np.concatenate([getattr(a, name), getattr(b, name)])
        for name in ('poses', 'parents', 'log_priors', 'centres', 'jumped', 'texture_rows')
    }
    return Candidates(textures=b.textures, **joined)


def relative_joints(body: Body, poses: Array) -> Array:
    """Joints (N, J, 3) of poses relative to the first, m: what hypotheses are compared by."""
    joints = body.joint_positions(poses)
    return joints - joints[:, :1]
