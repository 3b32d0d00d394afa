"""The best combinations of one alternative per chain, best first (KJS 3).

Given the trunk, the cost of a combination is a sum with one term per chain: of log priors for the
flips of whole bodies (`whole_body_flips`), of changes in energy for the tracker. `least_sums` takes
the best of them.

In the tracker, modes with nearly the same trunk form a group. For each chain the group has
alternatives: the configurations of its modes, their flips, and what a search of the image found.
Because limbs are nearly independent given the trunk, the energy of a combination is the energy of
the group's leading mode plus the change that each alternative makes alone: a few dozen evaluations
rate thousands of poses.

`distinct_poses` compares poses by their joint positions, not by their angles: a rotation has two
triples of Euler angles, Rx(a) Ry(b) Rz(c) = Rx(a + pi) Ry(pi - b) Rz(c + pi), every angle has its
turns of 2 pi, and the twist of a straight limb moves nothing that is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.inference.arrays import Array, Index


def least_sums(
    costs: Sequence[Array],
    count: int,
    allowed: Mapping[tuple[int, int], NDArray[np.bool_]] | None = None,
) -> tuple[Array, Index]:
    """The `count` choices of one entry per list with the least sums, least first.

    List by list, only the `count` best sums so far go on: what is among the best of all lists is
    among the best of the first few. Where pairs are ruled out this does not hold, and all sums go
    on that they allow. Equal sums stand in the order of the lists.

    Args:
        costs: C lists of costs, (A,) each.
        count: maximum number of choices.
        allowed: (A, A') for pairs i < j of lists, which entries go together; all, where missing.

    Returns:
        sums (n,) and choices (n, C).
    """
    tables = dict(allowed or {})
    sums, picks = np.zeros(1), np.zeros((1, 0), dtype=np.intp)
    for c, cost in enumerate(costs):
        total = (sums[:, None] + cost).ravel()
        order = np.argsort(total, kind='stable')[: None if tables else count]
        before, last = np.divmod(order, len(cost))
        for (i, j), table in tables.items():
            if j == c:
                fits = table[picks[before, i], last]
                order, before, last = order[fits], before[fits], last[fits]
        sums, picks = total[order], np.column_stack([picks[before], last])
    return sums[:count], picks[:count]


@dataclass(frozen=True, eq=False)
class Alternatives:
    """Configurations of one chain, for the modes of a group.

    Attributes:
        chain: name of the chain.
        angles: (A, chain dofs) angles of each configuration.
        penalties: (G, A) minus the log probability that a mode of the group takes each of them.
    """

    chain: str
    angles: Array
    penalties: Array


@dataclass(frozen=True, eq=False)
class Combinations:
    """Whole poses.

    Attributes:
        poses: (N, d).
        parents: (N,) position in the group of the mode that each pose comes from.
        energies: (N,) estimated energies.
        log_priors: (N,) log probability of the combination given the previous modes.
    """

    poses: Array
    parents: Index
    energies: Array
    log_priors: Array


def distinct_alternatives(
    body: Body, pose: Array, chain: str, angles: Array, penalties: Array, apart: float, most: int
) -> Alternatives:
    """Merges configurations of a chain of which no joint differs by `apart` (m) or more.

    The first of them is kept, with the smallest of their penalties.

    Args:
        body: the body.
        pose: (d,) whose trunk the chain hangs on.
        chain: name of the chain.
        angles: (A, chain dofs) candidates, most important first.
        penalties: (G, A) of the candidates.
        apart: distance from which on configurations are distinct, m.
        most: maximum number of configurations that are kept.
    """
    skeleton = body.skeleton
    poses = np.repeat(pose[None], len(angles), axis=0)
    poses[:, body.skeleton.chain_dofs[chain]] = angles
    moved = skeleton.chain_joints[chain]
    frames = forward(skeleton, poses)
    joints = frames.points(skeleton.joint_segments[moved], skeleton.joint_offsets[moved])
    kept, owner = distinct_poses(joints.transpose(2, 0, 1), apart, most)
    least = np.full((len(kept), len(penalties)), np.inf)
    np.minimum.at(least, owner[owner >= 0], penalties[:, owner >= 0].T)
    return Alternatives(chain, angles[kept], np.ascontiguousarray(least.T))


def best_combinations(
    body: Body,
    modes: Array,
    log_weights: Array,
    base_energy: float,
    alternatives: list[Alternatives],
    changes: list[Array],
    temperature: float,
    count: int,
) -> Combinations:
    """The most probable combinations of one alternative per chain, best first.

    The cost of a combination is the sum over chains of the tempered changes in energy and the
    penalties, minus the log weight of the mode.

    Args:
        body: the body.
        modes: (G, d) modes of the group.
        log_weights: (G,) log weights of the modes.
        base_energy: energy of the leading mode.
        alternatives: the alternatives of each chain.
        changes: (A,) change in energy that each alternative makes alone, for each chain.
        temperature: factor on energies in a log weight.
        count: maximum number of combinations.
    """
    sizes = tuple(len(c) for c in changes)
    keys, costs, parents, priors = [], [], [], []
    for g in range(len(modes)):
        tempered = [temperature * e + a.penalties[g] for e, a in zip(changes, alternatives)]
        sums, picks = least_sums(tempered, count)
        penalty = sum(a.penalties[g][picks[:, c]] for c, a in enumerate(alternatives))
        keys.append(np.ravel_multi_index(tuple(picks.T), sizes))
        costs.append(sums - log_weights[g])
        parents.append(np.full(len(sums), g))
        priors.append(log_weights[g] - penalty)
    key, cost = np.concatenate(keys), np.concatenate(costs)
    order = np.argsort(cost, kind='stable')
    # The same combination from several modes: the best is its parent, their priors add up.
    unique, first, group = np.unique(key[order], return_index=True, return_inverse=True)
    total = np.full(len(unique), -np.inf)
    np.logaddexp.at(total, group, np.concatenate(priors)[order])
    best = np.argsort(first, kind='stable')[:count]
    parent = np.concatenate(parents)[order][first[best]]
    picks = np.stack(np.unravel_index(unique[best], sizes), axis=1)
    poses = modes[parent]
    energies = np.full(len(best), base_energy)
    for c, (own, change) in enumerate(zip(alternatives, changes, strict=True)):
        poses[:, body.skeleton.chain_dofs[own.chain]] = own.angles[picks[:, c]]
        energies = energies + change[picks[:, c]]
    return Combinations(poses, parent, energies, total[best])


class Distinct(NamedTuple):
    """Poses that represent all of a set.

    Attributes:
        kept: (K,) indices, in the order of the poses.
        owner: (N,) position in `kept` of the representative of each pose; -1 where the maximum
            number was reached before.
    """

    kept: Index
    owner: Index


def distinct_poses(joints: ArrayLike, apart: float, most: int | None = None) -> Distinct:
    """Poses that differ from every earlier one.

    The distance of two poses is that of the joint that is furthest apart. A pose that is nearer
    than `apart` to one that is kept is represented by the nearest of these. So the first, best
    poses represent later ones.

    Args:
        joints: (N, J, 3) joint positions of the poses, m.
        apart: distance from which on two poses are distinct, m.
        most: maximum number of poses that are kept; None keeps all that are distinct.

    Raises:
        ValueError: joints of another shape.
    """
    points = np.ascontiguousarray(joints, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f'joints must have shape (N, J, 3), saw {points.shape}')
    flat = points.reshape(len(points), 3 * points.shape[1])
    return Distinct(*_distinct(flat, float(apart), len(flat) if most is None else int(most)))


@njit(cache=True, nogil=True)
def _distinct(points, apart, most):  # type: ignore[no-untyped-def]
    """Indices of the poses (N, 3 J) that are kept, and which stands for each."""
    n = len(points)
    kept, owner = np.empty(n, np.int64), np.full(n, -1)
    count = 0
    for i in range(n):
        least = apart * apart
        for place in range(count):
            k = kept[place]
            gap = 0.0
            for j in range(0, points.shape[1], 3):
                x = points[k, j] - points[i, j]
                y = points[k, j + 1] - points[i, j + 1]
                z = points[k, j + 2] - points[i, j + 2]
                gap = max(gap, x * x + y * y + z * z)
                if gap >= least:
                    break
            if gap < least:
                owner[i], least = place, gap
        if owner[i] < 0 and count < most:
            kept[count], owner[i] = i, count
            count += 1
    return kept[:count], owner
