"""The links of a chain, and the growth of its interpretation trees, compiled (KJS 3).

Joint angles follow from the joint positions by descending the chain, with v the segment's z axis
seen from the frame before its rotations:

    spherical, first two   v = (sin b, -sin a cos b, cos a cos b)
    its third, and hinge   v = (sin c sin e, -cos c sin e, cos e)
    end effector           as the first line
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array

TURN = 2.0 * np.pi
# Two solutions nearer than this are one: the ray touches the sphere, m.
TOUCHING = 1e-6
# Sine of an elbow or knee angle below which the segments count as straight: their twist is free.
STRAIGHT = 1e-6
LIMIT_TOLERANCE = 1e-9  # rad


class ChainLinks(NamedTuple):
    """The links of a chain, K with D degrees of freedom, as the compiled code reads them.

    A link is spherical (x y z), a hinge (x) or an end effector (x y): 3, 1 or 2 degrees of freedom.

    Attributes:
        segments: (K,) segment of each link.
        parent: segment that the chain hangs on.
        mounts: (K, 3, 3) mounts of the segments.
        mounted: (K,) whether the mount is not the identity.
        lengths: (K,) from joint to joint, m.
        first_dofs: (K + 1,) position in `dofs` of the first one of each link.
        dofs: (D,) degrees of freedom of all links.
        lower, upper: (D,) limits, rad.
        sides: (K, 2) which of the two solutions for its angles the limits of a link admit.
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
    """The links of a chain.

    Raises:
        KeyError: a chain that the skeleton does not have.
        ValueError: a chain whose joints have no closed form, or limits that no angle satisfies.
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
        # The two solutions differ in the sign of sin e, or in that of cos b.
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


def _signs(lower: float, upper: float, sine: bool) -> list[bool]:
    """Whether angles within the limits give the sine, or the cosine, a sign: first +, then -."""
    samples = np.linspace(lower, min(upper, lower + TURN), 721)
    values = np.sin(samples) if sine else np.cos(samples)
    return [bool(np.any(values > 1e-6)), bool(np.any(values < -1e-6))]


@njit(cache=True, nogil=True, error_model='numpy')
def grow_leaves(  # type: ignore[no-untyped-def]
    chain, columns, origins, poses, targets, slack, given_stays, angles, valid
):
    """Fills angles and validity, pose by pose, depth first: dead branches have no leaves to visit.

    The bits of a leaf's number, highest first, say which of the two solutions each link takes.

    Args:
        chain: its `ChainLinks`, K.
        columns, origins: of the `Frames` of N poses.
        poses: (N, d); the angles nearest to theirs are taken.
        targets: (K, 3, N) points on the rays of the joints.
        slack: a ray that misses its sphere by less touches it, m.
        given_stays: the targets are joints of the given pose, which comes out first.
        angles: (N, 2^K, D) becomes the angles of the leaves.
        valid: (N, 2^K) becomes true where there is one.
    """
    count = len(chain.lengths)
    leaves = 1 << count
    rays, distances, signs = np.empty((count, 3)), np.empty(count), np.empty(count)
    # Of the branch at hand: the joints, the frames that the links turn from, and the angles.
    joints, frames = np.empty((count + 1, 3)), np.empty((count + 1, 3, 3))
    given, found = np.empty(len(chain.dofs)), np.empty(len(chain.dofs))
    for n in range(len(poses)):
        for j in range(len(given)):
            given[j] = poses[n, chain.dofs[j]]
        for x in range(3):
            joints[0, x] = origins[chain.segments[0], x, n]
            for i in range(3):
                frames[0, i, x] = columns[chain.parent, i, x, n]
        p0, p1, p2 = joints[0, 0], joints[0, 1], joints[0, 2]
        for k in range(count):
            t0, t1, t2 = targets[k, 0, n], targets[k, 1, n], targets[k, 2, n]
            distance = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
            r0, r1, r2 = t0 / distance, t1 / distance, t2 / distance
            rays[k, 0], rays[k, 1], rays[k, 2], distances[k] = r0, r1, r2, distance
            # The given pose takes the far solution where its joint lies beyond the foot of the
            # parent.
            signs[k] = 1.0 if distance >= r0 * p0 + r1 * p1 + r2 * p2 else -1.0
            p0, p1, p2 = t0, t1, t2
        leaf = k = 0
        while leaf < leaves:
            while k < count:
                branch = leaf >> (count - 1 - k)
                stays = given_stays and branch == 0
                if not _put_joint(chain, k, branch, stays, rays, distances, signs, slack, joints):
                    break
                if not _bend_joint(chain, k, joints, given, frames, found):
                    break
                k += 1
            if k == count:
                valid[n, leaf] = True
                for j in range(len(found)):
                    angles[n, leaf, j] = found[j]
                k -= 1
            # On to the second solution of the last link that has not yet had it.
            leaf = ((leaf >> (count - 1 - k)) + 1) << (count - 1 - k)
            k = count - 1
            while k > 0 and not (leaf >> (count - 1 - k)) & 1:
                k -= 1


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def _put_joint(  # type: ignore[no-untyped-def]
    chain, k, branch, stays, rays, distances, signs, slack, joints
):
    """Places the end of link k onto its ray; False where it can not be there."""
    p0, p1, p2 = joints[k, 0], joints[k, 1], joints[k, 2]
    r0, r1, r2, length = rays[k, 0], rays[k, 1], rays[k, 2], chain.lengths[k]
    if stays:
        # The given pose itself stays, however the rounding of its discriminant turns out.
        s = distances[k]
    else:
        along = p0 * r0 + p1 * r1 + p2 * r2
        discriminant = along * along - (p0 * p0 + p1 * p1 + p2 * p2) + length * length
        if not discriminant >= length * length - (length + slack) * (length + slack):
            return False
        root = np.sqrt(max(discriminant, 0.0))
        s = along + signs[k] * root
        if branch & 1:
            if root <= 0.5 * TOUCHING:
                return False
            s = along - signs[k] * root
        if not s > 0.0:
            return False
    x0, x1, x2 = s * r0, s * r1, s * r2
    if slack > 0.0:
        # A joint put on the nearest point of a ray that misses keeps the length of its link.
        a0, a1, a2 = x0 - p0, x1 - p1, x2 - p2
        scale = length / max(np.sqrt(a0 * a0 + a1 * a1 + a2 * a2), 1e-9)
        x0, x1, x2 = p0 + scale * a0, p1 + scale * a1, p2 + scale * a2
    joints[k + 1, 0], joints[k + 1, 1], joints[k + 1, 2] = x0, x1, x2
    return True


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def _bend_joint(chain, k, joints, given, frames, found):  # type: ignore[no-untyped-def]
    """Angles that point link k at its joint, and the frame beyond; False where no limits allow."""
    at = chain.first_dofs[k]
    dofs = chain.first_dofs[k + 1] - at
    inner = k + 1 < len(chain.lengths)
    length = chain.lengths[k]
    z0 = (joints[k, 0] - joints[k + 1, 0]) / length
    z1 = (joints[k, 1] - joints[k + 1, 1]) / length
    z2 = (joints[k, 2] - joints[k + 1, 2]) / length
    # The frame beyond the mount is built where the next link looks for its own.
    if chain.mounted[k]:
        for i in range(3):
            for x in range(3):
                total = 0.0
                for j in range(3):
                    total += frames[k, j, x] * chain.mounts[k, j, i]
                frames[k + 1, i, x] = total
    else:
        for i in range(3):
            for x in range(3):
                frames[k + 1, i, x] = frames[k, i, x]
    frame = k + 1
    v0 = frames[frame, 0, 0] * z0 + frames[frame, 0, 1] * z1 + frames[frame, 0, 2] * z2
    v1 = frames[frame, 1, 0] * z0 + frames[frame, 1, 1] * z1 + frames[frame, 1, 2] * z2
    v2 = frames[frame, 2, 0] * z0 + frames[frame, 2, 1] * z1 + frames[frame, 2, 2] * z2
    if dofs == 1:
        e = np.arccos(min(max(v2, -1.0), 1.0))
        c, e, fits = _nearest(chain, k, at - 1, at, e, -e, v0, -v1, given)
        # Until here the twist of the spherical joint was left out of the frame.
        found[at - 1], found[at] = c, e
        if inner and fits:
            _turn(frames, frame, c, 2)
            _turn(frames, frame, e, 0)
        return fits
    b = np.arcsin(min(max(v0, -1.0), 1.0))
    a, b, fits = _nearest(chain, k, at, at + 1, b, np.pi - b, -v1, v2, given)
    found[at], found[at + 1] = a, b
    if inner and fits:
        _turn(frames, frame, a, 0)
        _turn(frames, frame, b, 1)
    if dofs == 3:
        found[at + 2] = given[at + 2]
        if inner and fits and chain.first_dofs[k + 2] - chain.first_dofs[k + 1] != 1:
            _turn(frames, frame, given[at + 2], 2)
    return fits


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def _nearest(chain, k, i, j, one, two, y, x, given):  # type: ignore[no-untyped-def]
    """Angles i and j of link k within their limits, of two solutions those nearest the given.

    Angle j is one or two; angle i is that of (x, y), turned by pi for the second, and stays where
    (x, y) vanishes: it has no effect on the segment.
    """
    free = np.sqrt(y * y + x * x) < STRAIGHT
    best_i, best_j, best_cost = given[i], given[j], np.inf
    found = False
    for solution in range(2):
        if not chain.sides[k, solution]:
            continue
        side = 1.0 - 2.0 * solution
        b, fits = _into_limits(
            one if solution == 0 else two, chain.lower[j], chain.upper[j], given[j]
        )
        if not fits:
            continue
        a = given[i] if free else np.arctan2(side * y, side * x)
        a, fits = _into_limits(a, chain.lower[i], chain.upper[i], given[i])
        cost = (a - given[i]) ** 2 + (b - given[j]) ** 2
        if fits and cost < best_cost:
            best_i, best_j, best_cost, found = a, b, cost, True
    return best_i, best_j, found


@njit(cache=True, nogil=True, error_model='numpy')
def _into_limits(angle, lower, upper, given):  # type: ignore[no-untyped-def]
    """The angle plus the multiple of 2 pi that fits the limits; if several, nearest the given."""
    shifted = angle + TURN * np.rint((given - angle) / TURN)
    if shifted < lower - LIMIT_TOLERANCE:
        shifted += TURN
    if shifted > upper + LIMIT_TOLERANCE:
        shifted -= TURN
    fits = lower - LIMIT_TOLERANCE <= shifted <= upper + LIMIT_TOLERANCE
    return min(max(shifted, lower), upper), fits


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def _turn(frames, k, angle, axis):  # type: ignore[no-untyped-def]
    """Turns frame k of (K, 3, 3) about one of its own axes."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angle), np.sin(angle)
    for x in range(3):
        a, b = frames[k, i, x], frames[k, j, x]
        frames[k, i, x] = cos * a + sin * b
        frames[k, j, x] = cos * b - sin * a
