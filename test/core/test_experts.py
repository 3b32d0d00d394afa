"""Inputs of experts from windows of keypoints, and other bone lengths, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.core import fill_window_inputs, resize_bones, window_middles
from hmt_ros.experts.pose_encoding import ray_rotations
from test.core.arguments import assert_arguments_are_checked

N, S, L, P = 4, 3, 7, 2
TRUNK = np.array([1, 2, 4])
LEAST = 0.1


def windows(seed=0):
    rng = np.random.default_rng(seed)
    confidences = rng.random((N, S, L)) * (rng.random((N, S, L)) < 0.6)
    confidences[0, 0, TRUNK[1:]] = 0.0
    wanted = np.array([0.0, -0.1, -0.3])
    ups, persons = rng.normal(size=(N, 3)), rng.normal(size=(N, P))
    ups[1], persons[2] = 0.0, 0.0
    return {
        'rays': 0.3 * rng.normal(size=(N, S, L, 2)),
        'confidences': confidences,
        'times': wanted + 0.02 * rng.normal(size=(N, S)),
        'wanted': wanted,
        'ups': ups,
        'persons': persons,
        'axes': ray_rotations(np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(N, 3))),
        'least_confidence': LEAST,
        'values': np.empty((N, 3 * S * L + 2 * S + 6 + P), np.float32),
    }


def expected(rays, confidences, times, wanted, ups, persons, axes, least_confidence, values):
    sure = np.where(confidences >= least_confidence, confidences, 0.0)
    there = sure.max(2) > 0
    seen = np.concatenate([rays, np.ones((N, S, L, 1))], axis=3) @ axes[:, None].swapaxes(2, 3)
    places = seen[..., :2] / np.maximum(seen[..., 2:], 0.1) * (sure > 0)[..., None]
    square = (sure[:, 0] * (places[:, 0] ** 2).sum(2)).sum(1)
    extent = np.sqrt(square / np.maximum(sure[:, 0].sum(1), 0.1)) + 1e-6
    parts = [
        np.clip(places / extent[:, None, None, None], -6.0, 6.0),
        sure,
        there,
        20.0 * (times - wanted) * there,
        np.log(extent) + 2.0,
        np.einsum('nij,nj->ni', axes, ups),
        ups.any(1),
        5.0 * persons,
        persons.any(1),
    ]
    return np.concatenate([x.reshape(N, -1) for x in parts], axis=1)


def test_middles_are_those_of_the_trunk():
    given = {k: v for k, v in windows().items() if k in ('rays', 'confidences')}
    given |= {'trunk': TRUNK, 'least_confidence': LEAST, 'middles': np.empty((N, 3))}
    window_middles(*given.values())
    for rays, confidences, middle in zip(given['rays'], given['confidences'], given['middles']):
        weight = np.where(confidences[0] >= LEAST, confidences[0], 0.0)
        if (weight[TRUNK] > 0).sum() >= 2:
            weight *= np.isin(np.arange(L), TRUNK)
        wanted = weight @ rays[0] / (weight.sum() + 1e-9)
        np.testing.assert_allclose(middle, [*wanted, 1.0])
    assert_arguments_are_checked(window_middles, given, 'middles', free='trunk')


def test_inputs_are_those_of_numpy():
    for seed in range(5):
        given = windows(seed)
        fill_window_inputs(*given.values())
        np.testing.assert_allclose(given['values'], expected(**given), rtol=1e-6, atol=1e-6)
    assert_arguments_are_checked(fill_window_inputs, windows(), 'values')


def test_bones_keep_their_directions():
    rng = np.random.default_rng(1)
    order = np.array([[2, -1], [0, 2], [1, 0], [3, -1]])
    joints, factors = rng.normal(size=(5, 4, 3)), rng.random(4)
    named = {'order': order, 'factors': factors, 'joints': joints, 'result': np.empty((5, 4, 3))}
    resize_bones(*named.values())
    for joint, carrier in order:
        old, new = (
            x[:, joint] - (x[:, carrier] if carrier >= 0 else 0.0)
            for x in (joints, named['result'])
        )
        np.testing.assert_allclose(new, factors[joint] * old, atol=1e-12)
    assert_arguments_are_checked(resize_bones, named, 'result', free='joints')
    with pytest.raises(ValueError, match='after those that they hang on'):
        resize_bones(order[::-1].copy(), factors, joints, named['result'])
