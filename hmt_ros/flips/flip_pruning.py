"""What is known to be wrong among the flips of the whole body, before any pose is built (KJS 3).

Leaves of chains that run through the trunk or themselves, pairs of leaves of two chains that run
through each other, and pairs that contradict what is known of which part is before which.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.self_intersection import deepest_overlaps

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


class DepthOrder(NamedTuple):
    """One part of the body is seen before another.

    Attributes:
        front, behind: joints at the two ends of a part; twice the same joint: the joint itself.
    """

    front: tuple[str, str]
    behind: tuple[str, str]


@dataclass(frozen=True, eq=False)
class FlipPruning:
    """Rules out leaves of chains and pairs of them; works on the lists in place.

    Attributes:
        body, chains, trunks, parents: as in `FlipProduct`.
        given: (N, d) poses, which stay.
        angles, log_priors: lists of the chains, of which pruned leaves become -inf.
    """

    body: Body
    chains: tuple[str, ...]
    given: Array
    trunks: Array
    parents: Index
    angles: list[Array]
    log_priors: list[Array]

    @cached_property
    def _frames(self) -> tuple[Frames, list[Index]]:
        """Frames of every trunk with every leaf of every chain, and their rows (T, A)."""
        poses, rows, count = [], [], 0
        for chain, angles in zip(self.chains, self.angles, strict=True):
            block = np.repeat(self.trunks[:, None], angles.shape[1], axis=1)
            block[..., self.body.skeleton.chain_dofs[chain]] = angles
            poses.append(block.reshape(-1, self.body.dimension))
            rows.append(count + np.arange(len(poses[-1])).reshape(angles.shape[:2]))
            count += len(poses[-1])
        return forward(self.body.skeleton, np.concatenate([self.trunks[:0], *poses])), rows

    def allowed(self, most_overlap: float) -> list[Mask]:
        """Tables (T, A, A') of the pairs of leaves of two chains that do not intersect."""
        pairs = list(combinations(range(len(self.chains)), 2))
        shapes = [
            (len(self.trunks), self.angles[i].shape[1], self.angles[j].shape[1]) for i, j in pairs
        ]
        tables: list[Mask] = [np.ones(shape, dtype=np.bool_) for shape in shapes]
        if not (np.isfinite(most_overlap) and self.body.shapes):
            return tables
        frames, rows = self._frames
        placed = frames.by_pose()
        own = [self.body.chains[chain] for chain in self.chains]
        limbs = {s for segments in own for s in segments}
        trunk = [s for s in range(len(self.body.skeleton.parents)) if s not in limbs]
        for c, leaf_rows in enumerate(rows):
            flat = leaf_rows.ravel()
            depth = deepest_overlaps(self.body, *placed, flat, own[c], flat, [*trunk, *own[c]])
            deep = depth.reshape(leaf_rows.shape) > most_overlap
            deep[: len(self.given), 0] = False
            self.log_priors[c][deep] = -np.inf
        for (i, j), table in zip(pairs, tables, strict=True):
            first = np.broadcast_to(rows[i][:, :, None], table.shape).ravel()
            second = np.broadcast_to(rows[j][:, None, :], table.shape).ravel()
            depth = deepest_overlaps(self.body, *placed, first, own[i], second, own[j])
            table &= depth.reshape(table.shape) <= most_overlap
            table[: len(self.given), 0, 0] = True
        return tables

    def keep_order(self, order: DepthOrder, trunk_log_priors: Array, allowed: list[Mask]) -> None:
        """Rules out what contradicts an order in depth."""
        frames, rows = self._frames
        joints = frames.joints()[:, 2]
        crossings = np.array([_crossing(self.body, pose, order) for pose in self.given])
        owners, depths = [], []
        for part, at in zip(order, crossings[self.parents].T, strict=True):
            owner = self._owner(part)
            which = self.body.skeleton.joint_index(part)
            if owner < 0:
                places, share = self.body.joint_positions(self.trunks)[:, which, 2].T, at
            else:
                places, share = joints[which][:, rows[owner]], at[:, None]
            # Along the image of a straight line the inverse of the depth is linear.
            depths.append(1.0 / ((1.0 - share) / places[0] + share / places[1]))
            owners.append(owner)
        (i, j), (front, behind) = owners, depths
        if i < 0 and j < 0:
            trunk_log_priors[~(front < behind)] = -np.inf
        elif i < 0 or j < 0 or i == j:
            front, behind = (x[:, None] if x.ndim == 1 else x for x in (front, behind))
            self.log_priors[max(i, j)][~(front < behind)] = -np.inf
        else:
            fits = front[:, :, None] < behind[:, None, :]
            pairs = list(combinations(range(len(self.chains)), 2))
            place = pairs.index((min(i, j), max(i, j)))
            allowed[place] &= fits if i < j else fits.transpose(0, 2, 1)

    def _owner(self, part: tuple[str, str]) -> int:
        """The chain that carries a part, -1: the trunk."""
        skeleton = self.body.skeleton
        owners = set()
        for joint in skeleton.joint_index(part):
            segment = skeleton.joint_segments[joint]
            if not np.any(skeleton.joint_offsets[joint]):
                segment = skeleton.parents[segment]  # which has it at its end
            owners |= {c for c, x in enumerate(self.chains) if segment in skeleton.chains[x]}
        if len(owners) > 1:
            raise ValueError(f'joints {part} of a depth order belong to different chains')
        return int(owners.pop()) if owners else -1


def _crossing(body: Body, pose: Array, order: DepthOrder) -> tuple[float, float]:
    """Where in the image two parts cross, or come nearest, as shares of their lengths there."""
    ends = []
    for part in order:
        joints = body.joint_positions(pose[None])[0, body.skeleton.joint_index(part)]
        ends.append(joints[:, :2] / joints[:, 2:])
    (a, b), (c, e) = ends
    u, v, w = b - a, e - c, a - c
    uu, uv, vv, uw, vw = u @ u, u @ v, v @ v, u @ w, v @ w
    s = np.clip((uv * vw - vv * uw) / max(uu * vv - uv * uv, 1e-15), 0.0, 1.0)
    t = np.clip((uv * s + vw) / max(vv, 1e-15), 0.0, 1.0)
    s = np.clip((uv * t - uw) / max(uu, 1e-15), 0.0, 1.0)
    return float(s), float(t)
