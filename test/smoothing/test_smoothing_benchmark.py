"""The benchmark of the smoother runs, and what it compares is comparable."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import smoothing
from benchmarks.arm_waving import waving
from benchmarks.exact_smoothing import (
    divergence,
    enumerated,
    grid_marginals,
    modes,
    particle_marginals,
)
from benchmarks.smoothing_peers import gtsam_missing, gtsam_trajectory, scipy_trajectory
from hmt_ros.smoothing import LinearGaussianDynamics
from hmt_ros.smoothing.trajectory_refinement import refine

WALK = LinearGaussianDynamics.random_walk([1.0])


def test_grid_and_enumeration_agree():
    mixtures = modes('overlapping', 0, 5, dimension=1)
    points = np.linspace(-15, 15, 801)
    for density, exact in zip(grid_marginals(mixtures, WALK, points), enumerated(mixtures, WALK)):
        np.testing.assert_allclose(
            density, np.exp(exact.log_density(points[:, None])), atol=1e-4 * density.max()
        )


def test_the_particle_smoother_comes_close_where_it_has_time():
    mixtures = modes('overlapping', 0, 5, dimension=1)
    exact = enumerated(mixtures, WALK)
    rng = np.random.default_rng(0)
    found = particle_marginals(mixtures, WALK, 0.3, 0)
    assert np.mean([divergence(p, q.log_density, rng, 500) for p, q in zip(exact, found)]) < 0.05


def test_all_solvers_meet_at_the_same_energy():
    sequence, variances, start = smoothing.robust_problem(8)
    dynamics = LinearGaussianDynamics.random_walk(variances)
    prior = dynamics.prior(np.ones(7))
    found = refine(start[None], prior, sequence)
    ours = found.energies[0] - prior.constant
    assert scipy_trajectory(sequence, variances, start)[0] == pytest.approx(ours, rel=1e-5)
    reason = gtsam_missing()
    if reason:
        pytest.skip(reason)
    assert gtsam_trajectory(sequence, variances, start)[0] == pytest.approx(ours, rel=1e-5)


def test_the_waving_person_has_eight_modes_that_merge_at_times():
    sequence = waving(12)
    assert [len(mixture) for mixture in sequence.mixtures] == [8] * 12
    values = np.linalg.eigvalsh(sequence.mixtures[0].covariances[0])
    assert values[-1] / values[0] == pytest.approx(4900)
    assert ((sequence.truth >= sequence.lower) & (sequence.truth <= sequence.upper)).all()


def test_longer_windows_are_better_conditioned():
    found = smoothing.relations(9)
    ratios = list(found['eigenvalue_ratio'].values())
    assert ratios == sorted(ratios, reverse=True)
    assert found['free_energy_end'] <= found['free_energy_start']
    assert found['roughness_ratio'] < 1


def test_report(monkeypatch, capsys):
    monkeypatch.setattr(smoothing, 'peak_memory_apart', lambda times: 1e8)
    assert smoothing.main(['--quick', '--json']) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result['exactness']) == {'separated', 'overlapping'}
    text = smoothing.as_text(result)
    assert 'faster than scipy' in text
