"""The masses of the segments, and the centre of mass.

Shares of the mass of the body and distances of the centres from the upper ends, as shares of the
lengths, are those of [Winter, Biomechanics and Motor Control of Human Movement, 4th ed. 2009, table
4.1, after Dempster]. The trunk of 0.497 is there 0.142 pelvis and 0.355 thorax and abdomen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames
from hmt_ros.body.skeleton import other_side
from hmt_ros.inference.arrays import Array

# By segment without its side: share of the mass, share of the way from its start to its end.
SHARES = {
    'pelvis': (0.142, 0.0),
    'trunk': (0.355, 0.37),
    'head': (0.081, 1.0),
    'upper_arm': (0.028, 0.436),
    'forearm': (0.016, 0.430),
    'hand': (0.006, 0.506),
    'thigh': (0.100, 0.433),
    'shin': (0.0465, 0.433),
    'foot': (0.0145, 0.5),
}
# Least share of the mass that the segments of a body must have.
LEAST_SHARE = 0.8


@dataclass(frozen=True, eq=False)
class Masses:
    """Point masses of the segments.

    Attributes:
        shares: (S,) of the mass of the body, with the sum 1; all 0 where they are not known.
        centres: (S, 3) in the frames of the segments, m.
    """

    shares: Array
    centres: Array

    @property
    def known(self) -> bool:
        """Whether the masses are known."""
        return bool(self.shares.any())

    def centre_of_mass(self, frames: Frames) -> Array:
        """Centres of mass (3, N) of poses, camera frame, m."""
        every = np.arange(len(self.shares))
        result: Array = np.einsum('s,sin->in', self.shares, frames.points(every, self.centres))
        return result


@lru_cache(maxsize=16)
def masses(body: Body) -> Masses:
    """The masses of a body whose segments have the names of `SHARES`; else none are known."""
    skeleton = body.skeleton
    count = len(skeleton.parents)
    shares, centres = np.zeros(count), np.zeros((count, 3))
    for s, name in enumerate(skeleton.segment_names):
        bare = name.split('_', 1)[1] if other_side(name) != name else name
        if bare not in SHARES:
            continue
        shares[s], way = SHARES[bare]
        centres[s] = way * _end(body, s)
    if shares.sum() < LEAST_SHARE:
        return Masses(np.zeros(count), centres)
    return Masses(shares / shares.sum(), centres)


def _end(body: Body, segment: int) -> Array:
    """Where a segment ends (3,): its farthest joint, or where the next segment starts, m."""
    skeleton = body.skeleton
    ends = [np.zeros(3), *skeleton.joint_offsets[skeleton.joint_segments == segment]]
    children = [s for s, parent in enumerate(skeleton.parents) if parent == segment]
    # Of several segments that start here, the middle: both shoulders, or the neck between them.
    if children:
        ends.append(np.mean([skeleton.offsets[s] for s in children], axis=0))
    return np.asarray(max(ends, key=lambda end: float(end @ end)), dtype=np.float64)
