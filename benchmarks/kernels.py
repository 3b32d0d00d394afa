"""kernels: what is compiled against vectorised numpy, and what an evaluation of a pose computes.

Of an evaluation each term has a row, with its share of the peak of one core, which is the rate of a
product of matrices.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import (
    numpy_flips,
    numpy_likelihood,
    numpy_pruning,
    numpy_self_intersection,
    numpy_smoothing,
)
from benchmarks.arm_waving import waving
from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show
from benchmarks.kernel_flops import ALL, KINDS, PLACING, counts, energies
from benchmarks.machine import best_time, description, dgemm_rate
from benchmarks.smoothing_relations import CLOSE, layers_of
from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.self_intersection import self_intersection_energy
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import observe
from hmt_ros.inference import gaussian_pairs
from hmt_ros.inference.block_tridiagonal import add_band_product
from hmt_ros.inference.energy import Derivatives
from hmt_ros.smoothing.component_overlaps import add_overlaps
from hmt_ros.smoothing.trajectory_refinement import refine
from hmt_ros.tracking.selection import choose_hypotheses

# Poses of one call whose evaluations are measured.
POSES = 64


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('kernels', __doc__, quick='measure less long')
    options = parser.parse_args(argv)
    result = measure(0.1 if options.quick else 1.0)
    return show(result, as_text, as_json=options.json)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    rows = [['what', 'batch', 'numpy, ms', 'compiled, ms', 'ratio', 'all cores, ms', 'difference']]
    for entry in result['cases']:
        threads = entry['compiled_threads_ms']
        rows.append(
            [
                entry['what'],
                str(entry['batch']),
                f'{entry["numpy_ms"]:.2f}',
                f'{entry["compiled_ms"]:.2f}',
                f'{entry["ratio"]:.1f}',
                '-' if threads is None else f'{threads:.2f}',
                f'{entry["difference"]:.0e}',
            ]
        )
    parts = [table(rows, markdown=markdown)]
    rows = [['of an evaluation', 'KiB read from']]
    for kind in KINDS:
        rows[0] += [f'{kind}, us', 'kflop', 'Gflop/s', 'of peak, %']
    for entry in result['evaluation']:
        row = [entry['what'], f'{entry["bytes"] / 1024:.0f}']
        for kind in KINDS:
            own = entry[kind]
            row += [
                f'{own["us"]:.1f}', f'{own["flops"] / 1e3:.0f}', f'{own["rate"] / 1e9:.1f}',
                f'{100.0 * own["rate"] / result["peak"]:.0f}',
            ]  # fmt: skip
        rows.append(row)
    parts.append(table(rows, markdown=markdown))
    parts.append(f'Peak of one core: {result["peak"] / 1e9:.0f} Gflop/s in double precision.')
    return '\n\n'.join(parts)


def measure(seconds: float = 1.0) -> dict[str, Any]:
    """Times and differences of the image's terms, the choice of hypotheses, and the smoother."""
    return {
        'machine': description(),
        'cases': [
            *_likelihoods(seconds),
            *_choices(seconds),
            *_flips(seconds),
            *_overlaps(seconds),
            *_smoothing(seconds),
        ],
        'peak': dgemm_rate(),
        'evaluation': list(_evaluation(seconds)),
    }


def _evaluation(seconds: float) -> Iterator[dict[str, Any]]:
    """Costs of one evaluation; those of terms on top of the frames of the segments."""
    some, poses = energies(POSES)
    counted, placed = counts(), dict.fromkeys(KINDS, 0.0)
    for what, energy in some.items():
        times = {
            kind: 1e6 / POSES
            * best_time(partial(energy.energy, poses, derivatives=derivatives), seconds=seconds)
            for kind, derivatives in KINDS.items()
        }  # fmt: skip
        alone = what in {PLACING, ALL}
        entry: dict[str, Any] = {'what': what, 'bytes': counted[what]['bytes']}
        for kind in KINDS:
            own = times[kind] - (0.0 if alone else placed[kind])
            flops = counted[what][kind] - (0.0 if alone else counted[PLACING][kind])
            entry[kind] = {'us': own, 'flops': flops, 'rate': 1e6 * flops / own}
        if what == PLACING:
            placed = times
        yield entry


def _likelihoods(seconds: float) -> Iterator[dict[str, Any]]:
    body = load_body('human37')
    camera = Camera(660.0, 660.0, 319.5, 239.5, 640, 480)
    view = Viewpoint(distance=3.6)
    shown = procedural_motion('walk', body, 0.8, 10.0, 3, viewpoint=view)[4:6]
    _, now = render_frames(body, shown, camera, Scene(viewpoint=view))
    observation = observe(now.image, now.mask)
    likelihood = ImageLikelihood(body, camera)
    rng = np.random.default_rng(0)
    for batch in (8, 32, 128):
        poses = shown[1] + 0.1 * rng.normal(size=(batch, body.dimension))
        poses[:, :3] = shown[1, :3] + 0.03 * rng.normal(size=(batch, 3))
        poses = np.clip(poses, body.lower, body.upper)

        def compiled(x: Any = poses, of: ImageLikelihood = likelihood) -> Any:
            return of.energies(forward(body.skeleton, x), observation)

        def vectorised(x: Any = poses) -> Any:
            return numpy_likelihood.image_energy(likelihood, x, observation)

        found, wanted = compiled(), vectorised()
        difference = max(
            float(np.abs(a - b).max() / np.abs(b).max())
            for a, b in (
                (found.value, wanted.value),
                (found.gradient, wanted.gradient),
                (found.hessian, wanted.hessian),
            )
        )
        alone = best_time(partial(compiled, of=replace(likelihood, threads=1)), seconds=seconds)
        yield _case(
            'likelihood, gradient, Hessian', batch, best_time(vectorised, seconds=seconds), alone,
            best_time(compiled, seconds=seconds), difference,
        )  # fmt: skip


def _choices(seconds: float) -> Iterator[dict[str, Any]]:
    rng = np.random.default_rng(0)
    for batch in (32, 256):
        joints = rng.normal(0, 0.1, (batch, 19, 3))
        log_weights = rng.normal(0, 3, batch)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        found = choose_hypotheses(joints, log_weights, 16)
        wanted, owners = numpy_pruning.choose(joints, weights, 16)
        same = np.array_equal(found.chosen, wanted) and np.array_equal(found.owner, owners)
        slow = best_time(partial(numpy_pruning.choose, joints, weights, 16), seconds=seconds)
        fast = best_time(partial(choose_hypotheses, joints, log_weights, 16), seconds=seconds)
        yield _case('choice of hypotheses', batch, slow, fast, None, 0.0 if same else np.inf)


def _flips(seconds: float) -> Iterator[dict[str, Any]]:
    body = load_body('human37')
    for batch in (1, 128):
        poses = _any_poses(batch)
        found, _ = enumerate_flips(body, poses, 'left_arm')
        wanted, _ = numpy_flips.enumerate_flips(body, poses, 'left_arm')
        difference = float(np.abs(found - wanted).max()) if len(found) == len(wanted) else np.inf
        slow = partial(numpy_flips.enumerate_flips, body, poses, 'left_arm')
        fast = partial(enumerate_flips, body, poses, 'left_arm')
        yield _case(
            'flips of an arm', batch, best_time(slow, seconds=seconds),
            best_time(fast, seconds=seconds), None, difference,
        )  # fmt: skip


def _overlaps(seconds: float) -> Iterator[dict[str, Any]]:
    body = load_body('human37')
    for batch in (8, 128):
        frames = forward(body.skeleton, _any_poses(batch))
        slow = partial(numpy_self_intersection.self_intersection_energy, body, frames)
        fast = partial(self_intersection_energy, body, frames)
        pairs = zip(fast(), slow(), strict=True)
        difference = max(float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-9)) for a, b in pairs)
        yield _case(
            'self-intersection', batch, best_time(slow, seconds=seconds),
            best_time(fast, seconds=seconds), None, difference,
        )  # fmt: skip


def _any_poses(count: int) -> Any:
    body = load_body('human37')
    rng = np.random.default_rng(1)
    spread = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.0)
    poses = body.prior_mean + spread * rng.normal(size=(count, body.dimension))
    poses[:, :3] = [0.0, 0.0, 4.0]
    return np.clip(poses, body.lower, body.upper)


def _smoothing(seconds: float) -> Iterator[dict[str, Any]]:
    """On the arm-waving sequence with modes that overlap, 8 images."""
    sequence = waving(8, reach=CLOSE, alike=True)
    layers = layers_of(sequence)
    means = np.concatenate([mixture.means for mixture in layers.mixtures])
    covariances = np.concatenate([mixture.covariances for mixture in layers.mixtures])
    pairs = np.indices((len(means), 8)).reshape(2, -1).T.copy()
    yield _smoothing_case(
        'links of the network', len(pairs), seconds,
        partial(_serial_links, means, covariances, pairs),
        partial(numpy_smoothing.pair_log_densities, means, covariances, means, covariances, pairs),
    )  # fmt: skip

    starts = layers.states(layers.paths(64))
    poses = starts.reshape(-1, starts.shape[2])
    times = np.tile(np.arange(8), len(starts))
    likelihood = layers.likelihood
    ends = likelihood.first[1:-1]  # type: ignore[union-attr]
    yield _smoothing_case(
        'mixtures, gradient, Hessian', len(poses), seconds,
        partial(likelihood.energy, poses, times, derivatives=Derivatives.EXACT),
        partial(
            numpy_smoothing.mixture_energy, list(layers.mixtures),
            np.split(likelihood.whiteners, ends),  # type: ignore[union-attr]
            np.split(likelihood.precisions, ends),  # type: ignore[union-attr]
            poses, times,
        ),
    )  # fmt: skip

    band = layers.prior.precision.band()
    flat = starts.reshape(len(starts), -1)

    def product() -> Any:
        result = np.zeros_like(flat)
        add_band_product(band, flat, result)
        return result

    yield _smoothing_case(
        'product with a band', len(flat), seconds, product,
        partial(numpy_smoothing.band_product, band, flat),
    )  # fmt: skip

    refined = refine(starts, layers.prior, likelihood)
    some = refined.without_duplicates()[np.arange(8)]
    centres = some.states.reshape(8, -1)
    total = centres.shape[1]
    bands = np.stack([factor.band.T for factor in some.factors])
    scales = 0.5 * np.array([factor.log_determinant for factor in some.factors])
    scales -= 0.5 * total * np.log(2 * np.pi)
    log_weights = np.full(8, -np.log(8.0))
    noise = np.random.default_rng(0).standard_normal((32, total))
    samples = centres[0] + some.factors[0].solve_transposed(noise.reshape(32, 8, -1)).reshape(
        32, -1
    )

    def overlaps() -> Any:
        log, slope = np.empty(32), np.empty((32, total))
        add_overlaps(
            0, samples, noise, log_weights, scales, centres, np.ones(8), bands,
            np.ones(8, dtype=np.bool_), np.zeros(8, dtype=np.int64), True, 1.0, log, slope,
            np.zeros((8, total)), np.zeros(8), np.zeros(8), np.zeros((0, 0, 0)),
        )  # fmt: skip
        return log, slope

    yield _smoothing_case(
        'overlaps of trajectories', len(samples), seconds, overlaps,
        partial(numpy_smoothing.log_overlaps, samples, log_weights, scales, centres, bands),
    )  # fmt: skip


def _serial_links(means: Any, covariances: Any, pairs: Any) -> Any:
    """On one core."""
    squares, log_determinants = np.empty((2, len(pairs)))
    gaussian_pairs._whitened_pairs(
        means, covariances, means, covariances, pairs, np.ones((len(pairs), 2)),
        squares, log_determinants,
    )  # fmt: skip
    return -0.5 * (squares + log_determinants + means.shape[1] * np.log(2 * np.pi))


def _smoothing_case(
    what: str, batch: int, seconds: float, compiled: Any, vectorised: Any
) -> dict[str, Any]:
    found, wanted = compiled(), vectorised()
    if not isinstance(found, tuple):
        found, wanted = (found,), (wanted,)
    difference = max(
        float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(found, wanted, strict=True)
    )
    slow = best_time(vectorised, seconds=seconds)
    return _case(what, batch, slow, best_time(compiled, seconds=seconds), None, difference)


def _case(
    what: str, batch: int, slow: float, fast: float, threads: float | None, difference: float
) -> dict[str, Any]:
    return {
        'what': what,
        'batch': batch,
        'numpy_ms': 1e3 * slow,
        'compiled_ms': 1e3 * fast,
        'ratio': slow / fast,
        'compiled_threads_ms': None if threads is None else 1e3 * threads,
        'difference': difference,
    }
