"""smoothing: exactness against known posteriors, speed, memory, peers, and clips with truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.arm_waving import STEP, smooth_waving, waving
from benchmarks.clips import table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.exact_smoothing import (
    divergence,
    enumerated,
    grid_marginals,
    modes,
    particle_marginals,
)
from benchmarks.machine import best_time, peak_memory_apart
from benchmarks.smoothing_clips import clips, error_rows, motion_rows
from benchmarks.smoothing_peers import (
    RobustSequence,
    gtsam_missing,
    gtsam_trajectory,
    scipy_trajectory,
)
from benchmarks.smoothing_relations import relations
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother
from hmt_ros.smoothing.embedded_network import embedded_network, k_best_paths
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.trajectory_refinement import refine
from hmt_ros.smoothing.variational_mixture import laplace_weights, minimise_free_energy

Array = NDArray[np.float64]

TIMES = 47
PARTS = ('memory', 'exactness', 'grid', 'stages', 'peers', 'length', 'relations', 'clips')
# Variances that a step of the random walk adds, against modes of unit size.
WALKS = (1.0, 4.0, 16.0)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('smoothing', __doc__, quick='fewer sequences and repetitions')
    add_choice(parser, PARTS, 'PART')
    options = parser.parse_args(argv)
    result = measure(quick=options.quick, only=options.only)
    return show(result, as_text, as_json=options.json)


def measure(*, quick: bool = False, only: Sequence[str] = PARTS) -> dict[str, Any]:
    """What was asked for; memory first, in a process of its own."""
    times = 12 if quick else TIMES
    parts: dict[str, Callable[[], Any]] = {
        'memory': lambda: {'peak_mb': peak_memory_apart(smooth_waving, times) / 1e6},
        'exactness': lambda: exactness(1 if quick else 4, WALKS[1:2] if quick else WALKS),
        'grid': lambda: grid(1 if quick else 3, 20 if quick else 40),
        'stages': lambda: stages(times, 0.0 if quick else 3.0),
        'peers': lambda: peers(times, 0.0 if quick else 2.0),
        'length': lambda: length(*((6, 12) if quick else (TIMES, 10 * TIMES))),
        'relations': lambda: relations(6 if quick else TIMES),
        'clips': lambda: clips(quick),
    }
    return run_stages('smoothing', parts, only)


def exactness(seeds: int, walks: tuple[float, ...] = WALKS) -> dict[str, Any]:
    """Mean over t of KL(exact || smoothed), K = 3, T = 6, d = 2, and of a particle smoother."""
    result: dict[str, Any] = {}
    for kind in ('separated', 'overlapping'):
        ours, particles, spent = [], [], []
        for walk in walks:
            dynamics = LinearGaussianDynamics.random_walk([walk, walk])
            smoother = MixtureSmoother(dynamics)
            for seed in range(seeds):
                mixtures = modes(kind, seed, 6)
                exact = enumerated(mixtures, dynamics)
                smoother.smooth(mixtures)
                begin = time.process_time()
                found = smoother.smooth(mixtures)
                spent.append(time.process_time() - begin)
                rng = np.random.default_rng(seed)
                ours.append(
                    np.mean(
                        [
                            divergence(p, found.marginal(t).log_density, rng)
                            for t, p in enumerate(exact)
                        ]
                    )
                )
                peer = particle_marginals(mixtures, dynamics, spent[-1], seed)
                rng = np.random.default_rng(seed)
                particles.append(
                    np.mean([divergence(p, q.log_density, rng, 500) for p, q in zip(exact, peer)])
                )
        result[kind] = {
            'mean_kl': float(np.mean(ours)),
            'worst_kl': float(np.max(ours)),
            'particle_mean_kl': float(np.mean(particles)),
            'particle_better_in': int((np.array(particles) < np.array(ours)).sum()),
            'sequences': len(ours),
            'cpu_s': float(np.mean(spent)),
        }
    return result


def grid(seeds: int, times: int = 40) -> dict[str, Any]:
    """The same in one dimension over 40 times, against sums on a grid."""
    result: dict[str, Any] = {}
    points = np.linspace(-15, 15, 601)
    for kind in ('separated', 'overlapping'):
        ours = []
        for seed in range(seeds):
            dynamics = LinearGaussianDynamics.random_walk([1.0])
            mixtures = modes(kind, seed, times, dimension=1)
            exact = grid_marginals(mixtures, dynamics, points)
            found = MixtureSmoother(dynamics).smooth(mixtures)
            each = []
            for t, density in enumerate(exact):
                log = found.marginal(t).log_density(points[:, None])
                inside = density > 1e-12
                gap = density[inside] * (np.log(density[inside]) - log[inside])
                each.append(gap.sum() * (points[1] - points[0]))
            ours.append(np.mean(each))
        result[kind] = {'mean_kl': float(np.mean(ours)), 'worst_kl': float(np.max(ours))}
    return result


def stages(times: int, seconds: float) -> dict[str, Any]:
    """Times of the stages at d = 32, K = 8, 64 trajectories."""
    sequence = waving(times)
    dynamics, mixtures = sequence.dynamics, sequence.mixtures
    intervals = np.full(times - 1, STEP)
    layers = ModeSequence(tuple(mixtures), dynamics, intervals)
    prior, likelihood = layers.prior, layers.likelihood
    starts = layers.states(layers.paths(64))
    refined = refine(starts, prior, likelihood, sequence.lower, sequence.upper)
    distinct = refined.without_duplicates()
    weights = laplace_weights(distinct.energies, distinct.factors)

    def descend() -> Any:
        return minimise_free_energy(
            weights, distinct.states, distinct.factors, prior, likelihood,
            low=sequence.lower, high=sequence.upper, samples=4,
        )  # fmt: skip

    found = descend()
    return {
        'times': times,
        'trajectories': len(starts),
        'distinct': len(distinct),
        'network_and_paths_ms': 1e3
        * best_time(
            lambda: k_best_paths(embedded_network(mixtures, dynamics, intervals), 1),
            seconds=seconds,
        ),
        'refinement_s': best_time(
            lambda: refine(starts, prior, likelihood, sequence.lower, sequence.upper),
            seconds=seconds,
        ),
        'variational_s': best_time(descend, seconds=seconds),
        'most_iterations': int(refined.iterations.max()),
        'not_converged': int((refined.status != 0).sum()),
        'free_energy': found.free_energy.tolist(),
        'free_energy_fresh': list(found.fresh),
    }


def robust_problem(times: int, seed: int = 0) -> tuple[RobustSequence, Array, Array]:
    """Observations of a waving person with one outlier in eight, variances, and a start."""
    rng = np.random.default_rng(seed)
    sequence = waving(times, seed)
    covariances = np.array([mixture.covariances[0] for mixture in sequence.mixtures])
    whiteners = np.linalg.inv(np.linalg.cholesky(covariances))
    white = rng.normal(size=sequence.truth.shape)
    white[::8] *= 4.0
    means = sequence.truth + np.linalg.solve(whiteners, white[:, :, None])[:, :, 0]
    variances = np.diagonal(sequence.dynamics.diffusion) * STEP
    return RobustSequence(means, whiteners, 8.0), variances, means.copy()


def peers(times: int, seconds: float) -> dict[str, Any]:
    """One trajectory's refinement by us, scipy and GTSAM, to the same energy."""
    sequence, variances, start = robust_problem(times)
    dynamics = LinearGaussianDynamics.random_walk(variances)
    prior = dynamics.prior(np.ones(times - 1))
    found = refine(start[None], prior, sequence)
    energy = float(found.energies[0] - prior.constant)
    ours = best_time(lambda: refine(start[None], prior, sequence), seconds=seconds)
    cost, spent, evaluations = scipy_trajectory(sequence, variances, start)
    result: dict[str, Any] = {
        'ours_s': ours,
        'ours_iterations': int(found.iterations[0]),
        'ours_energy': energy,
        'scipy_s': spent,
        'scipy_evaluations': evaluations,
        'scipy_energy': cost,
        'scipy_ratio': spent / ours,
    }
    reason = gtsam_missing()
    if reason:
        return {**result, 'gtsam': f'skipped: {reason}'}
    runs = [gtsam_trajectory(sequence, variances, start) for _ in range(3)]
    spent = min(run[1] for run in runs)
    return {
        **result,
        'gtsam_s': spent,
        'gtsam_iterations': runs[0][2],
        'gtsam_energy': runs[0][0],
        'gtsam_ratio': spent / ours,
    }


def length(short: int, long: int) -> dict[str, Any]:
    """Cost of a long sequence over that of a short one, whole smoother."""
    spent = {}
    for times in (short, long):
        sequence = waving(times)
        smoother = MixtureSmoother(sequence.dynamics, sequence.lower, sequence.upper)
        runs = []
        for _ in range(2):
            begin = time.perf_counter()
            smoother.smooth(sequence.mixtures)
            runs.append(time.perf_counter() - begin)
        spent[times] = min(runs)
    return {
        'short_s': spent[short],
        'long_s': spent[long],
        'times_longer': long / short,
        'ratio': spent[long] / spent[short],
    }


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    rows = [['measure', 'value', 'wanted']]
    for kind, limit in (('separated', 0.02), ('overlapping', 0.1)):
        if 'exactness' in result:
            entry = result['exactness'][kind]
            value = f'{entry["mean_kl"]:.4f} ({entry["particle_mean_kl"]:.4f}) nats'
            what = f'KL from exact, {kind} (particle smoother, same time)'
            rows.append([what, value, f'{limit}'])
        if 'grid' in result:
            value = f'{result["grid"][kind]["mean_kl"]:.4f} nats'
            rows.append([f'KL from a grid, 40 times, {kind}', value, f'{limit}'])
    if 'stages' in result:
        stage = result['stages']
        rows += [
            ['network and paths', f'{stage["network_and_paths_ms"]:.1f} ms', '10'],
            ['refinement of 64 trajectories', f'{stage["refinement_s"]:.2f} s', '1.2'],
            ['most iterations', str(stage['most_iterations']), '20'],
            ['variational refinement', f'{stage["variational_s"]:.2f} s', '1.5'],
        ]
    if 'memory' in result:
        rows.append(['peak memory', f'{result["memory"]["peak_mb"]:.0f} MB', '400'])
    if 'length' in result:
        rows.append(['ten times the length costs', f'{result["length"]["ratio"]:.1f} times', '11'])
    if 'peers' in result:
        peer = result['peers']
        gtsam = f'{peer["gtsam_ratio"]:.1f} times' if 'gtsam_ratio' in peer else peer['gtsam']
        rows += [
            ['one trajectory', f'{1e3 * peer["ours_s"]:.1f} ms', ''],
            ['faster than scipy', f'{peer["scipy_ratio"]:.0f} times', '25'],
            ['faster than GTSAM', gtsam, '2'],
        ]
    if 'relations' in result:
        found = result['relations']
        ratios = ', '.join(f'{k}: {v:.0f}' for k, v in found['eigenvalue_ratio'].items())
        rows += [
            ['eigenvalue ratio by frames (generated: 4900)', ratios, 'falls'],
            ['difference of paths and optima', f'{found["difference_deg"]:.1f} deg', ''],
            ['roughness of optima over paths', f'{found["roughness_ratio"]:.2f}', 'below 1'],
            ['change of -log likelihood', f'{100 * found["log_likelihood_change"]:+.1f} %', '10'],
            [
                'free energy falls by, in iterations',
                f'{found["free_energy_fall"]:.2f} nats, {found["free_energy_iterations"]}',
                '8',
            ],
        ]
    parts = [table(rows, markdown=markdown)] if len(rows) > 1 else []
    if 'clips' in result:
        found = result['clips']
        if isinstance(found, str):
            parts.append(f'clips: {found}')
        else:
            parts.append(table(error_rows(found), left=2, markdown=markdown))
            parts.append(table(motion_rows(found), left=3, markdown=markdown))
    return '\n\n'.join(parts)
