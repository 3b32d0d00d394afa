"""Learning of dynamics from motions with known dynamics."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.training.motion_learning import learned_motion, modelled_moments
from hmt_ros.body.mirror import mirror
from hmt_ros.inference.damped_velocity import DampedVelocity

RATE = 30.0


def simulated(dynamics: DampedVelocity, times: int, seed: int) -> np.ndarray:
    """Poses (times, d) of one motion."""
    rng = np.random.default_rng(seed)
    d = dynamics.dimension
    a, q = dynamics.transition(1 / RATE)
    noise = rng.normal(size=(times, 2 * d)) @ np.linalg.cholesky(q).T
    states = np.zeros((times, 2 * d))
    states[0, d:] = np.linalg.cholesky(dynamics.unknown_velocity) @ rng.normal(size=d)
    for t in range(1, times):
        states[t] = a @ states[t - 1] + noise[t]
    return states[:, :d]


@pytest.fixture(scope='module')
def truth(human32) -> DampedVelocity:
    """Damping 2 to 8 per second, coupled as mirror images and translations allow."""
    d = human32.dimension
    root = np.random.default_rng(2).normal(size=(d, d)) / np.sqrt(d)
    noise = 6.0 * (root @ root.T + 0.5 * np.eye(d))
    matrix = mirror(human32, np.eye(d))
    noise = 0.5 * (noise + matrix.T @ noise @ matrix)
    noise[:3, :] = noise[:, :3] = 0.0
    noise[[0, 1, 2], [0, 1, 2]] = 2.0
    damping = np.full(d, 4.0)
    damping[:3], damping[3] = 2.0, 8.0
    return DampedVelocity.of(damping, noise, np.full(d, 1e-4))


def test_the_dynamics_of_simulated_motions_are_found(human32, truth):
    motions = [simulated(truth, 1500, seed) for seed in range(8)]
    learned = learned_motion(human32, motions, RATE, 'simulated')
    assert learned.card == 'simulated'
    d = human32.dimension
    # Displacements are limited, which loses some of the variance.
    ratio = np.diagonal(learned.dynamics.unknown_velocity) / np.diagonal(truth.unknown_velocity)
    assert np.abs(np.log(ratio)).max() < 0.25
    assert np.abs(np.log(learned.damping / truth.damping)).max() < 0.4
    noise = truth.diffusion[d:, d:]

    def correlation(x: np.ndarray) -> np.ndarray:
        size = np.sqrt(np.diagonal(x))
        return x / np.outer(size, size)

    off = correlation(learned.diffusion) - correlation(noise)
    assert np.abs(off).max() < 0.08


def test_what_is_learned_is_its_own_mirror_image(human32, truth):
    learned = learned_motion(human32, [simulated(truth, 400, 0)], RATE)
    d = human32.dimension
    matrix = mirror(human32, np.eye(d))
    np.testing.assert_allclose(matrix.T @ learned.diffusion @ matrix, learned.diffusion, atol=1e-9)
    np.testing.assert_allclose(np.abs(matrix).T @ learned.damping, learned.damping)


def test_a_turn_of_the_heading_changes_nothing(human32, truth):
    motion = simulated(truth, 400, 0)
    turned = motion.copy()
    turned[:, human32.skeleton.dof_index(('root_z',))] += 1.0
    turned[:, :3] += [1.0, 0.2, -3.0]
    a, b = (learned_motion(human32, [x], RATE) for x in (motion, turned))
    # Within the optimiser's tolerance.
    np.testing.assert_allclose(a.diffusion, b.diffusion, rtol=1e-3, atol=1e-9)


def test_moments_are_those_of_the_transition(truth):
    interval = 0.1
    d = truth.dimension
    stationary = np.diagonal(truth.unknown_velocity)
    var, cov = modelled_moments(interval, truth.damping, stationary, 1e-4)
    a, q = truth.transition(interval)
    move = a[:d, d:]
    np.testing.assert_allclose(
        var, np.diagonal(move @ truth.unknown_velocity @ move.T + q[:d, :d]), rtol=1e-9
    )
    later = move @ (a[d:, d:] @ truth.unknown_velocity @ move.T + q[d:, :d])
    np.testing.assert_allclose(cov, np.diagonal(later), rtol=1e-9)
