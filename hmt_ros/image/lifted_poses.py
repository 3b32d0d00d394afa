"""Whole poses lifted from an image: a mixture over joints relative to the hips.

    p(y) = sum_c w_c prod_ja N(y_ja; m_cja, s_cja^2),    y_j: joint j from the middle of the hips

Two of the axes a lie across the line of sight to the person, the third along it. Experts
(`experts.lifter`) give several components. A network that estimates one pose gives one component;
its standard deviations are learned (`keypoint_schemes.yaml`).

The estimated bone lengths can differ from the person's. Only the directions of bones are used:
every bone is scaled to its length in the body of the person.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hmt_ros.body.kinematics import forward
from hmt_ros.body.skeleton import Skeleton, other_side
from hmt_ros.core import elementary, resize_bones
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.linear_algebra import product

WHOLE_BODY_CARRIERS = {
    'pelvis',
    'neck',
    'head',
    *(
        f'{side}_{name}'
        for name in ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle')
        for side in ('left', 'right')
    ),
}
# Standard deviation of the coordinates of a joint without an estimate, m.
UNKNOWN_SIGMA = 0.5
HIPS = ('left_hip', 'right_hip')
# Parent of each kind of joint; joints of other kinds have the middle of the hips as parent.
CARRIERS = {
    'head': 'neck',
    'shoulder': 'neck',
    'elbow': 'shoulder',
    'wrist': 'elbow',
    'hand': 'wrist',
    'knee': 'hip',
    'ankle': 'knee',
    'toe': 'ankle',
}


@dataclass(frozen=True, eq=False)
class LiftedPoses:
    """A mixture over the joints of a person.

    Attributes:
        joints: (J,) names of joints of the package's bodies.
        log_weights: (C,) log weights of the components.
        means: (C, J, 3) positions relative to the middle of the hips, along the axes, m.
        deviations: (C, J, 3) standard deviations of the positions along the axes, m.
        axes: (3, 3) unit vectors in rows, camera frame; the last row is the line of sight.
        lengths: (J,) lengths of the bones from the parents to the joints in the means, m.
    """

    joints: tuple[str, ...]
    log_weights: Array
    means: Array
    deviations: Array
    axes: Array
    lengths: Array

    def __post_init__(self) -> None:
        c, j = len(self.log_weights), len(self.joints)
        shapes = tuple(np.shape(x) for x in (self.means, self.deviations, self.axes, self.lengths))
        if shapes != ((c, j, 3), (c, j, 3), (3, 3), (j,)):
            raise ValueError(f'{c} poses of {j} joints with arrays of shapes {shapes}')

    @property
    def are_whole(self) -> bool:
        """Whether the joints determine a whole pose: all except toes and hands are required."""
        return {*self.joints} >= WHOLE_BODY_CARRIERS

    def of_joints(self, names: Sequence[str]) -> LiftedPoses:
        """The mixture restricted to the named joints."""
        rows = [self.joints.index(name) for name in names]
        return LiftedPoses(
            tuple(names),
            self.log_weights,
            self.means[:, rows],
            self.deviations[:, rows],
            self.axes,
            self.lengths[rows],
        )

    def sized(self, skeleton: Skeleton) -> Array:
        """The means (C, J, 3) scaled to the bone lengths of a skeleton that has these joints."""
        return self._with_lengths(bone_lengths(skeleton, self.joints))

    def _with_lengths(self, own: Array) -> Array:
        result = np.empty(self.means.shape)
        factors = own / np.maximum(self.lengths, 1e-6)
        resize_bones(ordered(self.joints), factors, np.ascontiguousarray(self.means), result)
        return result

    def resized(self, other: LiftedPoses) -> Array:
        """The means (C, J, 3), scaled to another mixture's bone lengths at the common joints."""
        own = self.lengths.copy()
        rows, others = shared(self.joints, other.joints)
        own[rows] = other.lengths[others]
        return self._with_lengths(own)

    def exchanged(self) -> LiftedPoses:
        """The mixture with left and right exchanged, and depths negated."""
        swapped = [self.joints.index(other_side(name)) for name in self.joints]
        mirror = np.array([1.0, 1.0, -1.0])
        return LiftedPoses(
            self.joints,
            self.log_weights,
            self.means[:, swapped] * mirror,
            self.deviations[:, swapped],
            self.axes,
            self.lengths[swapped],
        )


def pooled(opinions: Sequence[LiftedPoses]) -> LiftedPoses:
    """One mixture from several estimates of one pose, with equal weights.

    The estimates use the same image, so they are not independent, and their densities are averaged.
    If an estimate lacks a joint, the joint has the standard deviation `UNKNOWN_SIGMA` in the
    components of this estimate.
    """
    first = opinions[0]
    if len(opinions) == 1:
        return first
    c = sum(len(one.log_weights) for one in opinions)
    means = np.zeros((c, len(first.joints), 3))
    deviations = np.full(means.shape, UNKNOWN_SIGMA)
    row = 0
    for one in opinions:
        rows = slice(row, row + len(one.log_weights))
        row = rows.stop
        own, theirs = shared(first.joints, one.joints)
        means[rows, own] = one.resized(first)[:, theirs]
        deviations[rows, own] = one.deviations[:, theirs]
    weights = np.concatenate([one.log_weights for one in opinions]) - elementary.log(len(opinions))
    return LiftedPoses(first.joints, weights, means, deviations, first.axes, first.lengths)


def from_positions(
    joints: Sequence[str],
    positions: Array,
    axes: Array,
    deviations: Mapping[str, float],
    seen: Mask | None = None,
) -> LiftedPoses | None:
    """The mixture for a network's single pose; None if a hip or all other joints are missing.

    Args:
        joints: (n,) names of joints; if a name is repeated, the first joint with known position is
            used. A joint is ignored if its counterpart on the other side is unknown, because sides
            may be exchanged.
        positions: (n, 3) positions along the axes of the camera, from any origin, m; NaN: unknown.
        axes: (3, 3) axes as in `LiftedPoses`.
        deviations: standard deviations by kind of joint, m.
        seen: (n,) whether each joint was visible to the network; hidden joints get the standard
            deviation `UNKNOWN_SIGMA`. None: all were visible.
    """
    known: dict[str, int] = {}
    for i in np.flatnonzero(np.isfinite(positions).all(1)).tolist():
        if joints[i].rpartition('_')[2] in deviations:
            known.setdefault(joints[i], i)
    names = tuple(name for name in known if other_side(name) in known)
    if not {*names} >= {*HIPS} or len(names) <= len(HIPS):
        return None
    middle = positions[[known[name] for name in HIPS]].mean(0)
    places = positions[[known[name] for name in names]] - middle
    lengths = np.linalg.norm(bones(names, places, np.zeros(3)), axis=1)
    spread = np.array([deviations[name.rpartition('_')[2]] for name in names])
    if seen is not None:
        spread[~seen[[known[name] for name in names]]] = UNKNOWN_SIGMA
    return LiftedPoses(
        names,
        np.zeros(1),
        product(places, axes.T)[None],
        np.repeat(spread[None, :, None], 3, axis=2),
        axes,
        lengths,
    )


@lru_cache(maxsize=64)
def shared(joints: tuple[str, ...], others: tuple[str, ...]) -> tuple[Index, Index]:
    """Indices of the common joints in each of two sequences of names."""
    rows = [(i, others.index(name)) for i, name in enumerate(joints) if name in others]
    own, theirs = np.array(rows, dtype=np.intp).reshape(-1, 2).T
    return own, theirs


@lru_cache(maxsize=64)
def ordered(joints: tuple[str, ...]) -> Index:
    """Indices (J, 2) of joints and of their parents (-1: middle of the hips), parents first."""
    places = {name: i for i, name in enumerate(joints)}
    result: list[tuple[int, int]] = []
    done: set[str] = set()

    def visit(name: str) -> None:
        if name in done:
            return
        done.add(name)
        carrier = carrier_of(name, joints)
        if carrier:
            visit(carrier)
        result.append((places[name], places[carrier] if carrier else -1))

    for name in joints:
        visit(name)
    return np.array(result, dtype=np.intp).reshape(-1, 2)


def carrier_of(name: str, joints: Sequence[str]) -> str:
    """The nearest ancestor of a joint in `joints`; '' for the middle of the hips."""
    side, _, kind = name.rpartition('_')
    carrier = CARRIERS.get(kind, '')
    while carrier:
        for known in (f'{side}_{carrier}', carrier):
            if known in joints:
                return known
        carrier = CARRIERS.get(carrier, '')
    return ''


@lru_cache(maxsize=16)
def bone_lengths(skeleton: Skeleton, joints: tuple[str, ...]) -> Array:
    """Lengths (J,) of the bones from the parents to the joints, in the rest pose, m."""
    places = forward(skeleton, np.zeros((1, skeleton.dimension))).joints()[..., 0]
    chosen: Index = skeleton.joint_index(joints)
    middle = places[skeleton.joint_index(HIPS)].mean(0)
    return np.asarray(np.linalg.norm(bones(joints, places[chosen], middle), axis=1))


def bones(joints: tuple[str, ...], places: Array, origin: Array) -> Array:
    """Vectors (J, 3) from the parents, or the origin if missing, to joints at places (J, 3)."""
    rows, carriers = ordered(joints).T
    result = np.empty_like(places)
    result[rows] = places[rows] - np.where(carriers[:, None] < 0, origin, places[carriers])
    return result


@lru_cache(maxsize=16)
def middle_of_hips(skeleton: Skeleton) -> Array:
    """The middle of the hips (3,) in the frame of the root, m."""
    frames = forward(skeleton, np.zeros((1, skeleton.dimension)))
    columns, origins = frames.by_pose()
    hips = frames.joints()[skeleton.joint_index(HIPS), :, 0]
    result: Array = product(columns[0, 0], hips.mean(0) - origins[0, 0])
    return result
