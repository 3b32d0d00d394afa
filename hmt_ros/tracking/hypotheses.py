"""Hypotheses about the pose, from one image to the next: the record that the five steps share.

    predict -> propose -> optimise -> weigh -> select

A hypothesis is born with a prior (its ancestor, its jumps and where it is expected), gets a pose
that is locally optimal and a weight, and, if it is selected, covariances and a texture.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.image.texture import Textures
from hmt_ros.inference.mixture import GaussianMixture

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """N weighted poses, and how they came about.

    Attributes:
        poses: (N, d).
        log_weights: (N,) log prior probabilities; once weighed, log posterior probabilities.
        ancestors: (N,) mode of the image before that each comes from.
        expected: (N, d) pose that the motion prior is centred at.
        jumped: (N, d) degrees of freedom that did not move there, but jumped.
        textures: of the last image, or, once selected, of this one; None: there are none.
        texture_rows: (N,) row of the textures that each carries.
        velocities: (N, d) per second; None before the poses are optimal.
        covariances: (N, d, d) of the posterior; None before selection.
        filtered: (N, d, d) covariances that are propagated, as if errors were independent from
            image to image; None before selection.
        log_likelihoods: (N,) of the image; None before selection.
    """

    poses: Array
    log_weights: Array
    ancestors: Index
    expected: Array
    jumped: NDArray[np.bool_]
    textures: Textures | None
    texture_rows: Index
    velocities: Array | None = None
    covariances: Array | None = None
    filtered: Array | None = None
    log_likelihoods: Array | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: Index) -> Hypotheses:
        """Some of them; all keep their textures."""
        parts = {name: getattr(self, name) for name in _ROWS}
        return replace(self, **{k: None if v is None else v[rows] for k, v in parts.items()})

    def joined(self, other: Hypotheses) -> Hypotheses:
        """These and others, whose textures contain those of these."""
        parts = {}
        for name in _ROWS:
            a, b = getattr(self, name), getattr(other, name)
            parts[name] = None if a is None or b is None else np.concatenate([a, b])
        return replace(other, **parts)

    @property
    def mixture(self) -> GaussianMixture:
        """The hypotheses as a mixture over poses.

        Raises:
            ValueError: they have no covariances yet.
        """
        if self.covariances is None:
            raise ValueError('hypotheses that were not selected have no covariances')
        return GaussianMixture(np.exp(self.log_weights), self.poses, self.covariances)


_ROWS = tuple(f.name for f in fields(Hypotheses) if f.name != 'textures')


def new_hypotheses(poses: Array, log_weights: Array) -> Hypotheses:
    """Hypotheses (N, d) that come from nothing before: each its own ancestor, without texture."""
    everyone = np.arange(len(poses))
    still = np.zeros(poses.shape, dtype=np.bool_)
    return Hypotheses(poses, log_weights, everyone, poses, still, None, everyone)


def relative_joints(body: Body, poses: Array) -> Array:
    """Joints (N, J, 3) of poses relative to the first, m: what hypotheses are compared by."""
    joints = body.joint_positions(poses)
    return joints - joints[:, :1]
