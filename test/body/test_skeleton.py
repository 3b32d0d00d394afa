"""The checks when a skeleton is made, and how its parts are found by name."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.skeleton import Skeleton

SKELETON = load_body('human37').skeleton


def two_segments() -> dict:
    """Arguments for a rod that slides and turns, with a second rod hinged to it."""
    return {
        'name': 'rods', 'segment_names': ('first', 'second'), 'parents': (-1, 0),
        'mounts': np.tile(np.eye(3), (2, 1, 1)), 'fixed_offsets': np.zeros((2, 3)),
        'offset_basis': np.zeros((2, 3, 1)), 'dof_names': ('slide', 'turn', 'hinge'),
        'dof_segments': np.array([0, 0, 1]), 'dof_axes': np.array([2, 0, 0]),
        'dof_is_rotation': np.array([False, True, True]), 'lower': -np.ones(3), 'upper': np.ones(3),
        'joint_names': ('start', 'end'), 'joint_segments': np.array([0, 1]),
        'joint_basis': np.zeros((2, 3, 1)),
        'length_names': ('rod',), 'lengths': np.array([0.5]),
    }  # fmt: skip


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'mounts': np.eye(3)}, r'rods: mounts has shape \(3, 3\), wanted \(2, 3, 3\)'),
        ({'lower': -np.ones(2)}, r'lower has shape \(2,\), wanted \(3,\)'),
        ({'lengths': np.ones(2)}, r'lengths has shape \(2,\), wanted \(1,\)'),
        ({'joint_basis': np.zeros((2, 3, 2))}, 'joint_basis has shape'),
        ({'parents': (-1, 1)}, 'segment second has parent 1, wanted one that stands before'),
        ({'parents': (-2, 0)}, 'segment first has parent -2'),
        ({'dof_segments': np.array([0, 1, 0])}, 'in the order of segments'),
        ({'dof_is_rotation': np.array([True, False, True])}, 'translations .* before'),
        ({'dof_names': ('slide', 'slide', 'hinge')}, r"dof_names has \['slide'\] more than once"),
        ({'joint_names': ('end', 'end')}, r"joint_names has \['end'\] more than once"),
        ({'segment_names': ('rod', 'rod')}, r"segment_names has \['rod'\] more than once"),
        ({'lower': np.array([-1, 1, -1.0])}, r"lower limit not below upper limit for \['turn'\]"),
        ({'upper': np.array([1, np.nan, 1])}, 'lower limit not below upper'),
    ],
)
def test_a_skeleton_that_contradicts_itself_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        type(SKELETON)(**{**two_segments(), **change})


def test_names_are_found_and_unknown_ones_are_named():
    names = ('left_knee', 'root_tx')
    where = SKELETON.dof_index(names)
    assert tuple(SKELETON.dof_names[i] for i in where) == names
    with pytest.raises(KeyError, match=r"no joint \['nose'\]; it has"):
        SKELETON.joint_index(('head', 'nose'))
    with pytest.raises(KeyError, match=r"no degree of freedom \['elbow'\]"):
        SKELETON.dof_index(['elbow'])


def test_chains_own_their_degrees_of_freedom_and_joints():
    owned = SKELETON.chain_dofs
    assert set(owned) == {'left_arm', 'right_arm', 'left_leg', 'right_leg', 'neck'}
    everything = np.concatenate(list(owned.values()))
    assert len(everything) == len(np.unique(everything)) == 26
    assert [SKELETON.dof_names[j] for j in owned['left_arm']] == [
        'left_shoulder_x', 'left_shoulder_y', 'left_shoulder_z',
        'left_elbow', 'left_wrist_x', 'left_wrist_y',
    ]  # fmt: skip
    joints = [SKELETON.joint_names[j] for j in SKELETON.chain_joints['left_arm']]
    assert joints == ['left_shoulder', 'left_elbow', 'left_wrist', 'left_hand']


@pytest.mark.parametrize('name', ['human32', 'human37'])
def test_other_lengths_change_all_that_follows_from_them(name):
    before = load_body(name).skeleton
    derived = [key for key, x in vars(Skeleton).items() if isinstance(x, cached_property)]
    for key in derived:
        getattr(before, key)
    lengths = dict(zip(before.length_names, 1.1 * before.lengths, strict=True))
    after, wanted = before.with_lengths(lengths), replace(before, lengths=1.1 * before.lengths)
    for key in (*derived, 'lengths', 'mounts'):
        np.testing.assert_equal(getattr(after, key), getattr(wanted, key))
    assert not after.lengths.flags.writeable
    assert not np.array_equal(after.offsets, before.offsets)
