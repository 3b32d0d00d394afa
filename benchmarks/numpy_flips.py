"""Flips of limbs in vectorised numpy, as `hmt_ros.flips.tree_growth` compiles them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.flips.tree_growth import LIMIT_TOLERANCE, STRAIGHT, TOUCHING

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def enumerate_flips(
    body: Body, poses: ArrayLike, chains: Sequence[str] | str
) -> tuple[Array, Index]:
    """As `hmt_ros.flips.enumerate_flips`."""
    names = [chains] if isinstance(chains, str) else list(chains)
    skeleton = body.skeleton
    q = np.array(poses, dtype=np.float64, ndmin=2)
    frames = forward(skeleton, q)
    links = [_links(skeleton, name) for name in names]
    dofs = [[j for link in chain for j in link.dofs] for chain in links]
    flat = [j for own in dofs for j in own]
    if len(set(flat)) < len(flat):
        raise ValueError(f'chains {names} share segments, their trees can not be multiplied')
    n = len(q)
    trees = [_leaves(frames, q, chain) for chain in links]
    mask = np.ones((n,) + (1,) * len(trees), dtype=bool)
    for i, (_, valid) in enumerate(trees):
        shape = [n] + [1] * len(trees)
        shape[i + 1] = len(valid)
        mask = mask & valid.T.reshape(shape)
    parents, *choices = np.nonzero(mask)
    result = q[parents]
    for own, (angles, _), choice in zip(dofs, trees, choices, strict=True):
        result[:, own] = angles[choice, :, parents]
    return result, parents


@dataclass(frozen=True, eq=False)
class _Link:
    """One segment of a chain: 'spherical' (x y z), 'hinge' (x) or 'end effector' (x y)."""

    segment: int
    parent: int
    mount: Array
    length: float
    dofs: tuple[int, ...]
    lower: Array
    upper: Array

    @property
    def kind(self) -> str:
        return {3: 'spherical', 1: 'hinge', 2: 'end effector'}[len(self.dofs)]


@lru_cache(maxsize=256)
def _links(skeleton: Skeleton, name: str) -> tuple[_Link, ...]:
    if name not in skeleton.chains:
        raise KeyError(f'{skeleton.name} has no chain {name!r}; it has {sorted(skeleton.chains)}')
    segments = skeleton.chains[name]
    result: list[_Link] = []
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
        after_spherical = bool(result) and result[-1].kind == 'spherical'
        in_line = np.array_equal(skeleton.mounts[s], np.eye(3))
        fits = axes in ('xyz', 'xy') or (axes == 'x' and after_spherical and in_line)
        follows = k == 0 or skeleton.parents[s] == segments[k - 1]
        if not (rotations and straight and fits and follows and skeleton.parents[s] >= 0):
            raise ValueError(
                f'chain {name} of {skeleton.name} has no closed form at segment '
                f'{skeleton.segment_names[s]} (rotations {axes!r}); '
                'use iterative inverse kinematics'
            )
        own = list(dofs)
        result.append(
            _Link(
                s,
                skeleton.parents[s],
                skeleton.mounts[s],
                float(-end[2]),
                dofs,
                skeleton.lower[own],
                skeleton.upper[own],
            )
        )
    return tuple(result)


def _leaves(
    frames: Frames, poses: Array, links: tuple[_Link, ...]
) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (leaves, chain dofs, N) and validity (leaves, N); leaf 0 is the given pose."""
    targets = [frames.origins[k.segment] - k.length * frames.columns[k.segment, 2] for k in links]
    positions, valid = _positions(frames, links, targets)
    angles, reachable = _joint_angles(frames, poses, links, positions)
    valid &= reachable
    valid[0] = True
    own = [j for link in links for j in link.dofs]
    angles[0] = poses[:, own].T
    return angles, valid


def _positions(
    frames: Frames, links: tuple[_Link, ...], targets: list[Array], slack: float = 0.0
) -> tuple[list[Array], NDArray[np.bool_]]:
    """Joint positions after 0, 1, ... links, (2^k, 3, N) each, and which of the last exist.

    Args:
        frames: where the chain starts.
        links: of the chain.
        targets: (3, N) points on the rays of the joints; without slack those of the given pose,
            whose own positions come out first.
        slack: a ray that misses its sphere by less touches it, m.
    """
    start = frames.origins[links[0].segment]
    result = [start[None]]
    valid = np.ones((1, frames.count), dtype=bool)
    given = start
    for link, target in zip(links, targets, strict=True):
        distance = np.sqrt((target * target).sum(0))
        ray = target / distance
        # The given pose takes the far solution where its joint lies beyond the foot of the parent.
        own_sign = np.where(distance >= (ray * given).sum(0), 1.0, -1.0)
        parent = result[-1]
        along = (parent * ray).sum(1)
        discriminant = along * along - (parent * parent).sum(1) + link.length**2
        root = np.sqrt(np.maximum(discriminant, 0.0))
        s = np.stack([along + own_sign * root, along - own_sign * root], axis=1)
        near_enough = discriminant >= link.length**2 - (link.length + slack) ** 2
        hit = near_enough[:, None] & (s > 0) & valid[:, None]
        hit[:, 1] &= root > 0.5 * TOUCHING
        if slack == 0:
            # The given pose itself stays, however the rounding of its discriminant turns out.
            s[0, 0] = distance
            hit[0, 0] = True
        points = s[:, :, None] * ray
        if slack > 0:
            # A joint put on the nearest point of a ray that misses keeps the length of its link.
            away = points - parent[:, None]
            away *= link.length / np.maximum(np.sqrt((away * away).sum(2)), 1e-9)[:, :, None]
            points = parent[:, None] + away
        result.append(points.reshape(-1, 3, frames.count))
        valid = hit.reshape(-1, frames.count)
        given = target
    return result, valid


def _joint_angles(
    frames: Frames, poses: Array, links: tuple[_Link, ...], positions: list[Array]
) -> tuple[Array, NDArray[np.bool_]]:
    """Joint angles (leaves, dofs, N) that put the joints where they are, nearest the given pose."""
    leaves, n = len(positions[-1]), frames.count
    columns = frames.columns[links[0].parent][None]  # (leaves or 1, 3, 3, N)
    angles = np.empty((leaves, sum(len(link.dofs) for link in links), n))
    valid = np.ones((leaves, n), dtype=bool)
    at = 0
    for k, link in enumerate(links):
        z = (positions[k].repeat(2, axis=0) - positions[k + 1]) / link.length
        if not np.array_equal(link.mount, np.eye(3)):
            columns = np.einsum('lixn,ij->ljxn', columns, link.mount)
        count = len(z)
        columns = np.broadcast_to(columns, (max(len(columns), 1), 3, 3, n))
        if len(columns) < count:
            columns = columns.repeat(count // len(columns), axis=0)
        v = (columns * z[:, None]).sum(2)  # (leaves so far, 3, N)
        given = poses[:, list(link.dofs)].T
        solution: tuple[Array, ...]
        if link.kind == 'hinge':
            previous = links[k - 1]
            last = previous.dofs[2]
            c, e, fits = _hinge(v, poses[:, last], given[0], previous, link)
            # Until here the twist of the spherical joint was left out of the frame.
            if k + 1 < len(links):
                columns = _turn(_turn(columns, c, 2), e, 0)
            repeat = leaves // count
            angles[:, at - 1] = c.repeat(repeat, axis=0)
            solution = (e,)
        else:
            a, b, fits = _two_angles(v, given, link)
            if k + 1 < len(links):
                columns = _turn(_turn(columns, a, 0), b, 1)
            solution = (a, b)
            if link.kind == 'spherical':
                solution = (a, b, np.broadcast_to(given[2], a.shape))
                followed = k + 1 < len(links) and links[k + 1].kind == 'hinge'
                if k + 1 < len(links) and not followed:
                    columns = _turn(columns, solution[2], 2)
        repeat = leaves // count
        for value in solution:
            angles[:, at] = value.repeat(repeat, axis=0)
            at += 1
        valid &= fits.repeat(repeat, axis=0)
    return angles, valid


def _two_angles(v: Array, given: Array, link: _Link) -> tuple[Array, Array, NDArray[np.bool_]]:
    """a and b of v = (sin b, -sin a cos b, cos a cos b), within limits and nearest the given."""
    b_first = np.arcsin(np.clip(v[:, 0], -1.0, 1.0))
    best: tuple[Array, Array, NDArray[np.bool_]] | None = None
    for b, side in ((b_first, 1.0), (np.pi - b_first, -1.0)):
        if not _possible(float(link.lower[1]), float(link.upper[1]), np.cos, side):
            continue
        a = np.arctan2(-side * v[:, 1], side * v[:, 2])
        # cos b = 0: the first angle has no effect on the segment; keep it.
        a = np.where(np.hypot(v[:, 1], v[:, 2]) < STRAIGHT, given[0], a)
        a, fits_a = _into_limits(a, link.lower[0], link.upper[0], given[0])
        b, fits_b = _into_limits(b, link.lower[1], link.upper[1], given[1])
        best = _nearer(best, (a, b, fits_a & fits_b), given[:2])
    if best is None:
        raise ValueError('a joint has limits that no angle satisfies')
    return best


def _hinge(
    w: Array, given_c: Array, given_e: Array, spherical: _Link, link: _Link
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """c and e of w = (sin c sin e, -cos c sin e, cos e), within limits and nearest the given."""
    bent = np.arccos(np.clip(w[:, 2], -1.0, 1.0))
    across = np.hypot(w[:, 0], w[:, 1])
    best: tuple[Array, Array, NDArray[np.bool_]] | None = None
    for e, side in ((bent, 1.0), (-bent, -1.0)):
        if not _possible(float(link.lower[0]), float(link.upper[0]), np.sin, side):
            continue
        c = np.arctan2(side * w[:, 0], -side * w[:, 1])
        c = np.where(across < STRAIGHT, given_c, c)
        c, fits_c = _into_limits(c, spherical.lower[2], spherical.upper[2], given_c)
        e, fits_e = _into_limits(e, link.lower[0], link.upper[0], given_e)
        best = _nearer(best, (c, e, fits_c & fits_e), np.stack([given_c, given_e]))
    if best is None:
        raise ValueError('a joint has limits that no angle satisfies')
    return best


@lru_cache(maxsize=1024)
def _possible(lower: float, upper: float, function: np.ufunc, side: float) -> bool:
    """Whether an angle within the limits gives the function (sin or cos) this sign."""
    samples = np.linspace(lower, min(upper, lower + 2 * np.pi), 721)
    return bool(np.any(side * function(samples) > 1e-6))


def _into_limits(
    angle: Array, lower: float, upper: float, given: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """The angle plus the multiple of 2 pi that fits the limits; if several, nearest the given."""
    turn = 2 * np.pi
    shifted = angle + turn * np.round((given - angle) / turn)
    shifted = np.where(shifted < lower - LIMIT_TOLERANCE, shifted + turn, shifted)
    shifted = np.where(shifted > upper + LIMIT_TOLERANCE, shifted - turn, shifted)
    fits = (shifted >= lower - LIMIT_TOLERANCE) & (shifted <= upper + LIMIT_TOLERANCE)
    return np.clip(shifted, lower, upper), fits


def _nearer(
    best: tuple[Array, Array, NDArray[np.bool_]] | None,
    other: tuple[Array, Array, NDArray[np.bool_]],
    given: Array,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Of two solutions the one that fits the limits, else the one nearer the given angles."""
    if best is None:
        return other
    here, there = (
        np.where(fits, 0.0, 1e6) + (x - given[0]) ** 2 + (y - given[1]) ** 2
        for x, y, fits in (best, other)
    )
    first = here <= there
    return (
        np.where(first, best[0], other[0]),
        np.where(first, best[1], other[1]),
        np.where(first, best[2], other[2]),
    )


def _turn(columns: Array, angle: Array, axis: int) -> Array:
    """Frames (leaves, 3, 3, N) turned about one of their own axes by angles (leaves, N)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    result = columns.copy()
    result[:, i] = cos * columns[:, i] + sin * columns[:, j]
    result[:, j] = cos * columns[:, j] - sin * columns[:, i]
    return result
