"""Products of chain alternatives: whole poses from one configuration of each limb.

Modes with nearly the same trunk form a group. For each chain the group has alternatives: the
configurations of its modes, their flips, and what a search of the image found. Because limbs are
nearly independent given the trunk, the energy of a combination is the energy of the group's leading
mode plus the change that each alternative makes alone: a few dozen evaluations rate thousands of
poses.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.tracking.proposals import chain_dofs

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Alternatives:
    """Configurations of one chain, for the modes of a group.

    Attributes:
        chain: name.
        angles: (A, chain dofs).
        penalties: (G, A) -log probability that a mode of the group takes each.
    """

    chain: str
    angles: Array
    penalties: Array


@dataclass(frozen=True, eq=False)
class Combinations:
    """Whole poses.

    Attributes:
        poses: (N, d).
        parents: (N,) mode that each comes from, position in the group.
        energies: (N,) estimated.
        log_priors: (N,) log probability of the combination given the modes before.
    """

    poses: Array
    parents: Index
    energies: Array
    log_priors: Array


def distinct_alternatives(
    body: Body, pose: Array, chain: str, angles: Array, penalties: Array, apart: float, most: int
) -> Alternatives:
    """Merges configurations of a chain whose joints nowhere differ by more than `apart`, m.

    Earlier ones stand for later ones and take the smaller of their penalties.

    Args:
        body: the body.
        pose: (d,) whose trunk the chain hangs on.
        chain: name.
        angles: (A, chain dofs) candidates, most important first.
        penalties: (G, A).
        apart: distance that makes configurations distinct, m.
        most: how many to keep.
    """
    own = chain_dofs(body, chain)
    poses = np.repeat(pose[None], len(angles), axis=0)
    poses[:, own] = angles
    moved = np.isin(body.skeleton.joint_segments, body.skeleton.chains[chain])
    joints = body.joint_positions(poses)[:, moved]
    kept: list[int] = []
    result = penalties.copy()
    for i in range(len(angles)):
        if kept:
            gaps = np.linalg.norm(joints[kept] - joints[i], axis=2).max(1)
            nearest = int(np.argmin(gaps))
            if gaps[nearest] < apart:
                k = kept[nearest]
                result[:, k] = np.minimum(result[:, k], penalties[:, i])
                continue
        if len(kept) < most:
            kept.append(i)
    return Alternatives(chain, angles[kept], result[:, kept])


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
    """The most probable combinations of one alternative per chain.

    Best first by the sum over chains of energy changes and penalties, without building the product.

    Args:
        body: the body.
        modes: (G, d) the group.
        log_weights: (G,) of the modes.
        base_energy: of the leading mode.
        alternatives: one entry a chain.
        changes: (A,) energy change that each alternative makes alone.
        temperature: factor on energies in a log weight.
        count: how many.
    """
    found: list[tuple[float, int, tuple[int, ...]]] = []
    for g in range(len(modes)):
        costs = [temperature * e + a.penalties[g] for e, a in zip(changes, alternatives)]
        for cost, pick in _least_sums(costs, count):
            found.append((cost - log_weights[g], g, pick))
    found.sort(key=lambda item: item[0])
    best: dict[tuple[int, ...], tuple[float, int]] = {}
    priors: dict[tuple[int, ...], float] = {}
    for cost, g, pick in found:
        best.setdefault(pick, (cost, g))
        prior = log_weights[g] - sum(a.penalties[g][i] for a, i in zip(alternatives, pick))
        priors[pick] = float(np.logaddexp(priors.get(pick, -np.inf), prior))
    picks = list(best)[:count]
    parents = np.array([best[p][1] for p in picks], dtype=np.intp)
    poses = modes[parents]
    energies = np.full(len(picks), base_energy)
    for c, (own, change) in enumerate(zip(alternatives, changes, strict=True)):
        index = np.array([p[c] for p in picks], dtype=np.intp)
        poses[:, chain_dofs(body, own.chain)] = own.angles[index]
        energies = energies + change[index]
    return Combinations(poses, parents, energies, np.array([priors[p] for p in picks]))


def _least_sums(costs: list[Array], count: int) -> list[tuple[float, tuple[int, ...]]]:
    """The `count` choices of one entry per list with the least sums, least first."""
    orders = [np.argsort(c, kind='stable') for c in costs]
    ranked = [c[o] for c, o in zip(costs, orders)]
    start = (0,) * len(costs)
    heap = [(float(sum(r[0] for r in ranked)), start)]
    seen = {start}
    result: list[tuple[float, tuple[int, ...]]] = []
    while heap and len(result) < count:
        total, ranks = heapq.heappop(heap)
        result.append((total, tuple(int(o[i]) for o, i in zip(orders, ranks))))
        for c, rank in enumerate(ranks):
            if rank + 1 < len(ranked[c]):
                following = (*ranks[:c], rank + 1, *ranks[c + 1 :])
                if following not in seen:
                    seen.add(following)
                    step = float(ranked[c][rank + 1] - ranked[c][rank])
                    heapq.heappush(heap, (total + step, following))
    return result
