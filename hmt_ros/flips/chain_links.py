"""Links of chains, as input for the compiled interpretation trees (KJS 3)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array


class ChainLinks(NamedTuple):
    """K links of a chain with D degrees of freedom, as input for the compiled functions.

    A link is spherical (axes x y z), a hinge (x) or an end effector (x y).

    Attributes:
        segments: (K,) index of the segment of each link.
        parent: index of the segment to which the chain is attached.
        mounts: (K, 3, 3) mounting rotations of the segments.
        mounted: (K,) whether the mount is not the identity.
        lengths: (K,) lengths from joint to joint, m.
        first_dofs: (K + 1,) position in `dofs` of each link's first degree of freedom.
        dofs: (D,) indices of the degrees of freedom of all links.
        lower, upper: (D,) limits of the angles, rad.
        sides: (K, 2) for each of a link's two solutions, whether the limits allow it.
    """

    segments: NDArray[np.int64]
    parent: int
    mounts: Array
    mounted: NDArray[np.bool_]
    lengths: Array
    first_dofs: NDArray[np.int64]
    dofs: NDArray[np.int64]
    lower: Array
    upper: Array
    sides: NDArray[np.bool_]


@lru_cache(maxsize=64)
def chain_links(skeleton: Skeleton, name: str) -> ChainLinks:
    """Collects the links of a chain.

    Raises:
        KeyError: the skeleton has no such chain.
        ValueError: the joints have no closed-form solution, or no angle satisfies the limits.
    """
    if name not in skeleton.chains:
        raise KeyError(f'{skeleton.name} has no chain {name!r}; it has {sorted(skeleton.chains)}')
    segments = skeleton.chains[name]
    lengths: list[float] = []
    sides: list[list[bool]] = []
    after_spherical = False
    for k, s in enumerate(segments):
        dofs = skeleton.segment_dofs[s]
        axes = ''.join('xyz'[skeleton.dof_axes[j]] for j in dofs)
        rotations = all(skeleton.dof_is_rotation[j] for j in dofs)
        ends = [j for j, owner in enumerate(skeleton.joint_segments) if owner == s]
        if k + 1 < len(segments):
            end = skeleton.offsets[segments[k + 1]]
        else:
            end = next((x for x in skeleton.joint_offsets[ends] if np.any(x)), np.zeros(3))
        straight = np.allclose(end[:2], 0.0) and end[2] < 0
        in_line = np.array_equal(skeleton.mounts[s], np.eye(3))
        hinge = axes == 'x' and after_spherical and in_line
        follows = k == 0 or skeleton.parents[s] == segments[k - 1]
        fits = (axes in ('xyz', 'xy') or hinge) and follows and skeleton.parents[s] >= 0
        if not (rotations and straight and fits):
            raise ValueError(
                f'chain {name} of {skeleton.name} has no closed form at segment '
                f'{skeleton.segment_names[s]} (rotations {axes!r}); '
                'use iterative inverse kinematics'
            )
        after_spherical = axes == 'xyz'
        lengths.append(float(-end[2]))
        # The two solutions differ in the sign of the hinge's sine, or of the second angle's cosine.
        bend = dofs[0] if hinge else dofs[1]
        sides.append(_signs(skeleton.lower[bend], skeleton.upper[bend], hinge))
        if not any(sides[-1]):
            raise ValueError(
                f'{skeleton.dof_names[bend]} of {skeleton.name} has limits that no angle satisfies'
            )
    which = list(segments)
    own = skeleton.chain_dofs[name]
    counts = [len(skeleton.segment_dofs[s]) for s in segments]
    return ChainLinks(
        np.array(which, dtype=np.int64),
        int(skeleton.parents[segments[0]]),
        skeleton.mounts[which],
        np.array([not np.array_equal(mount, np.eye(3)) for mount in skeleton.mounts[which]]),
        np.array(lengths),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        own,
        skeleton.lower[own],
        skeleton.upper[own],
        np.array(sides),
    )


@lru_cache(maxsize=64)
def _signs(lower: float, upper: float, sine: bool) -> list[bool]:
    """Whether some angle within the limits has a positive, and a negative, sine or cosine."""
    samples = np.linspace(lower, min(upper, lower + 2.0 * np.pi), 721)
    values = elementary.sin(samples) if sine else elementary.cos(samples)
    return [bool(np.any(values > 1e-6)), bool(np.any(values < -1e-6))]
