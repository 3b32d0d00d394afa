"""Flips of the whole body: products of the trees of its chains, over flips of its torso (KJS 3).

Poses and their flipped torsos are the trunks. On each of them every chain has the leaves of its
interpretation tree, hung back onto its rays. A whole pose is a trunk with one leaf of each chain,
and its prior probability is a product over these: so the leaves of the body can be taken in order
of probability, or sampled, from lists of a few dozen entries, before any pose is built.

What is known to be wrong is pruned before any pose is built: leaves of chains that run through the
trunk or themselves, pairs of leaves of two chains that run through each other, and what contradicts
a known order in depth.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hmt_learning.motion.inverse_kinematics import solve_joint_positions
from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.self_intersection import _axes_of, _far, _overlap, _pairs, _place_centres
from hmt_ros.flips.interpretation_tree import _ends, _grown, distinct_poses, enumerate_flips
from hmt_ros.flips.torso_flips import JOINTS, flip_torso
from hmt_ros.flips.tree_growth import chain_links
from hmt_ros.inference.arrays import Array, Index, Mask

SAME_TRUNK = 0.03  # m; torsos of which no joint differs by more are the same
ITERATIONS = 20  # of inverse kinematics, which starts near its solution
ROUNDS = 200  # maximum number of times that rejected samples are drawn again


class DepthOrder(NamedTuple):
    """A part of the body that hides another one.

    Attributes:
        front, behind: joints at the two ends of each part; the same joint twice is that joint.
    """

    front: tuple[str, str]
    behind: tuple[str, str]


class Leaves(NamedTuple):
    """Whole poses.

    Attributes:
        poses: (N, d).
        log_priors: (N,) log density of the soft prior, up to a constant of the body.
        trunks: (N,) index of the trunk of each pose.
    """

    poses: Array
    log_priors: Array
    trunks: Index


@dataclass(frozen=True, eq=False)
class FlipProduct:
    """All flips of N poses, as lists for T trunks and C chains.

    Attributes:
        body: the body.
        chains: (C,) names of the chains.
        trunks: (T, d) poses; their chains do not count.
        parents: (T,) index of the given pose that each trunk comes from.
        trunk_log_priors: (T,) log prior of the degrees of freedom outside the chains.
        angles: (T, A, chain dofs) for each chain; A is the largest number of leaves on a trunk.
        log_priors: (T, A) for each chain, -inf where there is no leaf or it is pruned.
        allowed: (T, A, A') for each pair of chains, whether two leaves go together.
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
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of chains, in the order of `allowed`."""
        return list(combinations(range(len(self.chains)), 2))

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
        for t, base in enumerate(self.trunk_log_priors):
            leaves = [np.flatnonzero(np.isfinite(own[t])) for own in self.log_priors]
            ruled_out = {
                (i, j): table[t][np.ix_(leaves[i], leaves[j])]
                for (i, j), table in zip(self.pairs, self.allowed, strict=True)
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
            count: number of leaves.
            rng: random number generator.

        Raises:
            ValueError: there are no leaves, or pruning rejects nearly all that are drawn.
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
            for (i, j), table in zip(self.pairs, self.allowed, strict=True):
                fits &= table[t, drawn[:, i], drawn[:, j]]
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

    On the trunk of a given pose all leaves have exactly its image. A torso is not a chain: when it
    flips, its image stays the same within `slack`. Its limbs are put back onto their rays, exactly
    or, where a ray misses its sphere by less than the slack, to the nearest point. A limb without
    any such leaf is solved for by iterative inverse kinematics within the slack.

    Args:
        body: the body.
        poses: (N, d) or (d,).
        chains: names of the chains; None selects all chains of the body.
        torso: whether torsos flip.
        depth_orders: known orders in depth, which all leaves must satisfy.
        most_overlap: largest overlap of two parts in a leaf, m; inf switches pruning by
            self-intersection off. The given poses are kept in any case.
        slack: largest distance of a joint of a flipped torso from its ray, m.

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
    sizes = combinations([own.shape[1] for own in angles], 2)
    allowed = tuple(np.ones((len(trunks), *size), dtype=np.bool_) for size in sizes)
    product = FlipProduct(
        body, names, trunks, parents, trunk_log_priors, tuple(angles), tuple(log_priors), allowed
    )
    if np.isfinite(most_overlap) and body.shapes:
        _prune_overlaps(product, len(given), most_overlap)
    for order in depth_orders:
        _prune_order(product, given, order)
    fits = np.isfinite(trunk_log_priors)
    for own in log_priors:
        fits &= np.isfinite(own).any(1)
    return replace(
        product, trunks=trunks[fits], parents=parents[fits],
        trunk_log_priors=trunk_log_priors[fits], angles=tuple(a[fits] for a in angles),
        log_priors=tuple(p[fits] for p in log_priors), allowed=tuple(x[fits] for x in allowed),
    )  # fmt: skip


def _prune_overlaps(product: FlipProduct, given: int, most: float) -> None:
    """Rules out leaves, and pairs of them, that overlap by more than most, m; given poses stay."""
    body, own = product.body, [product.body.chains[chain] for chain in product.chains]
    frames, rows = product._frames
    placed = frames.by_pose()
    limbs = {s for segments in own for s in segments}
    trunk = [s for s in range(len(body.skeleton.parents)) if s not in limbs]
    for leaf_rows, segments, log_priors in zip(rows, own, product.log_priors, strict=True):
        flat = leaf_rows.ravel()
        depth = deepest_overlaps(body, *placed, flat, segments, flat, [*trunk, *segments])
        deep = depth.reshape(leaf_rows.shape) > most
        deep[:given, 0] = False
        log_priors[deep] = -np.inf
    for (i, j), table in zip(product.pairs, product.allowed, strict=True):
        first = np.broadcast_to(rows[i][:, :, None], table.shape).ravel()
        second = np.broadcast_to(rows[j][:, None, :], table.shape).ravel()
        depth = deepest_overlaps(body, *placed, first, own[i], second, own[j])
        table &= depth.reshape(table.shape) <= most
        table[:given, 0, 0] = True


def _prune_order(product: FlipProduct, given: Array, order: DepthOrder) -> None:
    """Rules out what contradicts an order in depth."""
    body = product.body
    frames, rows = product._frames
    joints = frames.joints()[:, 2]
    crossings = np.array([_crossing(body, pose, order) for pose in given])
    owners, depths = [], []
    for part, at in zip(order, crossings[product.parents].T, strict=True):
        owner = _owner(product, part)
        which = body.skeleton.joint_index(part)
        if owner < 0:
            places, share = body.joint_positions(product.trunks)[:, which, 2].T, at
        else:
            places, share = joints[which][:, rows[owner]], at[:, None]
        # Along the image of a straight line the inverse of the depth is linear.
        depths.append(1.0 / ((1.0 - share) / places[0] + share / places[1]))
        owners.append(owner)
    (i, j), (front, behind) = owners, depths
    if i < 0 and j < 0:
        product.trunk_log_priors[~(front < behind)] = -np.inf
    elif i < 0 or j < 0 or i == j:
        front, behind = (x[:, None] if x.ndim == 1 else x for x in (front, behind))
        product.log_priors[max(i, j)][~(front < behind)] = -np.inf
    else:
        fits = front[:, :, None] < behind[:, None, :]
        table = product.allowed[product.pairs.index((min(i, j), max(i, j)))]
        table &= fits if i < j else fits.transpose(0, 2, 1)


def _owner(product: FlipProduct, part: tuple[str, str]) -> int:
    """The chain that carries a part, -1: the trunk."""
    skeleton = product.body.skeleton
    owners = set()
    for joint in skeleton.joint_index(part):
        segment = skeleton.joint_segments[joint]
        if not np.any(skeleton.joint_offsets[joint]):
            segment = skeleton.parents[segment]  # which has it at its end
        owners |= {c for c, x in enumerate(product.chains) if segment in skeleton.chains[x]}
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


def _torso_flips(body: Body, poses: Array, slack: float) -> tuple[Array, Index]:
    """Flipped torsos (T, d) that have the image of those of poses within a slack, and of which."""
    flips, parents = flip_torso(body, poses)
    if len(flips) == 0:
        return flips, parents
    which = body.skeleton.joint_index(JOINTS)
    limbs = [j for chain in body.chains for j in body.skeleton.chain_dofs[chain]]
    before = body.joint_positions(poses)[:, which]
    seen, free = before[parents], np.setdiff1d(np.arange(body.dimension), limbs)
    flips, near = _onto_rays(body, flips, seen, which, free, slack)
    torsos = body.joint_positions(flips)[:, which]
    kept = []
    for n in range(len(poses)):
        own = np.flatnonzero(near & (parents == n))
        distinct = distinct_poses(np.concatenate([before[n : n + 1], torsos[own]]), SAME_TRUNK)
        kept.append(own[distinct.kept[1:] - 1])
    chosen = np.concatenate(kept)
    return flips[chosen], parents[chosen]


def _onto_rays(
    body: Body, starts: Array, seen: Array, joints: Index, free: Index, slack: float
) -> tuple[Array, Mask]:
    """Poses (N, d) whose joints are near the rays of points (N, J, 3), and which are within slack.

    Only the free degrees of freedom move.
    """
    names = [body.joint_names[j] for j in joints]
    poses = solve_joint_positions(
        body, starts, seen, names, free_dofs=[body.dof_names[j] for j in free], along_rays=True,
        sigma=0.005, max_iterations=ITERATIONS, tolerance=1e-3,
    ).x  # fmt: skip
    rays = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    misses = np.linalg.norm(np.cross(body.joint_positions(poses)[:, joints], rays), axis=-1)
    near: Mask = misses.max(1) <= slack
    return poses, near


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
    dofs, own = body.skeleton.chain_dofs[chain], body.skeleton.chain_joints[chain]
    starts = trunks.copy()
    starts[:, dofs] = poses[:, dofs]
    seen = body.joint_positions(poses)[:, own]
    solved, fits = _onto_rays(body, starts, seen, own, dofs, slack)
    near = np.flatnonzero(fits)
    return solved[near], near


@njit(cache=True, nogil=True)
def _put_angles(poses, dofs, angles, trunks, picks):  # type: ignore[no-untyped-def]
    """Writes angles (T, A, D) of a chain, chosen by trunk and pick, into poses (N, d)."""
    for n in range(len(poses)):
        for k in range(len(dofs)):
            poses[n, dofs[k]] = angles[trunks[n], picks[n], k]


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


def rehang_chain(
    body: Body,
    poses: ArrayLike,
    new_poses: ArrayLike,
    chain: str,
    *,
    image_of: str | None = None,
    slack: float = 0.1,
) -> tuple[Array, Index]:
    """Poses whose chain hangs on another trunk and still has the image that it had.

    When a trunk turns or flips, its limbs start elsewhere. Their joints are put back onto the rays
    through their images, in all ways that lengths and limits allow. `image_of` puts them onto the
    image of another chain instead, such as a left leg onto that of the right leg.

    Args:
        body: the body.
        poses: (N, d) that have the image.
        new_poses: (N, d) with the other trunk.
        chain: name of the chain.
        image_of: name of the chain whose image is taken; None selects the chain itself.
        slack: a ray that misses its sphere by less than this touches it, m.

    Returns:
        poses (M, d), equal to the new ones outside the chain, and the index (M,) of each.

    Raises:
        KeyError, ValueError: as `enumerate_flips`.
    """
    skeleton = body.skeleton
    links = chain_links(skeleton, chain)
    new = np.array(new_poses, dtype=np.float64, ndmin=2, order='C')
    seen = forward(skeleton, np.array(poses, dtype=np.float64, ndmin=2))
    ends = links if image_of is None else chain_links(skeleton, image_of)
    if len(ends.lengths) != len(links.lengths):
        raise ValueError(f'chains {chain} and {image_of} differ in their number of segments')
    angles, valid = _grown(forward(skeleton, new), new, links, _ends(seen, ends), slack)
    parents, choice = np.nonzero(valid)
    result = new[parents]
    result[:, links.dofs] = angles[parents, choice]
    return result, parents


def deepest_overlaps(
    body: Body,
    columns: Array,
    origins: Array,
    rows: Index,
    segments: Collection[int],
    other_rows: Index,
    other_segments: Collection[int],
) -> Array:
    """Largest overlap of parts on some segments of one pose with parts on others of another pose.

    So limbs on the same trunk are compared without a pose for each of their combinations.

    Args:
        body: the body; parts that are neighbours along the skeleton are left out.
        columns, origins: (N, S, 3, 3), (N, S, 3) of N poses, as `Frames.by_pose` gives them.
        rows, other_rows: (M,) indices of the poses that are compared.
        segments, other_segments: segments of the first and of the second pose.

    Returns:
        (M,) the largest overlap of two parts, m; at least 0.
    """
    first, second = _pairs(body)
    carrier = np.array([p.segment for p in body.flesh.parts], dtype=np.intp)
    one, two = np.isin(carrier, list(segments)), np.isin(carrier, list(other_segments))
    straight, turned = one[first] & two[second], one[second] & two[first]
    # A pair whose parts are on both sides either way is looked at both ways, if poses differ.
    pairs = np.concatenate(
        [
            np.stack([first, second], axis=1)[straight],
            np.stack([second, first], axis=1)[turned],
        ]
    )
    result = np.zeros(len(rows))
    _deepest(_axes_of(body), pairs, columns, origins, rows, other_rows, result)
    return result


@njit(cache=True, nogil=True)
def _deepest(parts, pairs, columns, origins, rows, other_rows, result):  # type: ignore[no-untyped-def]
    """Fills the largest overlaps of all pairs of parts."""
    centres = np.empty((len(columns), len(parts.segments), 3))
    for n in range(len(columns)):
        _place_centres(parts, columns[n], origins[n], centres[n])
    for m in range(len(rows)):
        a, b = rows[m], other_rows[m]
        for pair in range(len(pairs)):
            i, j = pairs[pair, 0], pairs[pair, 1]
            if _far(parts, i, j, centres[a], centres[b], 0.0):
                continue
            found = _overlap(parts, i, j, columns[a], centres[a], columns[b], centres[b])
            result[m] = max(result[m], found[9])
