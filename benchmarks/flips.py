"""flips: time per leaf of the interpretation trees, closed-form inverse kinematics included."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show
from benchmarks.machine import best_time, description, dgemm_rate, peak_memory_apart
from benchmarks.whole_body_flips import full_body_flips
from hmt_ros.body import Body, load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips, flip_counts

CHAINS = ('left_arm', 'right_arm', 'left_leg', 'right_leg')
LEAVES = 1024
MODES, MOST_LEAVES = 96, 100_000
# The yardstick: a microsecond a leaf on a core that makes so many operations per second in dgemm.
YARDSTICK_RATE = 58e9


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('flips', __doc__, quick='measure less long')
    options = parser.parse_args(argv)
    result = measure(0.1 if options.quick else 1.0)
    return show(result, as_text, as_json=options.json)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people, and the machine's own speed."""
    rows = [['trees of', 'poses', 'leaves', 'us per leaf', f'at {YARDSTICK_RATE / 1e9:.0f} GF/s']]
    for name, entry in result['cases'].items():
        rows.append(
            [
                name,
                str(entry['poses']),
                str(entry['leaves']),
                f'{entry["us_per_leaf"]:.2f}',
                f'{entry["us_per_leaf_at_yardstick"]:.2f}',
            ]
        )
    whole = result['whole_body']
    steps = [['whole bodies', 'us per leaf', f'at {YARDSTICK_RATE / 1e9:.0f} GF/s']]
    scaled = whole['us_per_leaf_at_yardstick']
    steps += [[x, f'{us:.2f}', f'{scaled[x]:.2f}'] for x, us in whole['us_per_leaf'].items()]
    steps.append(
        ['all', f'{sum(whole["us_per_leaf"].values()):.2f}', f'{sum(scaled.values()):.2f}']
    )
    parts = [
        table(rows, markdown=markdown),
        table(steps, markdown=markdown),
        f'Whole bodies: the {whole["leaves"]} most probable leaves of {whole["poses"]} poses of '
        f'human37, {whole["trunks"]} trunks with those that are flipped; '
        f'peak memory of the process {whole["peak_mb"]:.0f} MB.',
        f'dgemm: {result["dgemm_gflops"]:.1f} GF/s.',
    ]
    return '\n\n'.join(parts)


def measure(seconds: float = 1.0) -> dict[str, Any]:
    """Times of one tree of 1024 leaves, and of many trees of one limb."""
    body = load_body('human37')
    pose, chains = pose_with_leaves(body, LEAVES)
    many = random_poses(body, 256, seed=1)
    rate = dgemm_rate()
    cases = {}
    for name, poses, names in (
        (' x '.join(chains), pose[None], list(chains)),
        ('left_arm', many, ['left_arm']),
        ('left_leg', many, ['left_leg']),
    ):
        leaves = len(enumerate_flips(body, poses, names)[0])
        spent = best_time(partial(enumerate_flips, body, poses, names), seconds=seconds)
        cases[name] = {
            'poses': len(poses),
            'leaves': leaves,
            'us_per_leaf': 1e6 * spent / leaves,
            'us_per_leaf_at_yardstick': 1e6 * spent / leaves * rate / YARDSTICK_RATE,
        }
    return {
        'machine': description(),
        'cases': cases,
        'whole_body': whole_body(seconds, rate),
        'dgemm_gflops': rate / 1e9,
    }


def whole_body(seconds: float, rate: float) -> dict[str, Any]:
    """Times of the most probable leaves of whole bodies, step by step, and the memory they take."""
    body = load_body('human37')
    poses = poses_with_most_leaves(body)
    steps = {}
    torso = best_time(partial(full_body_flips, body, poses), seconds=seconds, least=1)
    pruned = partial(full_body_flips, body, poses, torso=False)
    trees = partial(full_body_flips, body, poses, torso=False, most_overlap=np.inf)
    steps['trees of all chains'] = best_time(trees, seconds=seconds)
    steps['pruning by self-intersection'] = (
        best_time(pruned, seconds=seconds) - steps['trees of all chains']
    )
    steps['torsos by inverse kinematics'] = torso - sum(steps.values())
    product = full_body_flips(body, poses)
    leaves = len(product.most_probable(MOST_LEAVES).poses)
    steps['enumeration, most probable first'] = best_time(
        partial(product.most_probable, MOST_LEAVES), seconds=seconds
    )
    return {
        'poses': len(poses),
        'trunks': len(product.trunks),
        'leaves': leaves,
        'us_per_leaf': {name: 1e6 * spent / leaves for name, spent in steps.items()},
        'us_per_leaf_at_yardstick': {
            name: 1e6 * spent / leaves * rate / YARDSTICK_RATE for name, spent in steps.items()
        },
        'peak_mb': peak_memory_apart(enumerate_most) / 1e6,
    }


def poses_with_most_leaves(body: Body) -> NDArray[np.float64]:
    """Of random poses those with most leaves, so many that they have 100,000."""
    poses = random_poses(body, 4000, seed=0)
    counts = np.prod([flip_counts(body, poses, chain) for chain in body.chains], axis=0)
    return poses[np.argsort(-counts, kind='stable')[:MODES]]


def enumerate_most() -> None:
    """The most probable leaves of whole bodies, once."""
    body = load_body('human37')
    product = full_body_flips(body, poses_with_most_leaves(body))
    assert len(product.most_probable(MOST_LEAVES).poses) == MOST_LEAVES


def random_poses(body: Body, count: int, seed: int) -> NDArray[np.float64]:
    """Poses (count, d) within the limits, near the mean, 4 m before the camera."""
    rng = np.random.default_rng(seed)
    sigma = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.5)
    poses = body.prior_mean + sigma * rng.normal(size=(count, body.dimension))
    poses = np.clip(poses, body.lower, body.upper)
    poses[:, :3] = [0.0, 0.0, 4.0]
    return poses


def pose_with_leaves(body: Body, leaves: int) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """A pose and chains of which the product of trees has exactly so many leaves.

    Raises:
        ValueError: none was found.
    """
    poses = random_poses(body, 4000, seed=0)
    counts = {chain: flip_counts(body, poses, chain) for chain in CHAINS}
    for size in range(len(CHAINS), 0, -1):
        for names in itertools.combinations(CHAINS, size):
            product = np.prod([counts[name] for name in names], axis=0)
            found = np.flatnonzero(product == leaves)
            if len(found):
                return poses[found[0]], names
    raise ValueError(f'no pose has {leaves} leaves')
