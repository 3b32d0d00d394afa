"""Flips and products of limbs: invalid arguments are refused; for values see test/flips."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward, placing_of
from hmt_ros.core import (
    combine,
    fill_configurations,
    fill_torso_flips,
    grow_leaves,
    keep_distinct,
    place_alone,
)
from hmt_ros.flips.chain_links import chain_links
from hmt_ros.flips.limb_products import LimbProducts, limbs_of
from hmt_ros.flips.torso_flips import _torso_of, flip_torso
from test.core.arguments import assert_arguments_are_checked

BODY = load_body('human37')
SKELETON = BODY.skeleton
D = BODY.dimension
# Entries of limbs that only configurations need.
UNREAD = 'limbs.segments limbs.parents limbs.joint_segments'


def poses(count=2, seed=0):
    rng = np.random.default_rng(seed)
    result = BODY.prior_mean + 0.3 * BODY.prior_sigma * rng.standard_normal((count, D))
    result[:, :3] = [0.3, -0.2, 3.0]
    return np.clip(result, BODY.lower, BODY.upper)


def products(modes):
    return LimbProducts.of(BODY, modes, {}, 3.0, apart=0.1, most=4)


def test_distinct_poses_need_points_of_joints():
    named = {
        'points': np.random.default_rng(0).normal(size=(5, 6)),
        'apart': 0.1,
        'most': 3,
        'kept': np.zeros(5, np.int64),
        'owner': np.zeros(5, np.int64),
    }
    assert_arguments_are_checked(keep_distinct, named, 'kept owner', unread='kept owner')
    with pytest.raises(ValueError, match='points: wanted coordinates'):
        keep_distinct(np.zeros((5, 4)), *list(named.values())[1:])


def test_leaves_need_arguments_that_fit():
    frames, chain = forward(SKELETON, poses()), chain_links(SKELETON, 'left_arm')
    count, leaves = len(chain.lengths), 2 ** len(chain.lengths)
    named = {
        'chain': chain,
        'columns': frames.columns,
        'origins': frames.origins,
        'poses': frames.poses,
        'targets': np.ones((count, 3, 2)),
        'slack': 0.1,
        'given_stays': False,
        'angles': np.zeros((2, leaves, len(chain.dofs))),
        'valid': np.zeros((2, leaves), bool),
    }
    assert_arguments_are_checked(grow_leaves, named, 'angles valid')
    for changed, text in (
        ({'parent': -1}, 'chain.parent: wanted'),
        ({'parent': len(SKELETON.parents)}, 'chain.parent: wanted'),
        # A hinge as first joint, a link without rotation, one with four degrees of freedom.
        ({'first_dofs': np.array([0, 1, 4, 6])[: count + 1]}, 'chain.first_dofs: wanted links'),
        ({'first_dofs': np.zeros(count + 1, np.int64)}, 'chain.first_dofs: wanted links'),
        ({'first_dofs': 4 * np.minimum(np.arange(count + 1), 1)}, 'chain.first_dofs: wanted links'),
    ):
        with pytest.raises(ValueError, match=text):
            grow_leaves(chain._replace(**changed), *list(named.values())[1:])


def test_flips_of_the_torso_need_arguments_that_fit():
    torso = _torso_of(SKELETON)
    most = 2 * len(torso.flips)
    named = {
        'tree': placing_of(SKELETON),
        'torso': torso,
        'poses': poses(),
        'result': np.zeros((most, D)),
        'parents': np.zeros(most, np.int64),
    }
    # A trunk with two axes of rotation, or none.
    assert_arguments_are_checked(
        fill_torso_flips, named, 'result parents', free='torso.trunk', unread='parents'
    )
    for segment in (-1, 0, len(SKELETON.parents)):
        with pytest.raises(ValueError, match=r'torso\.segment: wanted'):
            fill_torso_flips(
                named['tree'], torso._replace(segment=segment), *list(named.values())[2:]
            )


def test_configurations_need_arguments_that_fit():
    modes, limbs = poses(), limbs_of(SKELETON)
    count, width = limbs.own.shape
    flipped = flip_torso(BODY, modes[:1])[0]
    assert len(flipped) > 0
    trunks = 1 + len(BODY.chain_pairs) + len(flipped)
    found = products(modes).configurations
    named = {
        'tree': placing_of(SKELETON),
        'limbs': limbs,
        'modes': modes,
        'found': np.zeros((count, 1, width)),
        'found_counts': np.ones(count, np.int64),
        'flipped': flipped,
        'price': 3.0,
        'apart': 0.1,
        'most': 1000,
        'result': found._replace(
            trunks=np.zeros((trunks, D)),
            angles=np.zeros((trunks, count, 4, width)),
            counts=np.zeros((trunks, count), np.int64),
        ),
    }
    assert_arguments_are_checked(fill_configurations, named, 'result', free='flipped')
    siblings = np.arange(count)
    with pytest.raises(ValueError, match=r'limbs\.siblings: wanted pairs'):
        fill_configurations(
            named['tree'], limbs._replace(siblings=siblings), *list(named.values())[2:]
        )


def test_poses_alone_and_products_need_arguments_that_fit():
    modes, limbs = poses(), limbs_of(SKELETON)
    of_modes = products(modes)
    found, (_, rows) = of_modes.configurations, of_modes.alone
    named = {'limbs': limbs, 'found': found, 'poses': np.empty((len(rows), D)), 'rows': rows}
    assert_arguments_are_checked(
        place_alone, named, 'poses rows', free='found.penalties', unread=UNREAD + ' rows'
    )
    trunks, count = len(found.trunks), 3
    named = {
        'limbs': limbs,
        'modes': modes,
        'found': found,
        'energies': np.zeros(len(rows)),
        'log_weights': np.zeros(2),
        'exchanged': 1,
        'exchange': 1.0,
        'flip': 2.0,
        'share': 0.5,
        'count': count,
        'poses': np.zeros((trunks * count, D)),
        'parents': np.zeros(trunks * count, np.int64),
        'values': np.zeros(trunks * count),
    }
    assert_arguments_are_checked(combine, named, 'poses parents values', unread=f'parents {UNREAD}')
    for wrong in (0, -1, 2**62):
        with pytest.raises(ValueError, match='count: wanted'):
            combine(*(named | {'count': wrong}).values())
