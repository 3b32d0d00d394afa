"""kernels: what an evaluation of a pose computes, term by term, and what compiled code takes.

Of an evaluation each term has a row, with its share of the peak of one core, which is the rate of a
product of matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show
from benchmarks.kernel_flops import ALL, KINDS, PLACING, counts, energies
from benchmarks.machine import best_time, description, dgemm_rate
from hmt_learning.motion.self_intersection import self_intersection_energy
from hmt_ros.body import load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.tracking.selection import choose_hypotheses

# Poses of one call whose evaluations are measured.
POSES = 64
QUICK = (PLACING, 'keypoints', 'motion')


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('kernels', __doc__, quick=f'less long, and only {", ".join(QUICK)}')
    options = parser.parse_args(argv)
    result = measure(quick=options.quick)
    return show(result, as_text, as_json=options.json)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    rows = [['what', 'batch', 'ms']]
    rows += [[one['what'], str(one['batch']), f'{one["ms"]:.2f}'] for one in result['cases']]
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


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Times of compiled functions, and what the evaluation of a pose computes."""
    seconds = 0.05 if quick else 1.0
    return {
        'machine': description(),
        'cases': list(_cases(seconds)),
        'peak': dgemm_rate(),
        'evaluation': list(_evaluation(seconds, QUICK if quick else None)),
    }


def _cases(seconds: float) -> Iterator[dict[str, Any]]:
    """Times of the choice of hypotheses, of flips and of self-intersection, ms."""
    body, rng = load_body('human37'), np.random.default_rng(0)
    joints, log_weights = rng.normal(0, 0.1, (256, 19, 3)), rng.normal(0, 3, 256)
    poses = _any_poses(128)
    cases: tuple[tuple[str, int, Callable[[], Any]], ...] = (
        (
            'choice of hypotheses',
            256,
            partial(choose_hypotheses, joints, log_weights, 16, same=0.02),
        ),
        ('flips of an arm', 1, partial(enumerate_flips, body, poses[:1], 'left_arm')),
        ('flips of an arm', 128, partial(enumerate_flips, body, poses, 'left_arm')),
        ('self-intersection', 128, partial(self_intersection_energy, body, poses)),
    )
    for what, batch, function in cases:
        yield {'what': what, 'batch': batch, 'ms': 1e3 * best_time(function, seconds=seconds)}


def _evaluation(seconds: float, names: Sequence[str] | None) -> Iterator[dict[str, Any]]:
    """Costs of one evaluation; those of terms on top of the frames of the segments."""
    every, poses = energies(POSES)
    some = {name: every[name] for name in names or every}
    counted, placed = counts([*some]), dict.fromkeys(KINDS, 0.0)
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


def _any_poses(count: int) -> Any:
    body = load_body('human37')
    rng = np.random.default_rng(1)
    spread = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.0)
    poses = body.prior_mean + spread * rng.normal(size=(count, body.dimension))
    poses[:, :3] = [0.0, 0.0, 4.0]
    return np.clip(poses, body.lower, body.upper)
