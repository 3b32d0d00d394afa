"""Overlap of body parts, compared with geometry, closed forms and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.self_intersection import self_intersection_energy
from hmt_ros.body import Body, load_body
from hmt_ros.body.body import PartShape
from hmt_ros.body.kinematics import forward
from hmt_ros.body.self_intersection import (
    TOLERANCE,
    SelfIntersection,
)
from test.oracles import single_terms

SIGMA = 0.03


@pytest.fixture(scope='module', params=['human37', 'human32'])
def body(request) -> Body:
    return load_body(request.param)


@pytest.fixture(scope='module')
def small() -> Body:
    return load_body('human32')


def energy_of(body, poses, sigma=SIGMA):
    found = single_terms.energy_of(SelfIntersection(body, sigma), body, poses)
    assert np.array_equal(found.value, self_intersection_energy(body, poses, sigma=sigma))
    return found


def with_round_parts(body):
    """The body with circular cross-sections, for which the overlap has the simple gradient."""
    shapes = []
    for shape in body.shapes:
        mean = 0.5 * (shape.radii[0] + shape.radii[1])
        shapes.append(replace(shape, radii=(mean, mean, *shape.radii[2:])))
    return replace(body, shapes=tuple(shapes))


def folded(body, count, seed, random_poses):
    """Poses with limbs anywhere, many through the trunk or each other."""
    poses = random_poses(body, count, seed)
    poses[:, :3] = [0.1, -0.1, 3.0]
    return poses


def shortest(w, u, v):
    """The shortest w + s u - t v over the square -1 <= s, t <= 1: inside it or on a side of it."""
    inside = np.linalg.lstsq(np.stack([u, -v], axis=1), -w, rcond=None)[0]
    candidates = [inside] if np.abs(inside).max() <= 1 else []
    for end in (-1.0, 1.0):
        candidates.append((end, np.clip((w + end * u) @ v / max(v @ v, 1e-12), -1, 1)))
        candidates.append((np.clip((end * v - w) @ u / max(u @ u, 1e-12), -1, 1), end))
    gaps = [w + s * u - t * v for s, t in candidates]
    return min(gaps, key=np.linalg.norm)


def overlap(body, pose, i, j):
    """Overlap of two parts, m: sum of their radii minus the distance of their axes."""
    frames = forward(body.skeleton, pose[None])
    rotations = frames.rotations()[0]
    ends, turns, radii = [], [], []
    for part in (body.flesh.parts[i], body.flesh.parts[j]):
        turn = rotations[part.segment]
        middle = frames.origins[part.segment, :, 0] + turn @ np.array(part.centre)
        radius = 0.5 * (part.radii[0] + part.radii[1])
        ends.append((middle, turn[:, 2] * max(part.radii[2] - radius, 0.0)))
        turns.append(turn)
        radii.append(np.array([*part.radii[:2], radius]))
    (p, u), (q, v) = ends
    gap = shortest(p - q, u, v)
    distance = np.linalg.norm(gap)
    way = gap / distance
    reach = [np.linalg.norm(r * (turn.T @ way)) for turn, r in zip(turns, radii)]
    return sum(reach) - distance


def pairs_of(body):
    """Pairs of parts that are not neighbours and do not touch in the mean pose."""
    parts = body.flesh.parts
    carried = {p.segment for p in parts}

    def neighbour(s):
        s = body.skeleton.parents[s]
        while s >= 0 and s not in carried:
            s = body.skeleton.parents[s]
        return s

    rest = body.prior_mean.copy()
    rest[:3] = 0.0
    return [
        (i, j)
        for i in range(len(parts))
        for j in range(i)
        if neighbour(parts[i].segment) != parts[j].segment
        and neighbour(parts[j].segment) != parts[i].segment
        and overlap(body, rest, i, j) < TOLERANCE
    ]


def plain_energy(body, pose, pairs, sigma=SIGMA):
    depths = np.array([overlap(body, pose, i, j) for i, j in pairs])
    return 0.5 * (np.maximum(depths - TOLERANCE, 0.0) ** 2).sum() / sigma**2


def test_value_is_the_sum_over_pairs(body, random_poses):
    poses = folded(body, 6, 0, random_poses)
    pairs = pairs_of(body)
    assert len(pairs) > 40
    found, _, _ = energy_of(body, poses)
    wanted = np.array([plain_energy(body, pose, pairs) for pose in poses])
    assert (wanted > 0.1).sum() >= 2
    assert np.allclose(found, wanted, rtol=1e-9, atol=1e-9)


def test_gradient_and_hessian_are_those_of_the_overlaps(small, random_poses):
    """With round parts only the distance changes; checked by differences and squared slopes."""
    body = with_round_parts(small)
    poses = folded(body, 40, 1, random_poses)
    value, gradient, hessian = energy_of(body, poses)
    assert (value > 0.1).sum() >= 15
    step = 1e-6
    slopes = np.empty_like(gradient)
    for j, change in enumerate(step * np.eye(body.dimension)):
        slopes[:, j] = energy_of(body, poses + change)[0] - energy_of(body, poses - change)[0]
    slopes /= 2 * step
    assert np.abs(gradient - slopes).max() < 1e-6 * np.abs(slopes).max()
    pairs = pairs_of(body)
    for n in np.flatnonzero(value > 0.1)[:2]:
        depths = np.array([overlap(body, poses[n], i, j) for i, j in pairs])
        wanted = np.zeros(hessian[n].shape)
        for i, j in (pair for pair, depth in zip(pairs, depths) if depth > TOLERANCE):
            row = np.array(
                [
                    overlap(body, poses[n] + change, i, j) - overlap(body, poses[n] - change, i, j)
                    for change in 1e-5 * np.eye(body.dimension)
                ]
            ) / (2e-5 * SIGMA)
            wanted += np.outer(row, row)
        assert np.abs(hessian[n] - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_the_gradient_points_uphill(body, random_poses):
    """Elliptic sections also turn a little; a small step downhill reduces the overlap."""
    poses = folded(body, 60, 2, random_poses)
    value, gradient, _ = energy_of(body, poses)
    some = value > 0.1
    step = 1e-4 * gradient[some] / np.linalg.norm(gradient[some], axis=1)[:, None]
    assert (energy_of(body, poses[some] - step)[0] < value[some]).all()
    assert (energy_of(body, poses[some] + step)[0] > value[some]).all()


def test_two_balls_by_hand(small, random_poses):
    """Balls at the wrists: depth, gradient and Hessian follow from the wrists' Jacobians."""
    radius = 0.12
    segments = [small.skeleton.segment_names.index(f'{side}_hand') for side in ('left', 'right')]
    balls = tuple(PartShape(s, None, (0.0, 0.0, 0.0), (radius,) * 3) for s in segments)
    body = replace(small, shapes=balls, growth=())
    poses = folded(body, 2000, 6, random_poses)
    wrists = body.skeleton.joint_index(['left_wrist', 'right_wrist'])
    places = body.joint_positions(poses)[:, wrists]
    distance = np.linalg.norm(places[:, 0] - places[:, 1], axis=1)
    depth = np.maximum(2 * radius - distance - TOLERANCE, 0.0)
    assert (depth > 0).sum() >= 20
    assert (depth == 0).sum() >= 20
    value, gradient, hessian = energy_of(body, poses)
    assert np.allclose(value, 0.5 * depth**2 / SIGMA**2, rtol=1e-9, atol=1e-12)
    jacobians = body.joint_jacobians(poses)[:, wrists]
    way = (places[:, 0] - places[:, 1]) / distance[:, None]
    slopes = -np.einsum('nx,nxd->nd', way, jacobians[:, 0] - jacobians[:, 1])
    assert np.allclose(gradient, depth[:, None] * slopes / SIGMA**2, atol=1e-8)
    squares = (depth > 0)[:, None, None] * slopes[:, :, None] * slopes[:, None, :] / SIGMA**2
    assert np.allclose(hessian, squares, atol=1e-8)


def test_a_skeleton_without_flesh_costs_nothing(small, random_poses):
    bare = replace(small, shapes=(), growth=())
    assert np.array_equal(self_intersection_energy(bare, random_poses(small, 3, 8)), np.zeros(3))
