"""Configurations of all limbs on the trunks of a group of modes, and their products (KJS 3).

Modes with nearly the same trunk form a group. On the group's trunk each limb has several
configurations: the configurations of the modes, their flips, and the results of a search. Further
trunks have the same image, but with two limbs exchanged, or with the torso flipped in depth. On
each of these trunks a limb has all configurations that keep its image.

A product combines one configuration of each limb. Because limbs are nearly independent given the
trunk, the energy of a product is the energy of its trunk plus the change due to each configuration
alone. So a few dozen evaluations rate thousands of poses. Compiled functions process a group per
call; the energies are evaluated between two calls.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import placing_of
from hmt_ros.body.skeleton import Skeleton, sided_pairs
from hmt_ros.core import combine, fill_configurations, place_alone
from hmt_ros.flips.chain_links import chain_links
from hmt_ros.flips.torso_flips import flip_torso
from hmt_ros.inference.arrays import Array, Index


class Limbs(NamedTuple):
    """The C limbs of a body, with at most K links and D variables, for the compiled functions.

    Attributes:
        links, dofs, joints: (C,) numbers of links, degrees of freedom and moved joints.
        segments, parents, mounts, mounted, lengths, first_dofs, own, lower, upper, sides: the
            attributes of `ChainLinks`, zero-padded to the largest limb.
        joint_segments, joint_offsets: segments (C, J) and offsets (C, J, 3) of the joints that a
            limb moves.
        siblings: (C,) index of the same limb on the other side; -1 if missing.
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
    """Collects the limbs of a skeleton, in the order of its chains.

    Raises:
        ValueError: a chain has no closed-form solution; see `chain_links`.
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
    """Stacks arrays of different lengths, padded with zeros."""
    most = max(len(x) for x in arrays)
    result = np.zeros((len(arrays), most, *arrays[0].shape[1:]), dtype=arrays[0].dtype)
    for row, x in zip(result, arrays, strict=True):
        row[: len(x)] = x
    return result


class Configurations(NamedTuple):
    """Configurations of limbs on T trunks, of which the first belongs to a group of G modes.

    Attributes:
        trunks: (T, d) for each trunk, a pose with this trunk.
        angles: (T, C, A, D) angles of each configuration of each limb.
        counts: (T, C) numbers of configurations; 0: the same configurations as on the first trunk.
        penalties: (G, C, A) minus the log probability that a mode changes to each configuration on
            the first trunk.
    """

    trunks: Array
    angles: Array
    counts: NDArray[np.int64]
    penalties: Array


@dataclass(frozen=True, eq=False)
class Products:
    """Whole poses that combine configurations of all limbs.

    Attributes:
        poses: (N, d) poses.
        parents: (N,) for each pose, the position of its source mode in the group.
        energies: (N,) estimated energies.
    """

    poses: Array
    parents: Index
    energies: Array


@dataclass(frozen=True, eq=False)
class LimbProducts:
    """Products of limb configurations for a group of modes, also on trunks with the same image.

    Attributes:
        body: body of the modes.
        modes: (G, d) poses of the group, best first.
        configurations: configurations of the limbs, on the trunk of the group, then on trunks with
            two limbs exchanged, then on trunks with the torso flipped.
        exchanged: number of trunks with exchanged limbs.
    """

    body: Body
    modes: Array
    configurations: Configurations
    exchanged: int

    @classmethod
    def of(
        cls,
        body: Body,
        modes: Array,
        found: Mapping[str, Array],
        price: float,
        *,
        apart: float,
        most: int,
        poses: int = sys.maxsize,
    ) -> LimbProducts:
        """Finds the configurations of all limbs for a group.

        Args:
            body: body with at least one chain; all chains must have closed-form solutions.
            modes: (G, d) poses of the group, best first.
            found: further configurations (F, chain dofs) for each chain name.
            price: penalty of configurations that differ from the mode's, nats.
            apart: minimum distance between distinct configurations, in at least one joint, m.
            most: maximum number of configurations of a limb on a trunk.
            poses: maximum number of poses to evaluate. If it is exceeded, the last trunks are left
                out, but never the group's trunk.
        """
        limbs, skeleton = limbs_of(body.skeleton), body.skeleton
        modes = np.ascontiguousarray(modes, dtype=np.float64)
        flipped = flip_torso(body, modes[:1])[0]
        counts = np.zeros(len(limbs.links), dtype=np.int64)
        more = np.zeros((len(counts), max(map(len, found.values()), default=0), limbs.own.shape[1]))
        for c, chain in enumerate(skeleton.chains):
            if chain in found:
                counts[c] = len(found[chain])
                more[c, : counts[c], : limbs.dofs[c]] = found[chain]
        trunks = 1 + len(body.chain_pairs) + len(flipped)
        result = Configurations(
            np.zeros((trunks, skeleton.dimension)),
            np.zeros((trunks, len(counts), most, limbs.own.shape[1])),
            np.zeros((trunks, len(counts)), dtype=np.int64),
            np.full((len(modes), len(counts), most), np.inf),
        )
        used, exchanged = fill_configurations(
            placing_of(skeleton),
            limbs,
            modes,
            more,
            counts,
            flipped,
            float(price),
            float(apart),
            poses,
            result,
        )
        result = result._replace(
            trunks=result.trunks[:used], angles=result.angles[:used], counts=result.counts[:used]
        )
        return cls(body, modes, result, exchanged)

    @property
    def alone(self) -> tuple[Array, Index]:
        """Poses (P, d) to evaluate, and the row (R,) of the pose for each trunk and configuration.

        For each trunk, the rows are its pose, followed by this pose with each limb changed to each
        configuration.
        """
        found = self.configurations
        count = len(found.trunks) + int(found.counts.sum())
        poses, rows = np.empty((count, self.body.dimension)), np.empty(count, dtype=np.intp)
        different = place_alone(limbs_of(self.body.skeleton), found, poses, rows)
        return poses[:different], rows

    def best(
        self,
        energies: Array,
        log_weights: Array,
        *,
        exchange: float,
        flip: float,
        share: float,
        count: int,
    ) -> Products:
        """Selects the most probable products on each trunk, best first, trunk by trunk.

        The cost of a product is `share` times the energy changes of its limbs, plus their
        penalties, minus the log weight of the mode.

        Args:
            energies: (R,) energies at the rows of `alone`.
            exchange, flip: penalties of exchanged limbs and of a flipped torso, nats.
            share: factor on the energy.
        """
        found = self.configurations
        most = len(found.trunks) * count
        poses, parents, values = (
            np.empty((most, self.body.dimension)),
            np.empty(most, dtype=np.intp),
            np.empty(most),
        )
        n = combine(
            limbs_of(self.body.skeleton),
            self.modes,
            found,
            np.ascontiguousarray(energies, dtype=np.float64),
            np.ascontiguousarray(log_weights, dtype=np.float64),
            self.exchanged,
            float(exchange),
            float(flip),
            float(share),
            int(count),
            poses,
            parents,
            values,
        )
        return Products(poses[:n], parents[:n], values[:n])
