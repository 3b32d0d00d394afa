"""The benchmark of the smoother runs, and what it compares is comparable."""

from __future__ import annotations

import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import smoothing, smoothing_clips
from benchmarks.arm_waving import waving
from benchmarks.exact_smoothing import (
    divergence,
    enumerated,
    grid_marginals,
    modes,
    particle_marginals,
)
from benchmarks.machine import best_time
from benchmarks.smoothing_peers import gtsam_missing, gtsam_trajectory, scipy_trajectory
from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother
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


@pytest.fixture(scope='module')
def related():
    return smoothing.relations(5)


def test_longer_windows_are_better_conditioned(related):
    found = related
    ratios = list(found['eigenvalue_ratio'].values())
    assert ratios == sorted(ratios, reverse=True)
    assert found['free_energy_fall'] > 0.1
    assert found['share_of_fall_within_8'] > 0.6
    assert found['roughness_ratio'] < 1


def test_report(related, monkeypatch, capsys):
    monkeypatch.setattr(smoothing, 'relations', lambda times: related)
    monkeypatch.setattr(smoothing, 'best_time', partial(best_time, least=1))
    few = partial(MixtureSmoother, max_trajectories=8)
    monkeypatch.setattr(smoothing, 'MixtureSmoother', few)
    monkeypatch.setattr(smoothing, 'peak_memory_apart', lambda work, times: 1e8)
    monkeypatch.setattr(smoothing, 'clips', lambda quick: 'skipped: not here')
    assert smoothing.main(['--quick', '--json']) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result['exactness']) == {'separated', 'overlapping'}
    text = smoothing.as_text(result)
    assert 'faster than scipy' in text
    assert 'clips: skipped' in text


def test_clips_are_skipped_where_they_are_absent(monkeypatch, tmp_path):
    def absent(folder, *, moving):
        raise ValueError('no clips here')

    monkeypatch.setattr(smoothing_clips, 'find_clips', absent)
    assert smoothing_clips.clips() == 'skipped: no clips here'


def test_likelihoods_are_smoothed_live_and_together():
    """Independent errors of still poses average out, of later ones most."""
    body = load_body('human37')
    rng = np.random.default_rng(0)
    pose, spread = body.prior_mean, 0.05
    unknown = np.zeros((body.dimension, body.dimension))
    seen = []
    for t in range(12):
        near = pose + spread * rng.normal(size=(2, body.dimension))
        mixture = GaussianMixture(
            np.array([0.6, 0.4]), near, np.tile(spread**2 * np.eye(body.dimension), (2, 1, 1))
        )
        stamp = 33_000_000 * (t + 1)
        seen.append(
            smoothing_clips.Seen(stamp, body, mixture, mixture, CueErrors(1.0, 0.0), unknown, pose)
        )
    found = smoothing_clips.smoothed(seen)
    live, offline = found['live'], found['offline']
    assert list(live) == list(offline) == [x.stamp for x in seen]
    first = seen[0].stamp

    def error(mixture):
        return np.abs(mixture.means[mixture.weights.argmax()] - pose).mean()

    assert error(offline[first]) < error(seen[0].likelihood)
    assert error(live[first]) < error(seen[0].likelihood)
    assert all(len(x) <= smoothing_clips.COMPONENTS for x in offline.values())


def test_the_kernel_that_is_best_in_the_mean_is_shown():
    ways = ('AVERAGED', 'MEAN', 'NEAREST')
    numbers = dict.fromkeys((*smoothing_clips.SCORES, smoothing_clips.MODES), 1.0)
    names = [
        f'{getattr(smoothing_clips, way)} over {width} images' for way in ways for width in (1, 2)
    ]
    plain = dict.fromkeys(
        ('filter', 'live', 'offline', 'one path, smoothed', 'point estimate', 'Viterbi path'),
        numbers,
    )
    one = plain | dict.fromkeys(names, numbers) | {names[0]: numbers | {'heaviest_mm': 5.0}}
    other = plain | dict.fromkeys(names, numbers) | {names[1]: numbers | {'heaviest_mm': 4.0}}
    found = smoothing_clips.mean([one, other])
    assert list(found) == [*plain, names[1], names[2], names[4]]
    assert found[names[1]]['heaviest_mm'] == 2.5
    entry = {'clips': 'all', 'inputs': 'images', 'gravity': 'given', 'rate': 0.0, 'scores': found}
    low = entry | {'rate': 3.0}
    rows = smoothing_clips.error_rows({'means': [entry, low]})
    assert [len(row) for row in rows] == [12] * 4
    assert rows[2][:4] == ['images', 'given', 'all', '1.0']
    assert rows[3][2] == '3'
    rows = smoothing_clips.motion_rows({'means': [entry, low]})
    assert [len(row) for row in rows] == [10] * 5


def record(joints, weights, true):
    """Of joints (T, K, 3) that lie on a line, besides a pelvis at the origin."""
    t, k = np.shape(joints)[:2]
    some = np.zeros((t, k, 2, 3))
    some[:, :, 1, 0] = joints
    truth = np.zeros((t, 2, 3))
    truth[:, 1, 0] = true
    return SimpleNamespace(joints=some, weights=np.array(weights), true=truth)


def test_paths_through_modes():
    """The heavier mode jumps for one image; the truth is with the lighter one there."""
    joints = [[0.0, 0.4], [0.02, 0.4], [0.41, 0.0], [0.01, 0.4]]
    one = record(joints, [[0.9, 0.1]] * 4, [0.0, 0.0, 0.3, 0.0])
    found = smoothing_clips.viterbi_joints(one)[:, 1, 0]
    np.testing.assert_allclose(found, [0.0, 0.02, 0.0, 0.01])
    nearest = smoothing_clips.nearest_joints(one)[:, 1, 0]
    np.testing.assert_allclose(nearest, [0.0, 0.02, 0.41, 0.01])
    # In the mean of two joints the modes are 0.2 m apart; a mode without weight is none.
    assert smoothing_clips.modes_apart(one) == 2.0
    near = record([[0.0, 0.02], [0.0, 0.2]], [[0.5, 0.5], [1.0, 0.0]], [0.0, 0.0])
    assert smoothing_clips.modes_apart(near) == 1.0
