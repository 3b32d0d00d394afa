"""The skeleton: a tree of segments, their degrees of freedom, and the lengths that shape them.

Every segment has a frame. Relative to its parent's frame it has an offset, to which its
translations are added, and a fixed mount rotation, followed by its own rotations in order:

    T_segment = T_parent * Trans(offset + t) * mount * Rot(axis_1, q_1) * ... * Rot(axis_n, q_n)

Translations are along the axes of the parent's frame, rotations about axes of the moving frame.
Offsets are linear in the lengths (`thigh`, `hip_width`, ...), so lengths can be set, scaled and
estimated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A kinematic tree with S segments, d degrees of freedom, J joints and L lengths.

    Attributes:
        segment_names, parents: (S,) name of each segment and index of its parent (-1: the camera
            frame); parents come before their children.
        mounts: (S, 3, 3) rotation from the segment's frame at rest to its parent's frame.
        fixed_offsets, offset_basis: (S, 3), (S, 3, L): offset of a segment in its parent's frame =
            fixed + basis @ lengths, m.
        dof_names, dof_segments, dof_axes, dof_is_rotation: (d,) name, segment, axis 0 to 2 and kind
            of each degree of freedom, in the order in which they act.
        lower, upper: (d,) hard limits, m or rad.
        joint_names, joint_segments: (J,) name of each joint, and the segment that carries it.
        joint_basis: (J, 3, L): position of a joint in the frame of its segment = basis @ lengths,
            m.
        chains: segments of each limb by name, from its root outwards.
        length_names, lengths: (L,) m.
    """

    name: str
    segment_names: tuple[str, ...]
    parents: tuple[int, ...]
    mounts: Array
    fixed_offsets: Array
    offset_basis: Array
    dof_names: tuple[str, ...]
    dof_segments: Index
    dof_axes: Index
    dof_is_rotation: NDArray[np.bool_]
    lower: Array
    upper: Array
    joint_names: tuple[str, ...]
    joint_segments: Index
    joint_basis: Array
    length_names: tuple[str, ...]
    lengths: Array
    chains: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s, d = len(self.segment_names), len(self.dof_names)
        j, n = len(self.joint_names), len(self.length_names)
        wanted = {
            'mounts': (s, 3, 3),
            'fixed_offsets': (s, 3),
            'offset_basis': (s, 3, n),
            'dof_segments': (d,),
            'dof_axes': (d,),
            'dof_is_rotation': (d,),
            'lower': (d,),
            'upper': (d,),
            'joint_segments': (j,),
            'joint_basis': (j, 3, n),
            'lengths': (n,),
        }
        for key, shape in wanted.items():
            value = np.array(getattr(self, key))
            if value.shape != shape:
                raise ValueError(f'{self.name}: {key} has shape {value.shape}, wanted {shape}')
            value.setflags(write=False)
            object.__setattr__(self, key, value)
        for i, parent in enumerate(self.parents):
            if not -1 <= parent < i:
                raise ValueError(
                    f'{self.name}: segment {self.segment_names[i]} has parent {parent}, '
                    f'wanted one that stands before it'
                )
        if np.any(np.diff(self.dof_segments) < 0):
            raise ValueError(f'{self.name}: degrees of freedom must stand in the order of segments')
        for own in self.segment_dofs:
            kinds = [bool(self.dof_is_rotation[i]) for i in own]
            if kinds != sorted(kinds):
                raise ValueError(
                    f'{self.name}: translations of a segment come before its rotations'
                )
        for kind in ('segment_names', 'dof_names', 'joint_names', 'length_names'):
            names = getattr(self, kind)
            twice = sorted({x for x in names if names.count(x) > 1})
            if twice:
                raise ValueError(f'{self.name}: {kind} has {twice} more than once')
        wrong = [self.dof_names[i] for i in np.flatnonzero(~(self.lower < self.upper))]
        if wrong:
            raise ValueError(f'{self.name}: lower limit not below upper limit for {wrong}')

    @cached_property
    def dimension(self) -> int:
        """Number of degrees of freedom, d."""
        return len(self.dof_names)

    @cached_property
    def offsets(self) -> Array:
        """Offsets (S, 3) of the segments in their parents' frames, m."""
        return np.asarray(self.fixed_offsets + product(self.offset_basis, self.lengths))

    @cached_property
    def joint_offsets(self) -> Array:
        """Positions (J, 3) of the joints in the frames of their segments, m."""
        return np.asarray(product(self.joint_basis, self.lengths))

    @cached_property
    def segment_dofs(self) -> tuple[tuple[int, ...], ...]:
        """Degrees of freedom of each segment, in the order in which they act."""
        return tuple(
            tuple(int(i) for i in np.flatnonzero(self.dof_segments == s))
            for s in range(len(self.parents))
        )

    @cached_property
    def chain_dofs(self) -> dict[str, Index]:
        """Degrees of freedom of each chain, segment by segment."""
        return {
            chain: np.array([j for s in own for j in self.segment_dofs[s]], dtype=np.intp)
            for chain, own in self.chains.items()
        }

    @cached_property
    def spine(self) -> tuple[int, ...]:
        """Segments between the pelvis and the neck, from top to bottom."""
        ends = [s for s, name in zip(self.joint_segments, self.joint_names) if name == 'neck']
        found = [int(s) for s in ends]
        while found and self.parents[found[-1]] > 0:
            found.append(self.parents[found[-1]])
        return tuple(found[1:])

    @cached_property
    def chain_joints(self) -> dict[str, Index]:
        """Joints that the segments of each chain carry."""
        return {
            chain: np.flatnonzero(np.isin(self.joint_segments, own))
            for chain, own in self.chains.items()
        }

    @cached_property
    def trunk_joints(self) -> tuple[str, ...]:
        """Names of the joints that no chain moves."""
        roots = {own[0] for own in self.chains.values()}
        limbs = {s for own in self.chains.values() for s in own}
        for s, parent in enumerate(self.parents):
            if parent in limbs:
                limbs.add(s)
        return tuple(
            name
            for name, s, offset in zip(self.joint_names, self.joint_segments, self.joint_offsets)
            if s not in limbs or (s in roots and not np.any(offset))
        )

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """(S, d): whether a degree of freedom moves a segment."""
        result = np.zeros((len(self.parents), self.dimension), dtype=bool)
        for s, parent in enumerate(self.parents):
            if parent >= 0:
                result[s] = result[parent]
            result[s, list(self.segment_dofs[s])] = True
        return result

    @cached_property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """Pairs (parent joint, child joint) that a drawing of the skeleton connects."""
        at_start: dict[int, int] = {}  # the first joint at each segment's origin
        for j, s in enumerate(self.joint_segments):
            if not np.any(self.joint_offsets[j]):
                at_start.setdefault(int(s), j)
        for s, parent in enumerate(self.parents):  # siblings with the same origin share the joint
            for other, joint in list(at_start.items()):
                same = parent == self.parents[other] and parent >= 0
                if s not in at_start and same and np.allclose(self.offsets[s], self.offsets[other]):
                    at_start[s] = joint
        result = []
        for j, s in enumerate(self.joint_segments):
            step = int(s) if np.any(self.joint_offsets[j]) else self.parents[s]
            while step >= 0 and step not in at_start:
                step = self.parents[step]
            if step >= 0 and at_start[step] != j:
                result.append((at_start[step], j))
        return tuple(result)

    def dof_index(self, names: list[str] | tuple[str, ...]) -> Index:
        """Positions of named degrees of freedom in a pose.

        Raises:
            KeyError: the skeleton lacks a name.
        """
        return _positions(tuple(names), self.dof_names, 'degree of freedom', self.name)

    def joint_index(self, names: list[str] | tuple[str, ...]) -> Index:
        """Positions of named joints.

        Raises:
            KeyError: the skeleton lacks a name.
        """
        return _positions(tuple(names), self.joint_names, 'joint', self.name)

    def with_lengths(self, lengths: Mapping[str, float]) -> Skeleton:
        """Return a copy of the skeleton with new values (m) of some lengths.

        Raises:
            KeyError: the skeleton lacks a name.
            ValueError: a length is not finite.
        """
        new = self.lengths.copy()
        where = _positions(tuple(lengths), self.length_names, 'length', self.name)
        new[where] = [float(x) for x in lengths.values()]
        if not np.isfinite(new).all():
            raise ValueError(f'{self.name}: lengths must be finite, saw {dict(lengths)}')
        new.setflags(write=False)
        result = copy(self)
        object.__setattr__(result, 'lengths', new)
        for name in _LENGTH_PROPERTIES:
            result.__dict__.pop(name, None)
        return result


# Cached properties that depend on the lengths of a skeleton.
_LENGTH_PROPERTIES = ('offsets', 'joint_offsets', 'trunk_joints', 'bones')


def sided_pairs(names: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """The pairs (left_x, right_x) among names, in the order of the names."""
    known = tuple(names)
    pairs = [(name, other_side(name)) for name in known if name.startswith('left_')]
    return tuple(pair for pair in pairs if pair[1] in known)


@lru_cache(maxsize=256)
def other_side(name: str) -> str:
    """Return the name with left and right exchanged."""
    for side, other in (('left_', 'right_'), ('right_', 'left_')):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


@lru_cache(maxsize=256)
def _positions(names: tuple[str, ...], known: tuple[str, ...], kind: str, owner: str) -> Index:
    """Return the positions of names among the known names, as a read-only array."""
    place = {name: i for i, name in enumerate(known)}
    missing = [name for name in names if name not in place]
    if missing:
        raise KeyError(f'{owner} has no {kind} {missing}; it has {list(known)}')
    result = np.array([place[name] for name in names], dtype=np.intp)
    result.flags.writeable = False
    return result
