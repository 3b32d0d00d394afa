"""Products of limbs: configurations compared with single flips, the best with enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.skeleton import other_side
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.flips.limb_products import Configurations, LimbProducts, limbs_of
from hmt_ros.flips.torso_flips import flip_torso
from test.oracles.rehung import rehang_chain

APART, PRICE, MOST = 0.08, 3.5, 10
SHARE = 0.3


@pytest.fixture(scope='module', params=['human37', 'human34', 'human32'])
def body(request):
    return load_body(request.param)


def modes_of(body, count, seed, spread=0.15):
    """Poses (G, d) with the same trunk and different limbs."""
    rng = np.random.default_rng(seed)
    lead = body.prior_mean + 0.3 * body.prior_sigma * rng.standard_normal(body.dimension)
    lead[:3] = [0.3, -0.2, 3.0]
    lead[body.dof_names.index('root_z')] = 0.5
    result = np.repeat(lead[None], count, axis=0)
    for own in body.skeleton.chain_dofs.values():
        result[:, own] += spread * rng.standard_normal((count, len(own)))
    return np.clip(result, body.lower, body.upper)


def found_by_search(body, seed):
    """Angles of an arm and a leg that a search could have found."""
    rng = np.random.default_rng(seed)
    result = {}
    for chain in ('left_arm', 'right_leg'):
        own = body.skeleton.chain_dofs[chain]
        result[chain] = rng.uniform(body.lower[own], body.upper[own], (3, len(own)))
    return result


def distinct_one_by_one(body, pose, chain, angles):
    """Distinct rows, and the representative row of each of angles (A, D)."""
    poses = np.repeat(pose[None], len(angles), axis=0)
    poses[:, body.skeleton.chain_dofs[chain]] = angles
    joints = body.joint_positions(poses)[:, body.skeleton.chain_joints[chain]]
    gaps = np.linalg.norm(joints[:, None] - joints[None], axis=3).max(2)
    kept: list[int] = []
    owner = []
    for i in range(len(angles)):
        near = sorted((gaps[i, k], place) for place, k in enumerate(kept) if gaps[i, k] < APART)
        if near:
            owner.append(near[0][1])
        elif len(kept) < MOST:
            owner.append(len(kept))
            kept.append(i)
        else:
            owner.append(-1)
    return kept, np.array(owner)


def configurations_one_by_one(body, modes, found):
    """Trunks (T, d), and by name the angles of each limb on each; penalties on the first trunk."""
    skeleton, lead = body.skeleton, modes[:1]
    dofs, paired = skeleton.chain_dofs, {x for pair in body.chain_pairs for x in pair}
    trunks, angles, penalties = [lead[0]], [{}], {}
    for chain, own in dofs.items():
        sources = [modes[:, own], *([found[chain]] if chain in found else [])]
        if chain in paired:
            hung, _ = rehang_chain(body, lead, lead, chain, image_of=other_side(chain))
            sources.append(hung[:, own])
        sources = np.concatenate(sources)
        poses = np.repeat(lead, len(sources), axis=0)
        poses[:, own] = sources
        flips, parents = enumerate_flips(body, poses, chain)
        # Each pose is the first of its own flips.
        every = flips[:, own]
        price = np.full((len(modes), len(every)), PRICE)
        for g in range(len(modes)):
            price[g, np.flatnonzero(parents == g)[0]] = 0.0
        kept, owner = distinct_one_by_one(body, lead[0], chain, every)
        angles[0][chain] = every[kept]
        penalties[chain] = np.stack(
            [price[:, owner == k].min(axis=1) for k in range(len(kept))], axis=1
        )
    for pair in body.chain_pairs:
        pose, own_angles = lead[0].copy(), {}
        for chain, other in (pair, pair[::-1]):
            hung, _ = rehang_chain(body, lead, lead, chain, image_of=other)
            if len(hung) == 0:
                break
            every = hung[:, dofs[chain]]
            pose[dofs[chain]] = every[0]
            own_angles[chain] = every[distinct_one_by_one(body, lead[0], chain, every)[0]]
        if len(own_angles) == 2:
            trunks.append(pose)
            angles.append(own_angles)
    for flipped in flip_torso(body, lead)[0]:
        pose, own_angles = flipped.copy(), {}
        for chain, own in dofs.items():
            hung, _ = rehang_chain(body, lead, flipped[None], chain)
            every = hung[:, own] if len(hung) else flipped[None, own]
            pose[own] = every[0]
            own_angles[chain] = every[distinct_one_by_one(body, flipped, chain, every)[0]]
        trunks.append(pose)
        angles.append(own_angles)
    return np.array(trunks), angles, penalties


@pytest.mark.parametrize('count', [1, 3])
@pytest.mark.parametrize('seed', range(8))
def test_configurations_one_by_one(body, count, seed):
    modes = modes_of(body, count, seed)
    found = found_by_search(body, seed) if seed % 2 else {}
    products = LimbProducts.of(body, modes, found, PRICE, apart=APART, most=MOST)
    trunks, angles, penalties = configurations_one_by_one(body, modes, found)
    got = products.configurations
    assert np.allclose(got.trunks, trunks, atol=1e-12)
    assert len(trunks) == 1 + products.exchanged + len(flip_torso(body, modes[:1])[0])
    for t, wanted in enumerate(angles):
        for c, (chain, own) in enumerate(body.skeleton.chain_dofs.items()):
            assert got.counts[t, c] == len(wanted.get(chain, []))
            if chain in wanted:
                own_angles = got.angles[t, c, : got.counts[t, c], : len(own)]
                assert np.allclose(own_angles, wanted[chain], atol=1e-12)
            if t == 0:
                assert np.array_equal(got.penalties[:, c, : got.counts[t, c]], penalties[chain])


def test_many_modes_leave_the_flips_of_the_best_among_few_configurations(body):
    modes = modes_of(body, 8, 0, spread=0.4)
    lead, most = modes[:1], 4
    products = LimbProducts.of(body, modes, {}, PRICE, apart=APART, most=most)
    far = 0
    for c, (chain, own) in enumerate(body.skeleton.chain_dofs.items()):
        flips = enumerate_flips(body, lead, chain)[0][:, own]
        kept = distinct_one_by_one(body, lead[0], chain, flips)[0][:most]
        far += len(kept) - 1
        found = products.configurations.angles[0, c, : len(kept), : len(own)]
        assert np.allclose(found, flips[kept], atol=1e-12)
    assert far > 0


def test_limbs_change_places_and_the_torso_flips_somewhere(body):
    """Otherwise the comparison above is meaningless."""
    found = [
        LimbProducts.of(body, modes_of(body, 1, seed), {}, PRICE, apart=APART, most=MOST)
        for seed in range(8)
    ]
    assert max(one.exchanged for one in found) > 0
    assert max(len(one.configurations.trunks) - one.exchanged for one in found) > 1


@pytest.mark.parametrize('seed', range(4))
def test_the_last_trunks_are_left_out(body, seed):
    modes = modes_of(body, 2, seed)
    every = LimbProducts.of(body, modes, {}, PRICE, apart=APART, most=MOST)
    ends = np.cumsum(1 + every.configurations.counts.sum(1))
    for poses in (-1, 0, *(ends - 1), *ends):
        some = LimbProducts.of(body, modes, {}, PRICE, apart=APART, most=MOST, poses=int(poses))
        used = max(int((ends <= poses).sum()), 1)
        assert some.exchanged == min(every.exchanged, used - 1)
        for name in ('trunks', 'angles', 'counts'):
            wanted = getattr(every.configurations, name)[:used]
            assert np.array_equal(getattr(some.configurations, name), wanted)


def test_poses_alone(body):
    products = LimbProducts.of(
        body, modes_of(body, 2, 3), found_by_search(body, 3), PRICE, apart=APART, most=MOST
    )
    found, rows = products.configurations, []
    for t, trunk in enumerate(found.trunks):
        rows.append(trunk)
        for c, own in enumerate(body.skeleton.chain_dofs.values()):
            for i in range(found.counts[t, c]):
                rows.append(trunk.copy())
                rows[-1][own] = found.angles[t, c, i, : len(own)]
    poses, own = products.alone
    assert np.array_equal(poses[own], rows)
    assert len(poses) == len(np.unique(rows, axis=0)) < len(rows)


def made_up(body, group, trunks, seed, *, ties=False):
    """Products of random configurations, and energies of the poses alone."""
    rng = np.random.default_rng(seed)
    limbs = limbs_of(body.skeleton)
    counts = rng.integers(1, 4, (trunks, len(limbs.links)))
    counts[1:2, 1:] = 0
    penalties = rng.exponential(1.5, (group, len(limbs.links), 3))
    energies = rng.normal(0.0, 4.0, trunks + counts.sum())
    if ties:
        penalties, energies = np.rint(penalties), np.rint(energies)
    angles = rng.normal(size=(trunks, len(limbs.links), 3, limbs.own.shape[1]))
    products = LimbProducts(
        body, rng.normal(size=(group, body.dimension)),
        Configurations(
            rng.normal(size=(trunks, body.dimension)), angles, counts.astype(np.int64), penalties
        ),
        exchanged=min(trunks - 1, 1),
    )  # fmt: skip
    return products, energies, np.log(rng.dirichlet(np.ones(group)))


def enumerated(products, energies, log_weights, exchange, flip, share):
    """All products, best first: costs, parents, energies, poses."""
    found, body = products.configurations, products.body
    limbs, rows = limbs_of(body.skeleton), iter(energies)
    bases, changes = [], []
    for t in range(len(found.trunks)):
        bases.append(next(rows))
        changes.append([[next(rows) - bases[t] for _ in range(n)] for n in found.counts[t]])
    total = np.logaddexp.reduce(log_weights)
    result = []
    for t, trunk in enumerate(found.trunks):
        own = [t if changes[t][c] else 0 for c in range(len(limbs.links))]
        price = exchange if 1 <= t <= products.exchanged else flip
        weights = log_weights if t == 0 else [total - price]
        ranked = []
        for pick in itertools.product(*(range(len(changes[at][c])) for c, at in enumerate(own))):
            change = sum(changes[at][c][i] for c, (at, i) in enumerate(zip(own, pick)))
            there = [(c, i) for c, (at, i) in enumerate(zip(own, pick)) if at == 0]
            costs = [
                share * change - weight + sum(found.penalties[g, c, i] for c, i in there)
                for g, weight in enumerate(weights)
            ]
            g = int(np.argmin(costs))
            pose = products.modes[g].copy() if t == 0 else trunk.copy()
            for c, (at, i) in enumerate(zip(own, pick)):
                n = limbs.dofs[c]
                pose[limbs.own[c, :n]] = found.angles[at, c, i, :n]
            ranked.append((costs[g], g, bases[t] + change, pose))
        result.append(sorted(ranked, key=lambda x: x[0]))
    return result


@pytest.mark.parametrize(('group', 'trunks'), [(1, 1), (3, 1), (2, 4)])
@pytest.mark.parametrize('count', [1, 7, 40, 1000])
def test_the_best_against_enumeration(body, group, trunks, count):
    products, energies, log_weights = made_up(body, group, trunks, count + group)
    found = products.best(energies, log_weights, exchange=2.0, flip=3.0, share=SHARE, count=count)
    wanted = [
        row
        for ranked in enumerated(products, energies, log_weights, 2.0, 3.0, SHARE)
        for row in ranked[:count]
    ]
    assert found.parents.tolist() == [row[1] for row in wanted]
    assert np.allclose(found.energies, [row[2] for row in wanted], atol=1e-12)
    assert np.array_equal(found.poses, [row[3] for row in wanted])


@pytest.mark.parametrize('count', [1, 5, 40])
def test_equal_sums(body, count):
    """Costs are integers, so sums are exact and often equal; all results are among the best."""
    products, energies, log_weights = made_up(body, 2, 3, 11, ties=True)
    log_weights = np.zeros_like(log_weights)
    found = products.best(energies, log_weights, exchange=0.0, flip=0.0, share=1.0, count=count)
    ranked = enumerated(products, energies, log_weights, 0.0, 0.0, 1.0)
    again = [row for rows in ranked for row in rows[:count]]
    assert len(found.poses) == len(again)
    for pose, wanted in zip(found.poses, again):
        same = [row for rows in ranked for row in rows if np.array_equal(row[3], pose)]
        assert same
        assert same[0][0] == wanted[0]


def test_nothing_that_is_given_is_changed(body):
    products, energies, log_weights = made_up(body, 2, 2, 5)
    before = [x.copy() for x in (products.modes, *products.configurations, energies, log_weights)]
    products.best(energies, log_weights, exchange=1.0, flip=1.0, share=SHARE, count=9)
    after = (products.modes, *products.configurations, energies, log_weights)
    assert all(np.array_equal(a, b) for a, b in zip(after, before, strict=True))


def test_jumps_that_cost_too_much_leave_each_mode_with_its_limbs(body):
    modes = modes_of(body, 3, 2, spread=0.5)
    products = LimbProducts.of(body, modes, {}, 1e3, apart=1e-9, most=200)
    weights = np.log([0.2, 0.5, 0.3])
    found = products.best(
        np.zeros(len(products.alone[1])), weights, exchange=1e3, flip=1e3, share=SHARE, count=3
    )
    assert found.parents[:3].tolist() == [1, 2, 0]
    assert np.array_equal(found.poses[:3], modes[[1, 2, 0]])


def test_energies_that_are_not_finite_come_last(body):
    products, energies, log_weights = made_up(body, 1, 1, 8)
    energies[2] = np.inf
    found = products.best(energies, log_weights, exchange=1.0, flip=1.0, share=SHARE, count=5)
    assert len(found.poses) == 5
    assert np.isfinite(found.energies[0])
