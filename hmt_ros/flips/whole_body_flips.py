"""Flips of the whole body: products of the trees of its chains, over flips of its torso (KJS 3).

Poses and their flipped torsos are the trunks. On each of them every chain has the leaves of its
interpretation tree, hung back onto its rays. A whole pose is a trunk with one leaf of each chain,
and its prior probability is a product over these: so the leaves of the body can be taken in order
of probability, or sampled, from lists of a few dozen entries, before any pose is built.

What is known to be wrong is pruned before any pose is built (`flip_pruning`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.inverse_kinematics import solve_joint_positions
from hmt_ros.flips.best_combinations import distinct_poses, least_sums
from hmt_ros.flips.flip_pruning import DepthOrder, FlipPruning
from hmt_ros.flips.interpretation_tree import enumerate_flips, rehang_chain
from hmt_ros.flips.torso_flips import JOINTS, flip_torso

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Distance of some joint of the torso below which two trunks are one, m.
SAME_TRUNK = 0.03
# Of inverse kinematics, which starts near where it ends.
ITERATIONS = 20
# Rejected samples that are drawn anew before it is given up.
ROUNDS = 200


class Leaves(NamedTuple):
    """Whole poses.

    Attributes:
        poses: (N, d).
        log_priors: (N,) of the soft prior, up to a constant of the body.
        trunks: (N,) index of the trunk.
    """

    poses: Array
    log_priors: Array
    trunks: Index


@dataclass(frozen=True, eq=False)
class FlipProduct:
    """All flips of N poses, as lists for T trunks and C chains.

    Attributes:
        body: the body.
        chains: (C,) names.
        trunks: (T, d) poses, of which what is not part of a chain counts.
        parents: (T,) index of the given pose that each comes from.
        trunk_log_priors: (T,) of that part.
        angles: of each chain (T, A, chain dofs), A the most leaves on any trunk.
        log_priors: of each chain (T, A), -inf where there is no leaf or it is pruned.
        allowed: of each pair of chains, in the order of `itertools.combinations`, (T, A, A').
    """

    body: Body
    chains: tuple[str, ...]
    trunks: Array
    parents: Index
    trunk_log_priors: Array
    angles: tuple[Array, ...]
    log_priors: tuple[Array, ...]
    allowed: tuple[Mask, ...]

    @property
    def size(self) -> int:
        """Number of leaves that no chain alone rules out."""
        counts = np.array([np.isfinite(p).sum(1) for p in self.log_priors])
        return int(counts.prod(0).sum())

    def most_probable(self, count: int) -> Leaves:
        """The leaves of highest prior probability, most probable first.

        Args:
            count: maximum number.
        """
        costs, trunks = [np.empty(0)], [np.empty(0, dtype=np.intp)]
        picks = [np.empty((0, len(self.chains)), dtype=np.intp)]
        pairs = list(combinations(range(len(self.chains)), 2))
        for t, base in enumerate(self.trunk_log_priors):
            leaves = [np.flatnonzero(np.isfinite(own[t])) for own in self.log_priors]
            ruled_out = {
                (i, j): table[t][np.ix_(leaves[i], leaves[j])]
                for (i, j), table in zip(pairs, self.allowed, strict=True)
                if not table[t].all()
            }
            lists = [-own[t][which] for own, which in zip(self.log_priors, leaves, strict=True)]
            sums, chosen = least_sums(lists, count, ruled_out)
            costs.append(sums - base)
            trunks.append(np.full(len(sums), t))
            picks.append(np.stack([own[c] for own, c in zip(leaves, chosen.T)], axis=1))
        cost = np.concatenate(costs)
        order = np.argsort(cost, kind='stable')[:count]
        return self._leaves(
            np.concatenate(trunks)[order], np.concatenate(picks)[order], -cost[order]
        )

    def sample(self, count: int, rng: np.random.Generator) -> Leaves:
        """Leaves drawn by their prior probability.

        Args:
            count: how many.
            rng: source of randomness.

        Raises:
            ValueError: there are no leaves, or hardly one in a hundred that pruning leaves.
        """
        totals = self.trunk_log_priors.copy()
        cumulative = []
        for log_priors in self.log_priors:
            top = log_priors.max(1, initial=-np.inf, keepdims=True)
            top = np.where(np.isfinite(top), top, 0.0)
            weights = np.exp(log_priors - top)
            with np.errstate(divide='ignore', invalid='ignore'):
                totals += np.log(weights.sum(1)) + top[:, 0]
                cumulative.append(np.cumsum(weights / weights.sum(1, keepdims=True), axis=1))
        if not np.isfinite(totals).any():
            raise ValueError('the product of flips has no leaves')
        shares = np.cumsum(np.exp(totals - totals.max()))
        trunks, picks = np.empty(0, dtype=np.int64), np.empty((0, len(self.chains)), dtype=np.int64)
        for _ in range(ROUNDS):
            missing = count - len(trunks)
            if missing == 0:
                break
            t = np.searchsorted(shares, shares[-1] * rng.random(missing), side='right')
            drawn = np.empty((missing, len(self.chains)), dtype=np.int64)
            for c, sums in enumerate(cumulative):
                drawn[:, c] = (rng.random((missing, 1)) * sums[t, -1:] >= sums[t]).sum(1)
            fits = np.ones(missing, dtype=np.bool_)
            pairs = combinations(range(len(self.chains)), 2)
            for (first, second), table in zip(pairs, self.allowed, strict=True):
                fits &= table[t, drawn[:, first], drawn[:, second]]
            trunks, picks = np.append(trunks, t[fits]), np.append(picks, drawn[fits], axis=0)
        if len(trunks) < count:
            raise ValueError(
                f'pruning leaves {len(trunks)} of {count} samples after {ROUNDS} tries'
            )
        log_priors = self.trunk_log_priors[trunks]
        for c, own in enumerate(self.log_priors):
            log_priors = log_priors + own[trunks, picks[:, c]]
        return self._leaves(trunks, picks, log_priors)

    def _leaves(self, trunks: Index, picks: Index, log_priors: Array) -> Leaves:
        poses = np.take(self.trunks, trunks, axis=0)
        for c, chain in enumerate(self.chains):
            dofs = self.body.skeleton.chain_dofs[chain]
            _put_angles(poses, dofs, self.angles[c], trunks, picks[:, c])
        return Leaves(poses, log_priors, trunks)


def full_body_flips(
    body: Body,
    poses: ArrayLike,
    chains: Sequence[str] | None = None,
    *,
    torso: bool = True,
    depth_orders: Sequence[DepthOrder] = (),
    most_overlap: float = 0.05,
    slack: float = 0.03,
) -> FlipProduct:
    """All flips of poses: of their torsos, by iterative inverse kinematics, and of their chains.

    On the trunk of a given pose all leaves have its image exactly. A torso that is flipped has it
    within `slack`, as it is not a chain, and its limbs are hung from where it has them: exactly
    onto their rays, or touching those that miss their sphere by less than the slack, or else, where
    no leaf is left, by iterative inverse kinematics within the slack.

    Args:
        body: the body.
        poses: (N, d) or (d,).
        chains: names; None: all that the body has.
        torso: whether the torsos flip, too.
        depth_orders: what is known of which part is before which.
        most_overlap: leaves are pruned in which parts overlap by more, m; inf: none. The given
            poses stay.
        slack: by which the image of a flipped torso may differ, m at the distance of the joints.

    Raises:
        KeyError, ValueError: as `enumerate_flips`; a depth order over joints of several chains.
    """
    given = np.array(poses, dtype=np.float64, ndmin=2)
    names = tuple(body.chains) if chains is None else tuple(chains)
    enumerate_flips(body, given[:0], names)  # raises where chains do not go together
    trunks, parents = given, np.arange(len(given))
    if torso:
        flips, roots = _torso_flips(body, given, slack)
        trunks, parents = np.concatenate([trunks, flips]), np.append(parents, roots)
    angles, log_priors = [], []
    for chain in names:
        own, valid = _hung(body, given, trunks, parents, chain, slack)
        dofs = body.skeleton.chain_dofs[chain]
        offset = (own - body.prior_mean[dofs]) / body.prior_sigma[dofs]
        angles.append(own)
        log_priors.append(np.where(valid, -0.5 * (offset * offset).sum(2), -np.inf))
    limbs = [j for chain in names for j in body.skeleton.chain_dofs[chain]]
    offset = (trunks - body.prior_mean) / body.prior_sigma
    offset[:, limbs] = 0.0
    trunk_log_priors = -0.5 * (offset * offset).sum(1)
    pruning = FlipPruning(body, names, given, trunks, parents, angles, log_priors)
    allowed = pruning.allowed(most_overlap)
    for order in depth_orders:
        pruning.keep_order(order, trunk_log_priors, allowed)
    fits = np.isfinite(trunk_log_priors)
    for own in log_priors:
        fits &= np.isfinite(own).any(1)
    return FlipProduct(
        body, names, trunks[fits], parents[fits], trunk_log_priors[fits],
        tuple(a[fits] for a in angles), tuple(p[fits] for p in log_priors),
        tuple(table[fits] for table in allowed),
    )  # fmt: skip


def _torso_flips(body: Body, poses: Array, slack: float) -> tuple[Array, Index]:
    """Flipped torsos (T, d) that have the image of those of poses within a slack, and of which."""
    flips, parents = flip_torso(body, poses)
    if len(flips) == 0:
        return flips, parents
    which = body.skeleton.joint_index(JOINTS)
    limbs = [j for chain in body.chains for j in body.skeleton.chain_dofs[chain]]
    free = [name for j, name in enumerate(body.dof_names) if j not in limbs]
    before = body.joint_positions(poses)[:, which]
    seen = before[parents]
    flips = solve_joint_positions(
        body, flips, seen, JOINTS, free_dofs=free, along_rays=True, sigma=0.005,
        max_iterations=ITERATIONS, tolerance=1e-3,
    ).x  # fmt: skip
    torsos = body.joint_positions(flips)[:, which]
    near = _off_rays(torsos, seen).max(1) <= slack
    kept = []
    for n in range(len(poses)):
        own = np.flatnonzero(near & (parents == n))
        distinct = distinct_poses(np.concatenate([before[n : n + 1], torsos[own]]), SAME_TRUNK)
        kept.append(own[distinct.kept[1:] - 1])
    chosen = np.concatenate(kept)
    return flips[chosen], parents[chosen]


def _off_rays(joints: Array, seen: Array) -> Array:
    """Distances (...) of points from the rays of others, m."""
    rays = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    distances: Array = np.linalg.norm(np.cross(joints, rays), axis=-1)
    return distances


def _hung(
    body: Body, poses: Array, trunks: Array, parents: Index, chain: str, slack: float
) -> tuple[Array, Mask]:
    """Leaves (T, A, chain dofs) of a chain on every trunk, and where they are.

    The first trunks are those of the poses; each has the given leaf first.
    """
    dofs, count = body.skeleton.chain_dofs[chain], len(poses)
    leaves, roots = enumerate_flips(body, poses, chain)
    seen, others = poses[parents[count:]], trunks[count:]
    hung, owners = rehang_chain(body, seen, others, chain, slack=slack)
    missing = np.setdiff1d(np.arange(len(others)), owners)
    if len(missing):
        reached, which = _reached(body, seen[missing], others[missing], chain, slack)
        hung, owners = np.append(hung, reached, axis=0), np.append(owners, missing[which])
    owners = np.append(roots, owners + count)
    counts = np.bincount(owners, minlength=len(trunks))
    order = np.argsort(owners, kind='stable')
    places = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
    most = int(counts.max(initial=0))
    angles = np.zeros((len(trunks), most, len(dofs)))
    angles[owners[order], places] = np.append(leaves, hung, axis=0)[order][:, dofs]
    valid: Mask = np.arange(most) < counts[:, None]
    return angles, valid


def _reached(
    body: Body, poses: Array, trunks: Array, chain: str, slack: float
) -> tuple[Array, Index]:
    """Poses whose chain comes within the slack of its rays, where no leaf of its tree does."""
    dofs = body.skeleton.chain_dofs[chain]
    skeleton = body.skeleton
    own = skeleton.chain_joints[chain]
    names = tuple(skeleton.joint_names[j] for j in own)
    seen = body.joint_positions(poses)[:, own]
    starts = trunks.copy()
    starts[:, dofs] = poses[:, dofs]
    solved = solve_joint_positions(
        body, starts, seen, names, free_dofs=[body.dof_names[j] for j in dofs], along_rays=True,
        sigma=0.005, max_iterations=ITERATIONS, tolerance=1e-3,
    ).x  # fmt: skip
    misses = _off_rays(body.joint_positions(solved)[:, own], seen).max(1)
    near = np.flatnonzero(misses <= slack)
    return solved[near], near


@njit(cache=True, nogil=True)
def _put_angles(poses, dofs, angles, trunks, picks):  # type: ignore[no-untyped-def]
    """Writes angles (T, A, D) of a chain, chosen by trunk and pick, into poses (N, d)."""
    for n in range(len(poses)):
        for k in range(len(dofs)):
            poses[n, dofs[k]] = angles[trunks[n], picks[n], k]
