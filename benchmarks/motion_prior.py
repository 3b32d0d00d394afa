"""Quality of the motion prior's predictions for people outside its training data.

Poses are filtered with a noise of 0.01 rad or m. Scores are the log density of the innovation under
the prediction in every step, and the share of innovations inside the 90 % region, for all degrees
of freedom together and for each. The learned prior is compared with a random walk at the rates of
the body, and with the same plus 0.7 of the previous velocity.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.clips import ROOT
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from hmt_learning.training.training_set import motion_files, recorded_sequence
from hmt_ros.body import Body, load_body
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.motion_states import PredictedStates

Array = NDArray[np.float64]
# Pairs of the innovation (d,) of a pose and its predicted covariance (d, d).
Surprises = Iterator[tuple[Array, Array]]

SHARED = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared'))
NOISE = 0.01  # rad and m
STEPS = (1, 3, 6)  # intervals, in frames of 30 Hz
KEPT, GAIN = 0.7, 0.5  # shares of the velocity kept and updated, for the random walk with velocity
# Motions with a faulty second part, and its first frame.
CUT = {'cmu_14_traffic': 720}


def filtered(dynamics: LinearGaussianDynamics, poses: Array, interval: float) -> Surprises:
    """Innovations (d,) of a filter and their covariances (d, d)."""
    d = dynamics.dimension
    noise = NOISE**2 * np.eye(d)
    state = np.zeros((1, dynamics.state_dimension))
    state[0, :d] = poses[0]
    known = dynamics.states(noise[None])
    nowhere, still = np.zeros((1, d), dtype=np.bool_), np.zeros(d)
    for pose in poses[1:]:
        states = PredictedStates(dynamics, *dynamics.predict(state, known, interval), still)
        spread = states.pose_covariances[0] + noise
        surprise = pose - states.poses[0]
        yield surprise, spread
        gain = np.linalg.solve(spread, states.pose_covariances[0]).T
        found = gain @ noise
        pose_found = states.poses + gain @ surprise
        velocities, known = states.given(
            np.zeros(1, dtype=np.intp), nowhere, pose_found, 0.5 * (found + found.T)[None]
        )
        state[:, :d], state[:, d:] = pose_found, velocities[:, : state.shape[1] - d]


def walking(rates: Array, kept: float) -> Callable[[Array, float], Surprises]:
    """Innovations of a random walk plus a share of a smoothed velocity."""

    def surprises(poses: Array, interval: float) -> Surprises:
        velocity = np.zeros(poses.shape[1])
        spread = np.diag(rates * interval + 2 * NOISE**2)
        for before, pose in pairwise(poses):
            yield pose - before - kept * interval * velocity, spread
            velocity = (1.0 - GAIN) * velocity + GAIN * (pose - before) / interval

    return surprises


def scores(surprises: list[tuple[Array, Array]]) -> dict[str, float]:
    """Mean log density, and shares inside 90 % regions."""
    densities, inside, alone = [], [], []
    for surprise, spread in surprises:
        factor = np.linalg.cholesky(spread)
        scaled = np.linalg.solve(factor, surprise)
        distance = float(scaled @ scaled)
        log_det = 2.0 * np.log(np.diagonal(factor)).sum()
        densities.append(-0.5 * (distance + log_det + len(surprise) * np.log(2.0 * np.pi)))
        inside.append(distance < chi2.ppf(0.9, len(surprise)))
        alone.append(surprise**2 / np.diagonal(spread) < chi2.ppf(0.9, 1))
    return {
        'log_density': float(np.mean(densities)),
        'inside_90': float(np.mean(inside)),
        'dof_inside_90': float(np.mean(alone)),
    }


def measure(folder: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Scores by interval and model.

    Args:
        folder: folder of motions; None means the development motions.
        quick: a few poses of one motion.

    Raises:
        FileNotFoundError: the development data are missing.
        ValueError: the folder has no motions.
    """
    if folder is None:
        folder = SHARED / 'mocap' / 'dev'
        if not folder.is_dir():
            raise FileNotFoundError(f'{folder} is absent (set HMT_SHARED)')
    body: Body = load_body('human37')
    motions = []
    for path in motion_files(folder)[: 1 if quick else None]:
        poses = recorded_sequence(path, body).poses
        motions.append(poses[: 60 if quick else CUT.get(path.stem)])
    learned = motion_prior(body)
    models: dict[str, Callable[[Array, float], Surprises]] = {
        'random walk': walking(body.rates, 0.0),
        f'random walk, {KEPT} of the velocity kept': walking(body.rates, KEPT),
        'learned': lambda poses, interval: filtered(learned, poses, interval),
    }
    result: dict[str, Any] = {'machine': description(), 'motions': len(motions)}
    for step in STEPS:
        found = {
            name: scores([x for poses in motions for x in model(poses[::step], step / RATE)])
            for name, model in models.items()
        }
        result[f'{step / RATE:.3f} s'] = found
    return result


def as_text(result: dict[str, Any], *, markdown: bool = True) -> str:
    """A table, always in Markdown."""
    head = '| interval | model | log density a step | all inside 90 % | each inside 90 % |'
    lines = [head, '|---|---|---:|---:|---:|']
    for interval, models in result.items():
        if interval.endswith(' s'):
            for name, one in models.items():
                lines.append(
                    f'| {interval} | {name} | {one["log_density"]:.1f} | '
                    f'{100 * one["inside_90"]:.0f} % | {100 * one["dof_inside_90"]:.0f} % |'
                )
    return '\n'.join(lines)


def main(argv: list[str]) -> int:
    """Runs the benchmark; returns 1 if there are no motions."""
    parser = benchmark_parser('motion_prior', __doc__, quick='a few poses of one motion')
    parser.add_argument('--mocap', type=Path, help='folder of motions (the development motions)')
    options = parser.parse_args(argv)
    return run_benchmark(
        'motion_prior',
        lambda: measure(options.mocap, quick=options.quick),
        as_text,
        as_json=options.json,
    )
