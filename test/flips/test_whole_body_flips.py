"""Products of trees over the whole body against their definition, built leaf by leaf."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.whole_body_flips import DepthOrder, deepest_overlaps, full_body_flips
from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.flips.torso_flips import JOINTS

ALL = 10**6


@pytest.fixture(scope='module')
def body():
    return load_body('human34')


@pytest.fixture(scope='module')
def pose(body):
    """A person who turns a little and leans, with limbs out of the image plane."""
    pose = np.array(body.prior_mean)
    pose[2] = 3.0
    angles = {
        'root_z': 30, 'root_x': -12, 'trunk_x': -20, 'left_shoulder_x': 70, 'left_elbow': 70,
        'right_shoulder_x': 55, 'right_elbow': 80, 'left_hip_x': 35, 'left_knee': -60,
        'right_hip_x': 10, 'right_knee': -50, 'neck_x': -30,
    }  # fmt: skip
    for name, angle in angles.items():
        pose[body.dof_names.index(name)] = np.radians(angle)
    return pose


@pytest.fixture(scope='module')
def product(body, pose):
    return full_body_flips(body, pose)


def prior_of(body, poses):
    offset = (poses - body.prior_mean) / body.prior_sigma
    return -0.5 * (offset * offset).sum(1)


def as_rows(poses):
    return {tuple(row) for row in poses.round(9).tolist()}


def test_all_leaves_best_first_are_the_product(body, product):
    """Against every combination of the lists, with the tables of pairs."""
    pairs = list(itertools.combinations(range(5), 2))
    sums = []
    for t, base in enumerate(product.trunk_log_priors):
        lists = [np.flatnonzero(np.isfinite(p[t])) for p in product.log_priors]
        for picks in itertools.product(*lists):
            if all(
                table[t, picks[i], picks[j]]
                for (i, j), table in zip(pairs, product.allowed, strict=True)
            ):
                own = (p[t, k] for p, k in zip(product.log_priors, picks, strict=True))
                sums.append(base + sum(own))
    found = product.most_probable(ALL)
    assert len(product.trunks) > 1
    assert len(found.poses) == len(sums) > 100
    assert np.allclose(found.log_priors, np.sort(sums)[::-1])
    assert (np.diff(found.log_priors) <= 1e-12).all()
    assert len(as_rows(found.poses)) == len(sums)
    # The log priors are those of the poses.
    assert np.allclose(found.log_priors, prior_of(body, found.poses))


@pytest.mark.parametrize('count', [0, 1, 7, 60])
def test_the_best_are_the_first_of_all(product, count):
    everything, few = product.most_probable(ALL), product.most_probable(count)
    assert np.array_equal(few.poses, everything.poses[:count])
    assert np.array_equal(few.log_priors, everything.log_priors[:count])


def test_without_torso_and_pruning_it_is_the_product_of_the_trees(body, pose):
    product = full_body_flips(body, pose, torso=False, most_overlap=np.inf)
    leaves, _ = enumerate_flips(body, pose, list(body.chains))
    assert product.size == len(leaves)
    assert as_rows(product.most_probable(ALL).poses) == as_rows(leaves)


def test_some_chains_only(body, pose):
    chains = ('left_arm', 'neck')
    product = full_body_flips(body, pose, chains, torso=False, most_overlap=np.inf)
    leaves, _ = enumerate_flips(body, pose, chains)
    assert as_rows(product.most_probable(ALL).poses) == as_rows(leaves)


def test_flipped_torsos_have_the_image(body, pose, product):
    which = body.skeleton.joint_index(JOINTS)
    seen = body.joint_positions(pose[None])[:, which]
    rays = seen / np.linalg.norm(seen, axis=2, keepdims=True)
    torsos = body.joint_positions(product.trunks)[:, which]
    assert np.array_equal(product.trunks[0], pose)
    assert np.linalg.norm(np.cross(torsos, rays), axis=2).max() < 0.03
    gaps = np.linalg.norm(torsos[:, None] - torsos[None], axis=3).max(2)
    assert gaps[~np.eye(len(torsos), dtype=bool)].min() > 0.03


def test_leaves_that_intersect_are_pruned_and_no_others(body, pose):
    def deepest(poses):
        everything = range(len(body.skeleton.parents))
        rows = np.arange(len(poses))
        placed = forward(body.skeleton, poses).by_pose()
        return deepest_overlaps(body, *placed, rows, everything, rows, everything)

    free = full_body_flips(body, pose, torso=False, most_overlap=np.inf).most_probable(ALL)
    depth = deepest(free.poses)
    for most in (0.0, 0.02, 0.05):
        kept = full_body_flips(body, pose, torso=False, most_overlap=most).most_probable(ALL)
        same = np.abs(free.poses - pose).max(1) == 0
        assert as_rows(kept.poses) == as_rows(free.poses[(depth <= most) | same])
    assert (depth > 0.05).any()
    assert (depth <= 0.05).any()


def test_the_given_pose_stays_though_it_intersects(body, pose):
    through = pose.copy()
    for name, angle in {'left_shoulder_y': 60, 'left_shoulder_z': -90, 'left_elbow': 140}.items():
        through[body.dof_names.index(name)] = np.radians(angle)
    through = np.clip(through, body.lower, body.upper)
    found = full_body_flips(body, through, most_overlap=-1.0).most_probable(ALL).poses
    assert np.abs(found - through).max(1).min() == 0.0


@pytest.mark.parametrize(
    'order',
    [
        DepthOrder(('left_wrist', 'left_wrist'), ('right_wrist', 'right_wrist')),
        DepthOrder(('right_elbow', 'right_elbow'), ('left_hand', 'left_hand')),
        DepthOrder(('right_elbow', 'right_elbow'), ('pelvis', 'pelvis')),
        DepthOrder(('pelvis', 'pelvis'), ('right_knee', 'right_knee')),
        DepthOrder(('left_elbow', 'left_elbow'), ('left_wrist', 'left_wrist')),
        DepthOrder(('left_wrist', 'left_hand'), ('pelvis', 'neck')),
    ],
)
def test_what_contradicts_an_order_in_depth_is_pruned_and_nothing_else(body, pose, order):
    def depths(poses, part):
        return body.joint_positions(poses)[:, body.skeleton.joint_index(part), 2]

    everything = full_body_flips(body, pose).most_probable(ALL).poses
    kept = full_body_flips(body, pose, depth_orders=[order]).most_probable(ALL).poses
    front, behind = depths(everything, order.front), depths(everything, order.behind)
    if order.front[0] == order.front[1]:
        fits = front[:, 0] < behind[:, 0]
        assert as_rows(kept) == as_rows(everything[fits])
        assert 0 < fits.sum() < len(everything)
    else:
        assert as_rows(kept) <= as_rows(everything[front.min(1) < behind.max(1)])
        assert as_rows(kept) >= as_rows(everything[front.max(1) < behind.min(1)])


def test_depth_is_compared_where_the_parts_cross(body):
    """A forearm across the other: the depths at the crossing, not at the joints, decide."""
    pose = np.array(body.prior_mean)
    pose[2] = 3.0
    parts = ('left_elbow', 'left_wrist'), ('right_elbow', 'right_wrist')
    arms = [j for j, name in enumerate(body.dof_names) if 'shoulder' in name or 'elbow' in name]
    rng = np.random.default_rng(0)
    for _ in range(10_000):
        pose[arms] = rng.uniform(body.lower[arms], body.upper[arms])
        ends = [body.joint_positions(pose[None])[0, body.skeleton.joint_index(p)] for p in parts]
        # The crossing in the image by linear equations, and the depth on each line there.
        flat = [e[:, :2] / e[:, 2:] for e in ends]
        matrix = np.stack([flat[0][1] - flat[0][0], flat[1][0] - flat[1][1]], axis=1)
        shares = np.linalg.solve(matrix, flat[1][0] - flat[0][0])
        if ((shares > 0.1) & (shares < 0.9)).all():
            break
    point = flat[0][0] + shares[0] * (flat[0][1] - flat[0][0])
    ray = np.append(point, 1.0)
    depth = []
    for e in ends:
        # z with z ray = e0 + s (e1 - e0)
        system = np.stack([ray, e[0] - e[1]], axis=1)
        depth.append(np.linalg.lstsq(system, e[0], rcond=None)[0][0])
    orders = [DepthOrder(*parts), DepthOrder(*parts[::-1])]
    stays = [
        np.abs(
            full_body_flips(body, pose, torso=False, depth_orders=[o]).most_probable(ALL).poses
            - pose
        ).max(1).min(initial=9.0) == 0.0
        for o in orders
    ]  # fmt: skip
    assert stays == [depth[0] < depth[1], depth[1] < depth[0]]


def test_samples_follow_the_prior(product):
    everything = product.most_probable(ALL)
    count = 60_000
    drawn = product.sample(count, np.random.default_rng(0))
    place = {tuple(row): i for i, row in enumerate(everything.poses.round(9).tolist())}
    which = np.array([place[tuple(row)] for row in drawn.poses.round(9).tolist()])
    shares = np.exp(everything.log_priors - everything.log_priors[0])
    shares /= shares.sum()
    often = count * shares > 20
    seen = np.bincount(which, minlength=len(shares))
    chi = ((seen - count * shares)[often] ** 2 / (count * shares)[often]).sum()
    assert chi < often.sum() + 5 * np.sqrt(2 * often.sum())
    assert seen[~often].sum() == pytest.approx(
        count * shares[~often].sum(), abs=5 * np.sqrt(count * shares[~often].sum()) + 5
    )
    assert np.allclose(drawn.log_priors, everything.log_priors[which])
    assert np.array_equal(drawn.trunks, everything.trunks[which])
    again = product.sample(100, np.random.default_rng(3))
    assert np.array_equal(again.poses, product.sample(100, np.random.default_rng(3)).poses)


def test_several_poses_at_once_are_one_by_one(body, pose):
    rng = np.random.default_rng(0)
    poses = np.clip(pose + 0.1 * rng.normal(size=(5, 34)), body.lower, body.upper)
    together = full_body_flips(body, poses)
    found = together.most_probable(ALL)
    for n in range(5):
        alone = full_body_flips(body, poses[n]).most_probable(ALL)
        own = found.poses[together.parents[found.trunks] == n]
        assert len(own) == len(alone.poses)
        assert np.abs(own - alone.poses).max() < 1e-6


def test_a_product_without_leaves(body, pose):
    # In front of itself nothing can be.
    order = DepthOrder(('pelvis', 'pelvis'), ('pelvis', 'pelvis'))
    nothing = full_body_flips(body, pose, depth_orders=[order])
    assert nothing.size == 0
    assert nothing.most_probable(10).poses.shape == (0, 34)
    with pytest.raises(ValueError, match='no leaves'):
        nothing.sample(3, np.random.default_rng(0))


def test_what_does_not_go_together_is_refused(body, pose):
    with pytest.raises(KeyError, match="no chain 'tail'"):
        full_body_flips(body, pose, ['tail'])
    with pytest.raises(ValueError, match='share segments'):
        full_body_flips(body, pose, ['left_arm', 'left_arm'])
    order = DepthOrder(('left_wrist', 'right_wrist'), ('pelvis', 'neck'))
    with pytest.raises(ValueError, match='different chains'):
        full_body_flips(body, pose, depth_orders=[order])


def test_bodies_without_flesh_or_torso(pose):
    body = load_body('human34')
    bare = replace(body, shapes=(), growth=())
    assert full_body_flips(bare, pose).size == full_body_flips(body, pose, most_overlap=np.inf).size
