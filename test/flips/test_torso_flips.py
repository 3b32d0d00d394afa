"""Flips of the torso: lines mirrored at rays; lengths and images by plain geometry."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Body, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.flips.torso_flips import flip_torso

TORSO = ('pelvis', 'neck', 'left_hip', 'right_hip', 'left_shoulder', 'right_shoulder')
# whether hips turn, the trunk leans the other way, shoulders turn
FLIPS = list(itertools.product((False, True), repeat=3))[1:]


@pytest.fixture(scope='module', params=['human37', 'human34', 'human32'])
def body(request) -> Body:
    return load_body(request.param)


@pytest.fixture(scope='module')
def twisting() -> Body:
    """A body whose trunk has all motions needed by a flip."""
    return load_body('human37')


def torso_of(body, poses):
    """Joints of the torso (6, N, 3)."""
    which = body.skeleton.joint_index(TORSO)
    return body.joint_positions(poses)[:, which].transpose(1, 0, 2)


def turned_people(body, count, seed):
    """Poses that are neither in profile nor frontal, trunks leaning a little, limbs anywhere."""
    rng = np.random.default_rng(seed)
    poses = np.clip(rng.normal(0, 0.3, (count, body.dimension)), body.lower, body.upper)
    poses[:, :3] = [0.3, -0.2, 3.0] + 0.3 * rng.normal(size=(count, 3))
    names = body.dof_names
    poses[:, names.index('root_z')] = rng.choice([-1, 1], count) * rng.uniform(0.35, 0.6, count)
    for name in names:
        if 'clavicle' in name:
            poses[:, names.index(name)] = 0.0
        elif name.startswith('trunk') or name in ('root_x', 'root_y'):
            poses[:, names.index(name)] = rng.uniform(-0.2, 0.2, count)
    return poses


def mirrored_in_depth(line, at):
    """A line (3,) with its component along the ray to a point reversed."""
    ray = at / np.linalg.norm(at)
    return line - 2 * (line @ ray) * ray


def starts_of(body, pose):
    """Start (3,) of the trunk of a pose (d,)."""
    trunk = body.skeleton.segment_names.index('trunk')
    return forward(body.skeleton, pose[None]).origins[trunk, :, 0]


def complete(body, count=60, seed=0):
    """Poses with all seven flips, and the flips (N, 7, d)."""
    poses = turned_people(body, count, seed)
    flips, parents = flip_torso(body, poses)
    all_seven = np.flatnonzero(np.bincount(parents, minlength=count) == 7)
    assert len(all_seven) >= 3
    return poses[all_seven], np.array([flips[parents == p] for p in all_seven])


def test_all_choices_on_a_body_that_twists(twisting):
    poses, flips = complete(twisting)
    before = torso_of(twisting, poses)
    after = torso_of(twisting, flips.reshape(-1, twisting.dimension))
    after = after.reshape(6, *flips.shape[:2], 3)
    assert np.allclose(after[0], before[0][:, None], atol=1e-12)
    for n, (i, (hips, lean, shoulders)) in itertools.product(range(len(poses)), enumerate(FLIPS)):
        pelvis, neck, left_hip, right_hip, left_shoulder, right_shoulder = before[:, n]
        new = after[:, n, i]
        wanted = right_hip - left_hip
        if hips:
            wanted = mirrored_in_depth(wanted, pelvis)
        assert np.allclose(new[3] - new[2], wanted, atol=1e-9)
        # The neck is at one of the two intersections of its ray with the trunk's sphere.
        ray = neck / np.linalg.norm(neck)
        assert np.linalg.norm(np.cross(new[1], ray)) < 1e-9
        start, moved = starts_of(twisting, poses[n]), starts_of(twisting, flips[n, i])
        behind = (neck - (ray @ start) * ray) @ ray > 0
        assert ((new[1] - (ray @ moved) * ray) @ ray > 0) == (behind != lean)
        if not hips:
            nearest = (ray @ start) * ray
            assert np.allclose(new[1], 2 * nearest - neck if lean else neck, atol=1e-9)
        # The shoulders turn to the wanted line as far as the trunk's direction allows.
        wanted = right_shoulder - left_shoulder
        if shoulders:
            wanted = mirrored_in_depth(wanted, neck)
        up = (new[1] - moved) / np.linalg.norm(new[1] - moved)
        across = wanted - (wanted @ up) * up
        found = new[5] - new[4]
        assert np.allclose(np.cross(found, across), 0.0, atol=1e-9)
        assert found @ across > 0


def test_lengths_and_other_degrees_of_freedom_stay(body):
    poses = turned_people(body, 40, 1)
    flips, parents = flip_torso(body, poses)
    assert len(flips) > 0
    names = body.dof_names
    torso = [i for i, n in enumerate(names) if n in ('root_x', 'root_y', 'root_z') or 'trunk' in n]
    others = np.setdiff1d(np.arange(body.dimension), torso)
    assert np.array_equal(flips[:, others], poses[parents][:, others])
    assert (flips >= body.lower).all()
    assert (flips <= body.upper).all()
    assert (np.diff(parents) >= 0).all()
    assert np.bincount(parents).max() <= 7


def test_the_torso_moves_in_depth_and_hardly_in_the_image(body):
    """Mirrored lines have the same foreshortening; the neck is on its ray."""
    poses = turned_people(body, 40, 2)
    poses[:, 2] += 5.0
    flips, parents = flip_torso(body, poses)
    before, after = torso_of(body, poses)[:, parents], torso_of(body, flips)
    if body.name != 'human34':  # its shoulders turn only with the trunk
        shift = np.abs(after[..., 2] - before[..., 2]).max(0)
        assert shift.min() > 0.03
    hips, shoulders = slice(2, 4), slice(4, 6)
    for pair in (hips, shoulders) if body.name == 'human37' else (hips,):
        rays = (x[pair, :, :2] / x[pair, :, 2:] for x in (before, after))
        gap = np.linalg.norm(np.subtract(*rays), axis=2)
        assert np.median(gap) < 0.004
    image_of_neck = (x[1, :, :2] / x[1, :, 2:] for x in (before, after))
    gap = np.linalg.norm(np.subtract(*image_of_neck), axis=1)
    if body.name != 'human32':
        # The trunk does not start at the pelvis, whose rotation can make it miss the ray.
        assert np.median(gap) < 1e-9
        assert gap.max() < 2e-3


def test_a_body_whose_trunk_leans_but_does_not_twist():
    body = load_body('human34')
    poses = turned_people(body, 40, 3)
    flips, parents = flip_torso(body, poses)
    before, after = torso_of(body, poses)[:, parents], torso_of(body, flips)
    for old, new in zip(before.transpose(1, 0, 2), after.transpose(1, 0, 2)):
        line = old[3] - old[2]
        mirrored = mirrored_in_depth(line, old[0])
        gaps = [np.abs(new[3] - new[2] - x).max() for x in (line, mirrored)]
        assert min(gaps) < 1e-9
        assert np.linalg.norm(np.cross(new[1], old[1])) < 0.02


def test_a_rigid_torso_turns_only():
    body = load_body('human32')
    poses = turned_people(body, 20, 4)
    flips, parents = flip_torso(body, poses)
    assert np.array_equal(parents, np.arange(20))
    before, after = torso_of(body, poses), torso_of(body, flips)
    for n in range(20):
        wanted = mirrored_in_depth(before[3, n] - before[2, n], before[0, n])
        assert np.allclose(after[3, n] - after[2, n], wanted, atol=1e-9)
    # Pairwise distances of a rigid torso are constant.
    gaps = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (before, after)]
    assert np.allclose(*gaps, atol=1e-12)


def test_flipping_back_gives_the_torso_again(twisting):
    """Mirroring twice is the identity, for the line of the hips and for the neck."""
    poses, flips = complete(twisting, seed=5)

    def lines(poses):
        pelvis, neck, left_hip, right_hip, left_shoulder, right_shoulder = torso_of(twisting, poses)
        return np.stack([pelvis, neck, right_hip - left_hip, left_shoulder, right_shoulder])

    before = lines(poses)
    for flip, same in (((True, False, False), [0, 2]), ((False, True, False), [0, 1, 2])):
        for n, flipped in enumerate(flips[:, FLIPS.index(flip)]):
            assert np.abs(lines(flipped[None]) - before[:, n, None])[same].max() > 0.03
            back, _ = flip_torso(twisting, flipped)
            gaps = np.abs(lines(back) - before[:, n, None])[same]
            assert gaps.max(axis=(0, 2)).min() < 1e-9


def test_a_torso_across_the_line_of_sight_has_no_flips(twisting):
    """At a large distance rays are parallel, and an upright frontal torso has no depth."""
    pose = np.zeros(twisting.dimension)
    pose[1:3] = 0.215, 20.0
    assert len(flip_torso(twisting, pose)[0]) == 0
    pose[twisting.dof_names.index('root_z')] = 0.5
    flips, parents = flip_torso(twisting, pose)
    assert len(flips) >= 3
    assert (parents == 0).all()


def test_narrow_limits_leave_no_flips(twisting):
    poses = turned_people(twisting, 1, 6)
    s = twisting.skeleton
    turns = s.dof_is_rotation
    lower = np.where(turns, poses[0] - 1e-3, s.lower)
    upper = np.where(turns, poses[0] + 1e-3, s.upper)
    narrow = replace(twisting, skeleton=replace(s, lower=lower, upper=upper))
    assert len(flip_torso(twisting, poses)[0]) > 0
    assert len(flip_torso(narrow, poses)[0]) == 0


def test_several_poses_at_once_are_one_by_one(body):
    poses = turned_people(body, 12, 7)
    together, parents = flip_torso(body, poses)
    alone = [flip_torso(body, pose)[0] for pose in poses]
    assert np.array_equal(np.bincount(parents, minlength=12), [len(x) for x in alone])
    assert np.abs(together - np.concatenate(alone)).max() < 1e-12


def test_bodies_without_a_torso_have_no_flips(twisting):
    s = twisting.skeleton
    renamed = replace(s, joint_names=tuple(x.replace('neck', 'collar') for x in s.joint_names))
    flips, parents = flip_torso(replace(twisting, skeleton=renamed), turned_people(twisting, 3, 8))
    assert flips.shape == (0, twisting.dimension)
    assert parents.shape == (0,)


def test_flips_of_a_torso_that_does_not_twist_are_distinct():
    body = load_body('human34')
    pose = np.zeros((1, 34))
    pose[0, 2], pose[0, 3], pose[0, 6] = 3.0, 0.5, -0.3
    flips, _ = flip_torso(body, pose)
    everything = np.concatenate([pose, flips])
    gaps = np.abs(everything[:, None] - everything[None]).max(2)
    assert gaps[~np.eye(len(everything), dtype=bool)].min() > 1e-6
