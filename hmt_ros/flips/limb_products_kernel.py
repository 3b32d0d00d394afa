"""The compiled part of `limb_products`: configurations of limbs, and their best products."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.kinematics import place_pose, place_segment
from hmt_ros.body.skeleton import Skeleton, sided_pairs
from hmt_ros.flips.interpretation_tree import keep_distinct
from hmt_ros.flips.tree_growth import ChainLinks, chain_links, grow_leaves
from hmt_ros.inference.arrays import Array

# A ray that misses its sphere by less than this touches it, where a limb hangs elsewhere, m.
SLACK = 0.1


class Limbs(NamedTuple):
    """The C limbs of a body as compiled code reads them, of at most K links and D variables.

    Attributes:
        links, dofs, joints: (C,) number of links, of degrees of freedom and of joints that move.
        segments, parents, mounts, mounted, lengths, first_dofs, own, lower, upper, sides: those of
            `ChainLinks`, filled up to the largest limb.
        joint_segments, joint_offsets: (C, J), (C, J, 3) of the joints that a limb moves.
        siblings: (C,) the limb of the other side; -1: there is none.
    """

    links: NDArray[np.int64]
    dofs: NDArray[np.int64]
    joints: NDArray[np.int64]
    segments: NDArray[np.int64]
    parents: NDArray[np.int64]
    mounts: Array
    mounted: NDArray[np.bool_]
    lengths: Array
    first_dofs: NDArray[np.int64]
    own: NDArray[np.int64]
    lower: Array
    upper: Array
    sides: NDArray[np.bool_]
    joint_segments: NDArray[np.int64]
    joint_offsets: Array
    siblings: NDArray[np.int64]


@lru_cache(maxsize=16)
def limbs_of(skeleton: Skeleton) -> Limbs:
    """The limbs of a skeleton, in the order of its chains.

    Raises:
        ValueError: a chain has no closed form; see `chain_links`.
    """
    names = list(skeleton.chains)
    chains = [chain_links(skeleton, name) for name in names]
    moved = [skeleton.chain_joints[name] for name in names]
    siblings = np.full(len(names), -1)
    for pair in sided_pairs(skeleton.chains):
        left, right = (names.index(name) for name in pair)
        siblings[left], siblings[right] = right, left
    own: dict[str, Any] = {
        name: _filled([np.asarray(getattr(chain, name)) for chain in chains])
        for name in (
            'segments',
            'mounts',
            'mounted',
            'lengths',
            'first_dofs',
            'lower',
            'upper',
            'sides',
        )
    }
    return Limbs(
        links=np.array([len(chain.lengths) for chain in chains], dtype=np.int64),
        dofs=np.array([len(chain.dofs) for chain in chains], dtype=np.int64),
        joints=np.array([len(joints) for joints in moved], dtype=np.int64),
        parents=np.array([chain.parent for chain in chains], dtype=np.int64),
        own=_filled([chain.dofs.astype(np.int64) for chain in chains]),
        joint_segments=_filled([skeleton.joint_segments[x].astype(np.int64) for x in moved]),
        joint_offsets=_filled([skeleton.joint_offsets[x] for x in moved]),
        siblings=siblings.astype(np.int64),
        **own,
    )


def _filled(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Arrays of different lengths in one, filled up with zeros."""
    most = max(len(x) for x in arrays)
    result = np.zeros((len(arrays), most, *arrays[0].shape[1:]), dtype=arrays[0].dtype)
    for row, x in zip(result, arrays, strict=True):
        row[: len(x)] = x
    return result


class Configurations(NamedTuple):
    """Configurations of limbs on T trunks; the first trunk is that of G modes.

    Attributes:
        trunks: (T, d) a pose of each trunk.
        angles: (T, C, A, D) angles of each configuration of each limb.
        counts: (T, C) number of configurations; 0: those on the first trunk.
        penalties: (G, C, A) minus the log probability that a mode takes each on the first trunk.
    """

    trunks: Array
    angles: Array
    counts: NDArray[np.int64]
    penalties: Array


@njit(cache=True, nogil=True)
def _links(limbs, c):  # type: ignore[no-untyped-def]
    """The `ChainLinks` of limb c."""
    k, d = limbs.links[c], limbs.dofs[c]
    return ChainLinks(
        limbs.segments[c, :k],
        limbs.parents[c],
        limbs.mounts[c, :k],
        limbs.mounted[c, :k],
        limbs.lengths[c, :k],
        limbs.first_dofs[c, : k + 1],
        limbs.own[c, :d],
        limbs.lower[c, :d],
        limbs.upper[c, :d],
        limbs.sides[c, :k],
    )


@njit(cache=True, nogil=True)
def _ends(limbs, c, columns, origins):  # type: ignore[no-untyped-def]
    """Ends (K, 3, 1) of the links of limb c in the frames of a pose."""
    ends = np.empty((limbs.links[c], 3, 1))
    for k in range(limbs.links[c]):
        s, length = limbs.segments[c, k], limbs.lengths[c, k]
        for x in range(3):
            ends[k, x, 0] = origins[s, x] - length * columns[s, 2, x]
    return ends


@njit(cache=True, nogil=True)
def _hang(limbs, c, columns, origins, pose, ends, slack, leaves, out):  # type: ignore[no-untyped-def]
    """Writes the leaves of the tree of limb c into rows (A, D) of out; returns their number.

    Args:
        limbs, c: the limb.
        columns, origins: frames of the trunk that it hangs on.
        pose: (d,) whose angles are near.
        ends: (K, 3, 1) points on the rays of its joints.
        slack: see `grow_leaves`; 0: the ends are those of the pose, which is left out.
        leaves: (1, 2^K, D) room for their angles.
        out: (A, D).
    """
    links, given = _links(limbs, c), slack == 0.0
    count, width = 1 << limbs.links[c], leaves.shape[2]
    valid = np.zeros((1, count), np.bool_)
    grow_leaves(
        links,
        columns.reshape(len(columns), 3, 3, 1),
        origins.reshape(len(origins), 3, 1),
        pose.reshape(1, len(pose)),
        ends,
        slack,
        given,
        leaves[0, :count].reshape(1, count, width),
        valid,
    )
    n = 0
    for leaf in range(1 if given else 0, count):
        if valid[0, leaf]:
            for j in range(limbs.dofs[c]):
                out[n, j] = leaves[0, leaf, j]
            n += 1
    return n


@njit(cache=True, nogil=True)
def _distinct_angles(tree, limbs, c, columns, origins, pose, angles, apart, most):  # type: ignore[no-untyped-def]
    """Indices of the distinct configurations (A, D) of limb c, and the one that stands for each.

    Args:
        tree, limbs, c: the limb.
        columns, origins: frames of the trunk; those of the limb are overwritten.
        pose: (d,) with that trunk; its limb is overwritten.
        angles: (A, D).
        apart, most: see `keep_distinct`.
    """
    d = len(pose)
    axes, on_axes = np.empty((d, 3)), np.empty((d, 3))
    joints = limbs.joints[c]
    points = np.empty((len(angles), 3 * joints))
    for i in range(len(angles)):
        for j in range(limbs.dofs[c]):
            pose[limbs.own[c, j]] = angles[i, j]
        for k in range(limbs.links[c]):
            place_segment(tree, limbs.segments[c, k], pose, columns, origins, axes, on_axes)
        for j in range(joints):
            s = limbs.joint_segments[c, j]
            for x in range(3):
                points[i, 3 * j + x] = (
                    columns[s, 0, x] * limbs.joint_offsets[c, j, 0]
                    + columns[s, 1, x] * limbs.joint_offsets[c, j, 1]
                    + columns[s, 2, x] * limbs.joint_offsets[c, j, 2]
                    + origins[s, x]
                )
    return keep_distinct(points, apart, most)


@njit(cache=True, nogil=True)
def _keep(tree, limbs, c, columns, origins, pose, angles, apart, out):  # type: ignore[no-untyped-def]
    """Writes the distinct ones of configurations (A, D) into out (most, D); how many there are."""
    kept, _ = _distinct_angles(
        tree, limbs, c, columns.copy(), origins.copy(), pose.copy(), angles, apart, len(out)
    )
    for i in range(len(kept)):
        out[i] = angles[kept[i]]
    return len(kept)


@njit(cache=True, nogil=True)
def fill_configurations(tree, limbs, modes, found, found_counts, flipped, price, apart, result):  # type: ignore[no-untyped-def]
    """Fills the configurations of a group; see `LimbProducts.of`.

    Returns:
        The number of trunks with limbs that have changed places.
    """
    segments, d = len(tree.parents), modes.shape[1]
    limit, width = len(limbs.links), limbs.own.shape[1]
    columns, origins = np.empty((segments, 3, 3)), np.empty((segments, 3))
    moved, places = np.empty((segments, 3, 3)), np.empty((segments, 3))
    axes, on_axes = np.empty((d, 3)), np.empty((d, 3))
    most_leaves = 1 << limbs.segments.shape[1]
    leaves = np.empty((1, most_leaves, width))
    lead, pose = modes[0], np.empty(d)
    place_pose(tree, lead, columns, origins, axes, on_axes)
    sources = len(modes) + found.shape[1] + most_leaves
    given, firsts = np.zeros((sources, width)), np.zeros(sources, np.int64)
    angles = np.zeros((sources * (1 + most_leaves), width))
    result.trunks[0] = lead
    # Limbs on the first trunk: of the modes, those found, in the other side's place; each with its
    # flips, which are not to be crowded out by modes that tremble.
    for c in range(limit):
        count = 0
        for g in range(len(modes)):
            for j in range(limbs.dofs[c]):
                given[count, j] = modes[g, limbs.own[c, j]]
            count += 1
        for i in range(found_counts[c]):
            given[count] = found[c, i]
            count += 1
        if limbs.siblings[c] >= 0:
            ends = _ends(limbs, limbs.siblings[c], columns, origins)
            count += _hang(limbs, c, columns, origins, lead, ends, SLACK, leaves, given[count:])
        n = 0
        for i in range(count):
            firsts[i], angles[n] = n, given[i]
            n += 1
            pose[:] = lead
            for j in range(limbs.dofs[c]):
                pose[limbs.own[c, j]] = given[i, j]
            place_pose(tree, pose, moved, places, axes, on_axes)
            ends = _ends(limbs, c, moved, places)
            n += _hang(limbs, c, moved, places, pose, ends, 0.0, leaves, angles[n:])
        moved[:], places[:], pose[:] = columns, origins, lead
        most = result.angles.shape[2]
        kept, owner = _distinct_angles(tree, limbs, c, moved, places, pose, angles[:n], apart, most)
        result.counts[0, c] = len(kept)
        for i in range(len(kept)):
            result.angles[0, c, i] = angles[kept[i]]
        for i in range(n):
            if owner[i] >= 0:
                for g in range(len(modes)):
                    penalty = 0.0 if i == firsts[g] else price
                    result.penalties[g, c, owner[i]] = min(
                        result.penalties[g, c, owner[i]], penalty
                    )
    # Two limbs each in the other's place.
    t = 1
    for c in range(limit):
        other = limbs.siblings[c]
        if other < c:
            continue
        result.trunks[t] = lead
        result.counts[t] = 0
        reached = True
        for turn in range(2):
            own, sibling = (c, other) if turn == 0 else (other, c)
            ends = _ends(limbs, sibling, columns, origins)
            n = _hang(limbs, own, columns, origins, lead, ends, SLACK, leaves, angles)
            if n == 0:
                reached = False
                break
            for j in range(limbs.dofs[own]):
                result.trunks[t, limbs.own[own, j]] = angles[0, j]
            result.counts[t, own] = _keep(
                tree, limbs, own, columns, origins, lead, angles[:n], apart, result.angles[t, own]
            )
        if reached:
            t += 1
    exchanged = t - 1
    # The torso flipped, with each limb on its rays.
    for f in range(len(flipped)):
        result.trunks[t] = flipped[f]
        result.counts[t] = 0
        place_pose(tree, flipped[f], moved, places, axes, on_axes)
        for c in range(limit):
            ends = _ends(limbs, c, columns, origins)
            n = _hang(limbs, c, moved, places, flipped[f], ends, SLACK, leaves, angles)
            if n == 0:
                for j in range(limbs.dofs[c]):
                    angles[0, j] = flipped[f, limbs.own[c, j]]
                n = 1
            for j in range(limbs.dofs[c]):
                result.trunks[t, limbs.own[c, j]] = angles[0, j]
            result.counts[t, c] = _keep(
                tree, limbs, c, moved, places, flipped[f], angles[:n], apart, result.angles[t, c]
            )
        t += 1
    return exchanged


@njit(cache=True, nogil=True)
def place_alone(limbs, found, poses):  # type: ignore[no-untyped-def]
    """Puts each configuration into its row of poses, which has the pose of its trunk."""
    row = 0
    for t in range(len(found.trunks)):
        row += 1
        for c in range(len(limbs.links)):
            for i in range(found.counts[t, c]):
                for j in range(limbs.dofs[c]):
                    poses[row, limbs.own[c, j]] = found.angles[t, c, i, j]
                row += 1


@njit(cache=True, nogil=True)
def combine(  # type: ignore[no-untyped-def]
    limbs, modes, found, energies, log_weights, trunk_weights, share, count, poses, parents, values
):
    """Fills poses, parents and values with the best products; see `LimbProducts.best`.

    Args:
        limbs: of the body.
        modes: (G, d).
        found: the configurations.
        energies: (R,) of the poses alone.
        log_weights: (G,) of the modes.
        trunk_weights: (T,) of the trunks after the first.
        share, count: see `LimbProducts.best`.
        poses, parents, values: (T count, d), (T count,), (T count,) results.

    Returns:
        The number of products.
    """
    trunks, limit, most = found.angles.shape[0], found.angles.shape[1], found.angles.shape[2]
    changes = np.zeros((trunks, limit, most))
    counts, origin = np.empty((trunks, limit), np.int64), np.zeros((trunks, limit), np.int64)
    bases = np.empty(trunks)
    row = 0
    for t in range(trunks):
        bases[t] = energies[row]
        row += 1
        for c in range(limit):
            counts[t, c], origin[t, c] = found.counts[t, c], t
            for i in range(found.counts[t, c]):
                changes[t, c, i] = energies[row] - bases[t]
                row += 1
            if found.counts[t, c] == 0:
                counts[t, c], origin[t, c] = counts[0, c], 0
    group = len(modes)
    costs = np.empty((limit, most))
    sums, picks = np.empty((group, count)), np.empty((group, count, limit), np.int64)
    room, taken = (np.empty(count), np.empty((count, limit), np.int64)), np.empty_like(picks[0])
    sizes, heads = np.empty(group, np.int64), np.empty(max(most, group), np.int64)
    n = 0
    for t in range(trunks):
        own = group if t == 0 else 1
        for g in range(own):
            for c in range(limit):
                at = origin[t, c]
                for i in range(counts[t, c]):
                    penalty = found.penalties[g, c, i] if at == 0 else 0.0
                    costs[c, i] = share * changes[at, c, i] + penalty
            sizes[g] = _least_sums(costs, counts[t], sums[g], picks[g], *room, heads)
            weight = log_weights[g] if t == 0 else trunk_weights[t]
            for i in range(sizes[g]):
                sums[g, i] -= weight
        # The same product of several modes: the best is its parent.
        first = n
        heads[:own] = 0
        while n < first + count:
            g = -1
            for other in range(own):
                if heads[other] < sizes[other] and (
                    g < 0 or sums[other, heads[other]] < sums[g, heads[g]]
                ):
                    g = other
            if g < 0:
                break
            pick = picks[g, heads[g]]
            heads[g] += 1
            if _among(pick, taken[: n - first]):
                continue
            taken[n - first] = pick
            parents[n] = g
            poses[n] = modes[g] if t == 0 else found.trunks[t]
            values[n] = bases[t]
            for c in range(limit):
                at, i = origin[t, c], pick[c]
                values[n] += changes[at, c, i]
                for j in range(limbs.dofs[c]):
                    poses[n, limbs.own[c, j]] = found.angles[at, c, i, j]
            n += 1
    return n


@njit(cache=True, nogil=True)
def _among(pick, taken):  # type: ignore[no-untyped-def]
    """Whether a row (C,) is one of taken (n, C)."""
    found = False
    for other in taken:
        found = found or (other == pick).all()
    return found


@njit(cache=True, nogil=True)
def _least_sums(costs, sizes, sums, picks, last_sums, last_picks, heads):  # type: ignore[no-untyped-def]
    """The choices of one entry a list with the least sums, the least first.

    List by list: each entry of a list stands before all sums so far, which are in order, and the
    least of the heads goes on. Equal sums stand in the order of the lists.

    Args:
        costs, sizes: (C, A), (C,) lists and their lengths.
        sums, picks: (n,), (n, C) results, least first.
        last_sums, last_picks: (n,), (n, C) to work on.
        heads: (A,) to work on.

    Returns:
        How many there are, n at most.
    """
    n = 1
    sums[0] = 0.0
    for c in range(len(sizes)):
        last_sums[:n], last_picks[:n, :c] = sums[:n], picks[:n, :c]
        heads[: sizes[c]] = 0
        more = min(len(sums), n * sizes[c])
        for k in range(more):
            best, least = -1, np.inf
            for a in range(sizes[c]):
                if heads[a] == n:
                    continue
                total = last_sums[heads[a]] + costs[c, a]
                if best < 0 or total < least or (total == least and heads[a] < heads[best]):
                    best, least = a, total
            sums[k] = least
            picks[k, :c] = last_picks[heads[best], :c]
            picks[k, c] = best
            heads[best] += 1
        n = more
    return n
