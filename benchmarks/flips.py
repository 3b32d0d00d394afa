"""flips: time per leaf of the interpretation trees, closed-form inverse kinematics included."""

from __future__ import annotations

import argparse
import itertools
import json
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import rounded, table
from benchmarks.machine import best_time, description, dgemm_rate, on_machine
from hmt_ros.body import Body, load_body
from hmt_ros.body.interpretation_tree import enumerate_flips, flip_counts

CHAINS = ('left_arm', 'right_arm', 'left_leg', 'right_leg')
LEAVES = 1024
# The yardstick: a microsecond a leaf on a core that makes so many operations per second in dgemm.
YARDSTICK_RATE = 58e9


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks flips', description=__doc__)
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('--quick', action='store_true', help='measure less long')
    options = parser.parse_args(argv)
    result = measure(0.1 if options.quick else 1.0)
    if options.json:
        print(json.dumps(rounded(result), indent=1))
        return 0
    print(as_text(result))
    return 0


def page() -> str:
    """The part of the documentation that this benchmark writes."""
    result = measure()
    return f'{as_text(result, markdown=True)}\n\n{on_machine(result["machine"])}'


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
    return f'{table(rows, markdown=markdown)}\n\ndgemm: {result["dgemm_gflops"]:.1f} GF/s.'


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
        leaves = len(enumerate_flips(body, None, poses, names)[0])
        spent = best_time(partial(enumerate_flips, body, None, poses, names), seconds=seconds)
        cases[name] = {
            'poses': len(poses),
            'leaves': leaves,
            'us_per_leaf': 1e6 * spent / leaves,
            'us_per_leaf_at_yardstick': 1e6 * spent / leaves * rate / YARDSTICK_RATE,
        }
    return {'machine': description(), 'cases': cases, 'dgemm_gflops': rate / 1e9}


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
