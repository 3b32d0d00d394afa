"""Flips: invariants and number of leaves, compared with recursion and symmetries."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Body, Camera, load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips
from test.oracles.rehung import rehang_chain

CAMERA = Camera(500.0, 510.0, 320.0, 240.0, 640, 480)
LIMBS = {
    'left_arm': ('left_shoulder', 'left_elbow', 'left_wrist', 'left_hand'),
    'right_arm': ('right_shoulder', 'right_elbow', 'right_wrist', 'right_hand'),
    'left_leg': ('left_hip', 'left_knee', 'left_ankle', 'left_toe'),
    'right_leg': ('right_hip', 'right_knee', 'right_ankle', 'right_toe'),
    'neck': ('neck', 'head'),
}


@pytest.fixture(scope='module', params=['human37', 'human34', 'human32'])
def body(request) -> Body:
    return load_body(request.param)


@pytest.fixture(scope='module')
def small() -> Body:
    return load_body('human32')


def without_limits(body: Body) -> Body:
    """The body without joint limits."""
    s = body.skeleton
    turns = s.dof_is_rotation
    lower, upper = np.where(turns, -np.pi, s.lower), np.where(turns, np.pi, s.upper)
    return replace(body, skeleton=replace(s, lower=lower, upper=upper))


def limb_places(body, poses, chain):
    """Joints (N, n + 1, 3) of a limb, from its start outwards."""
    which = body.skeleton.joint_index(LIMBS[chain])
    return body.joint_positions(poses)[:, which]


def on_rays(points, seen):
    """Sines of the angles between points and the rays of others."""
    cross = np.linalg.norm(np.cross(points, seen), axis=-1)
    return cross / np.linalg.norm(points, axis=-1) / np.linalg.norm(seen, axis=-1)


def leaves_by_recursion(start, seen, lengths):
    """Joint positions of all leaves, at intersections of rays with spheres around the parent."""
    if len(lengths) == 0:
        return [np.empty((0, 3))]
    ray = seen[0] / np.linalg.norm(seen[0])
    # |s ray - start|^2 = length^2, a polynomial in s
    roots = np.roots([1.0, -2.0 * ray @ start, start @ start - lengths[0] ** 2])
    result = []
    for s in roots:
        if abs(s.imag) < 1e-12 and s.real > 0:
            place = s.real * ray
            rests = leaves_by_recursion(place, seen[1:], lengths[1:])
            result += [np.concatenate([place[None], rest]) for rest in rests]
    return result


def expected_leaves(body, pose, chain):
    places = limb_places(body, pose[None], chain)[0]
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return leaves_by_recursion(places[0], places[1:], lengths)


def angle_solutions(angles, mount):
    """All angles modulo 2 pi with the same joint positions of a limb, by symmetry.

    Rx(a + pi) Ry(pi - b) Rz(c + pi) is the same rotation; Rz(c + pi) Rx(-e) differs by a half turn
    about z, which the end effector, mounted on the limb, undoes; its own second solution keeps the
    direction of the last segment and turns it about itself.
    """
    found = []
    for first, bent, last in itertools.product((False, True), repeat=3):
        a, b, c, e, f, g = angles
        if first:
            a, b, c = a + np.pi, np.pi - b, c + np.pi
        if bent:
            end = np.array([np.sin(g), -np.sin(f) * np.cos(g), np.cos(f) * np.cos(g)])
            end = mount.T @ np.diag([-1.0, -1.0, 1.0]) @ mount @ end
            c, e = c + np.pi, -e
            f, g = np.arctan2(-end[1], end[2]), np.arcsin(end[0])
        if last:
            f, g = f + np.pi, np.pi - g
        found.append([a, b, c, e, f, g])
    return np.array(found)


def within(angles, lower, upper):
    """Whether some multiples of 2 pi bring angles (N, m) within limits (m,)."""
    shifted = angles - 2 * np.pi * np.floor((angles - lower) / (2 * np.pi))
    return (shifted <= upper).all(-1)


@pytest.mark.parametrize('chain', LIMBS)
def test_leaves_keep_image_and_lengths(body, random_poses, chain):
    poses = random_poses(body, 40, 1)
    leaves, parents = enumerate_flips(body, poses, chain)
    assert len(leaves) > len(poses)
    places, before = limb_places(body, leaves, chain), limb_places(body, poses, chain)[parents]
    assert on_rays(places, before).max() < 1e-9
    assert np.abs(CAMERA.project(places) - CAMERA.project(before)).max() < 1e-6
    lengths, wanted = (np.linalg.norm(np.diff(x, axis=1), axis=2) for x in (places, before))
    assert np.abs(lengths - wanted).max() < 1e-9
    others = np.setdiff1d(np.arange(body.dimension), body.skeleton.chain_dofs[chain])
    assert np.array_equal(leaves[:, others], poses[parents][:, others])


@pytest.mark.parametrize('chain', LIMBS)
def test_the_pose_is_the_first_of_its_leaves(body, random_poses, chain):
    poses = random_poses(body, 40, 2)
    leaves, parents = enumerate_flips(body, poses, chain)
    assert np.array_equal(np.unique(parents), np.arange(40))
    assert np.all(np.diff(parents) >= 0)
    first = np.searchsorted(parents, np.arange(40))
    assert np.array_equal(leaves[first], poses)


@pytest.mark.parametrize('chain', LIMBS)
def test_leaves_are_distinct(body, random_poses, chain):
    leaves, parents = enumerate_flips(body, random_poses(body, 40, 3), chain)
    places = limb_places(body, leaves, chain)
    for p in range(40):
        own = places[parents == p]
        gaps = np.linalg.norm(own[:, None] - own[None], axis=3).max(2)
        assert gaps[~np.eye(len(own), dtype=bool)].min(initial=1.0) > 1e-7


@pytest.mark.parametrize(('chain', 'links'), [('left_arm', 3), ('right_leg', 3), ('neck', 1)])
def test_a_chain_of_n_links_without_limits_has_the_leaves_of_its_rays(
    small, random_poses, chain, links
):
    free = without_limits(small)
    poses = random_poses(small, 150, 4)
    counts = np.bincount(enumerate_flips(free, poses, chain)[1])
    expected = [expected_leaves(free, pose, chain) for pose in poses]
    assert np.array_equal(counts, [len(leaves) for leaves in expected])
    assert counts.max() == 2**links
    assert (counts == 2**links).sum() > 30
    leaves, parents = enumerate_flips(free, poses, chain)
    assert np.array_equal(np.bincount(parents), counts)
    places = limb_places(free, leaves, chain)[:, 1:]
    for p, wanted in enumerate(expected):
        gaps = np.linalg.norm(places[parents == p][:, None] - np.array(wanted)[None], axis=3).max(2)
        assert gaps.min(0).max() < 1e-6
        assert gaps.min(1).max() < 1e-6


def test_joints_behind_the_camera_are_pruned(small, random_poses):
    """If the camera is inside the sphere of a link, one of two solutions is behind it."""
    free = without_limits(small)
    poses = random_poses(small, 1000, 5)
    poses[:, 2] = 0.35
    places = limb_places(small, poses, 'left_arm')
    reach = np.linalg.norm(np.diff(places, axis=1), axis=2)
    inside = np.linalg.norm(places[:, 0], axis=1) < reach[:, 0]
    in_front = (places[..., 2] > 0.01).all(1)
    chosen = poses[inside & in_front]
    assert len(chosen) > 10
    counts = np.bincount(enumerate_flips(free, chosen, 'left_arm')[1])
    assert np.array_equal(counts, [len(expected_leaves(free, p, 'left_arm')) for p in chosen])
    assert counts.max() <= 4


@pytest.mark.parametrize('chain', ['left_arm', 'right_arm', 'left_leg', 'right_leg'])
def test_limits_leave_the_leaves_that_some_angles_within_them_reach(body, random_poses, chain):
    poses = random_poses(body, 60, 6)
    own = body.skeleton.chain_dofs[chain]
    lower, upper = body.lower[own], body.upper[own]
    leaves, parents = enumerate_flips(body, poses, chain)
    assert (leaves >= body.lower).all()
    assert (leaves <= body.upper).all()
    free, roots = enumerate_flips(without_limits(body), poses, chain)
    mount = body.skeleton.mounts[body.chains[chain][-1]]
    solutions = np.array([angle_solutions(pose[own], mount) for pose in free])
    # All eight give these joint positions, and no others do, up to shifts by 2 pi.
    everything = np.repeat(free, 8, axis=0)
    everything[:, own] = solutions.reshape(-1, 6)
    places = limb_places(body, everything, chain).reshape(len(free), 8, 4, 3)
    assert np.abs(places - places[:, :1]).max() < 1e-9
    reachable = within(solutions, lower, upper).any(1)
    expected = np.bincount(roots[reachable], minlength=60)
    assert np.array_equal(np.bincount(parents, minlength=60), expected)
    assert reachable.sum() < len(free)
    assert expected.max() > 1


def test_narrow_limits_leave_the_pose_alone(small, random_poses):
    (pose,) = random_poses(small, 1, 7)
    s = small.skeleton
    turns = s.dof_is_rotation
    narrow = replace(
        small,
        skeleton=replace(
            s,
            lower=np.where(turns, pose - 1e-3, s.lower),
            upper=np.where(turns, pose + 1e-3, s.upper),
        ),
    )
    for chain in LIMBS:
        leaves, parents = enumerate_flips(narrow, pose, chain)
        assert np.array_equal(leaves, [pose])
        assert np.array_equal(parents, [0])


def test_chains_multiply(body, random_poses):
    poses = random_poses(body, 8, 8)
    chains = ('left_arm', 'neck', 'right_leg')
    leaves, parents = enumerate_flips(body, poses, chains)
    counts = np.array([np.bincount(enumerate_flips(body, poses, c)[1]) for c in chains])
    assert np.array_equal(np.bincount(parents), counts.prod(0))
    assert np.array_equal(leaves[np.searchsorted(parents, np.arange(8))], poses)
    for chain in chains:
        before = limb_places(body, poses, chain)[parents]
        assert on_rays(limb_places(body, leaves, chain), before).max() < 1e-9
    # Every leaf of a chain is combined with all leaves of the others.
    own = body.skeleton.chain_dofs['left_arm']
    alone, roots = enumerate_flips(body, poses, 'left_arm')
    for p in range(8):
        found, times = np.unique(leaves[parents == p][:, own], axis=0, return_counts=True)
        assert np.array_equal(found, np.unique(alone[roots == p][:, own], axis=0))
        assert (times == counts[1:, p].prod()).all()


@pytest.mark.parametrize('chains', ['right_arm', ('left_arm', 'right_arm')])
def test_several_poses_at_once_are_one_by_one(body, random_poses, chains):
    poses = random_poses(body, 12, 9)
    together, parents = enumerate_flips(body, poses, chains)
    alone = [enumerate_flips(body, pose, chains) for pose in poses]
    assert np.array_equal(np.bincount(parents), [len(leaves) for leaves, _ in alone])
    assert np.abs(together - np.concatenate([leaves for leaves, _ in alone])).max() < 1e-12


def test_every_lens_sees_the_flips_alike(small, random_poses):
    poses = random_poses(small, 10, 10)
    lens = (-0.25, 0.06, 0.002, -0.001, 0.01)
    cameras = [
        CAMERA,
        Camera(400.0, 400.0, 320.0, 240.0, 640, 480, lens),
        Camera(300.0, 300.0, 320.0, 240.0, 640, 480, (0.02, -0.01, 0.003, 0.001), 'equidistant'),
    ]
    leaves, parents = enumerate_flips(small, poses, 'left_leg')
    for camera in cameras:
        pixels = camera.project(limb_places(small, leaves, 'left_leg'))
        wanted = camera.project(limb_places(small, poses, 'left_leg'))[parents]
        assert np.abs(pixels - wanted).max() < 1e-6


def test_straight_limbs_keep_their_free_angle(small):
    """With a straight elbow the upper arm's twist is free and does not change."""
    pose = small.prior_mean.copy()
    pose[2] = 3.0
    names = small.dof_names
    pose[[names.index(f'left_{n}') for n in ('elbow', 'wrist_x', 'wrist_y')]] = 0.0
    twist = names.index('left_shoulder_z')
    pose[twist] = 0.4
    pose[names.index('left_shoulder_x')] -= 0.45
    leaves, _ = enumerate_flips(small, pose, 'left_arm')
    places = limb_places(small, leaves, 'left_arm')
    # Near a straight limb, angles are determined only to the square root of rounding errors.
    assert on_rays(places, limb_places(small, pose[None], 'left_arm')).max() < 1e-7
    bend = places[:, 2] - 2 * places[:, 1] + places[:, 0]
    straight = np.abs(leaves[:, names.index('left_elbow')]) < 1e-9
    assert straight.sum() >= 1
    assert np.allclose(leaves[straight, twist], 0.4)
    assert np.linalg.norm(bend[straight], axis=1).max() < 0.06  # the lengths differ by 5.5 cm
    # The solution is computed, not copied from the pose.
    hung, _ = rehang_chain(small, pose[None], pose[None], 'left_arm', slack=1e-9)
    straight = np.abs(hung[:, names.index('left_elbow')]) < 1e-9
    assert straight.sum() >= 1
    assert np.allclose(hung[straight, twist], 0.4)


def test_unknown_and_shared_chains_are_refused(small, random_poses):
    poses = random_poses(small, 1, 11)
    with pytest.raises(KeyError, match=r"no chain 'tail'.*left_arm"):
        enumerate_flips(small, poses, 'tail')
    with pytest.raises(ValueError, match='share segments'):
        enumerate_flips(small, poses, ('left_arm', 'left_arm'))
    with pytest.raises(ValueError, match='must have shape'):
        enumerate_flips(small, poses[:, :-1], 'left_arm')


def test_chains_without_a_closed_form_are_refused(small, random_poses):
    s = small.skeleton
    segment = s.segment_names.index
    chains = {
        'root': (segment('pelvis'),),
        'shin': (segment('left_shin'), segment('left_foot')),
        'gap': (segment('left_thigh'), segment('left_foot')),
    }
    odd = replace(small, skeleton=replace(s, chains=chains))
    for chain in chains:
        with pytest.raises(ValueError, match='no closed form'):
            enumerate_flips(odd, random_poses(small, 1, 12), chain)


@pytest.fixture(scope='module')
def moved_trunk(small, random_poses):
    """Poses, and the same with a trunk that has moved a little."""
    poses = random_poses(small, 40, 13)
    new = poses.copy()
    rng = np.random.default_rng(0)
    new[:, :6] += [0.02, 0.02, 0.05, 0.1, 0.05, 0.05] * rng.normal(size=(40, 6))
    return poses, new


@pytest.mark.parametrize('chain', LIMBS)
def test_rehung_limbs_are_back_on_their_rays(small, moved_trunk, chain):
    poses, new = moved_trunk
    hung, parents = rehang_chain(without_limits(small), poses, new, chain, slack=1e-9)
    own = small.skeleton.chain_dofs[chain]
    others = np.setdiff1d(np.arange(small.dimension), own)
    assert np.array_equal(hung[:, others], new[parents][:, others])
    seen = limb_places(small, poses, chain)[parents]
    places = limb_places(small, hung, chain)
    assert on_rays(places[:, 1:], seen[:, 1:]).max() < 1e-7
    start = limb_places(small, new, chain)[:, 0]
    assert np.abs(places[:, 0] - start[parents]).max() < 1e-12
    before = limb_places(small, poses, chain)
    lengths = np.linalg.norm(np.diff(before[0], axis=0), axis=1)
    expected = [leaves_by_recursion(s, b[1:], lengths) for s, b in zip(start, before)]
    assert np.array_equal(np.bincount(parents, minlength=40), [len(x) for x in expected])
    assert len(hung) > 40


def test_rehung_limbs_stay_within_limits(small, moved_trunk):
    poses, new = moved_trunk
    for chain in LIMBS:
        hung, _ = rehang_chain(small, poses, new, chain)
        own = small.skeleton.chain_dofs[chain]
        assert len(hung) > 10
        assert (hung[:, own] >= small.lower[own]).all()
        assert (hung[:, own] <= small.upper[own]).all()


def test_a_limb_on_the_same_trunk_has_its_flips(small, random_poses):
    poses = random_poses(small, 20, 14)
    for chain in LIMBS:
        hung, roots = rehang_chain(small, poses, poses, chain, slack=1e-9)
        leaves, parents = enumerate_flips(small, poses, chain)
        assert np.array_equal(roots, parents)
        gap = limb_places(small, hung, chain) - limb_places(small, leaves, chain)
        assert np.abs(gap).max() < 1e-6


@pytest.mark.parametrize(('miss', 'found'), [(0.0, 1), (0.04, 1), (0.06, 0)])
def test_rays_that_miss_by_less_than_the_slack_are_touched(small, miss, found):
    """The neck is moved aside until the head's ray misses the sphere by a little."""
    pose = np.zeros(small.dimension)
    pose[2] = 3.0
    free = without_limits(small)
    neck, head = limb_places(free, pose[None], 'neck')[0]
    length = np.linalg.norm(head - neck)
    ray = head / np.linalg.norm(head)
    aside = np.array([1.0, 0.0, 0.0])  # perpendicular to the ray: the head is on the y-z plane
    foot = (neck @ ray) * ray
    new = pose.copy()
    new[:3] += foot - neck + (length + miss) * aside
    hung, parents = rehang_chain(free, pose[None], new[None], 'neck', slack=0.05)
    # There is one solution, because the ray touches the sphere.
    assert len(hung) == len(parents) == found
    if found:
        moved_neck, moved_head = limb_places(free, hung[:1], 'neck')[0]
        assert np.allclose(moved_neck, foot + (length + miss) * aside, atol=1e-12)
        # The head is as near to its ray as possible: on the perpendicular, at its length.
        assert np.allclose(moved_head, foot + miss * aside, atol=1e-7)


@pytest.mark.parametrize(('chain', 'other'), [('left_leg', 'right_leg'), ('right_arm', 'left_arm')])
def test_limbs_take_the_image_of_others(small, random_poses, chain, other):
    poses = random_poses(small, 60, 15)
    hung, parents = rehang_chain(
        without_limits(small), poses, poses, chain, image_of=other, slack=1e-9
    )
    seen, start = limb_places(small, poses, other), limb_places(small, poses, chain)[:, 0]
    places = limb_places(small, hung, chain)
    assert on_rays(places[:, 1:], seen[parents][:, 1:]).max() < 1e-7
    lengths = np.linalg.norm(np.diff(seen[0], axis=0), axis=1)
    expected = [leaves_by_recursion(s, b[1:], lengths) for s, b in zip(start, seen)]
    assert np.array_equal(np.bincount(parents, minlength=60), [len(x) for x in expected])
    assert len(hung) > 10


def test_no_poses_have_no_flips():
    leaves, parents = enumerate_flips(load_body('human32'), np.empty((0, 32)), 'left_arm')
    assert leaves.shape == (0, 32)
    assert parents.shape == (0,)


def test_no_slack_means_none():
    body = load_body('human32')
    pose = np.array(body.prior_mean)[None]
    pose[0, 2] = 3.0
    new = pose.copy()
    new[0, 3] += 0.2
    hung, _ = rehang_chain(body, pose, new, 'left_arm', slack=0.0)
    which = body.skeleton.joint_index(['left_elbow', 'left_wrist', 'left_hand'])
    seen, found = (body.joint_positions(x)[:, which] for x in (pose, hung))
    sines = np.linalg.norm(np.cross(found, seen), axis=2) / 9.0
    assert sines.max(initial=0.0) < 1e-9
