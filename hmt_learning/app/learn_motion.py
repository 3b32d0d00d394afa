"""learn-motion: learns the motion prior of a body from recorded motions.

    learn-motion FILES_OR_FOLDERS ... -o human37_motion.npz

The filter, the smoother and the prediction of poses take the file that lies beside the body's YAML
file, in `hmt_ros/body/models`, as BODY_motion.npz.

Velocities are damped and driven by coupled noise. The displacements of a degree of freedom over two
intervals tau in a row have, at damping g, with velocities of the variance s and white noise W,

    var = 2 s / g^2 (g tau - e) + W tau,    cov = s / g^2 e^2,    e = 1 - exp(-g tau)

g, s and W maximise the Gaussian likelihood of all pairs over intervals of 1/30 to 1/5 s (composite
likelihood [Varin, Reid and Firth 2011]); its sufficient statistics are the two moments. The
residuals of the second displacement, given the first, are correlated over the degrees of freedom:
the couplings. A mirrored copy of every motion takes part, so that left and right move alike.

The place of the camera is not learned: translations of the root are isotropic and not coupled, and
only changes of the heading count.
"""

from __future__ import annotations

import argparse
import fnmatch
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.optimize import minimize

from hmt_learning.motion.motion_file import read_motion
from hmt_learning.training.training_set import (
    MOTION_SUFFIXES,
    PoseSequence,
    motion_files,
    recorded_sequence,
)
from hmt_ros.app.command_line import CommandParser, add_sources, model_file, run_command
from hmt_ros.app.progress import show_progress, tell_user, with_progress
from hmt_ros.body import Body, load_body
from hmt_ros.body.mirror import mirror
from hmt_ros.body.motion_prior import LearnedMotion
from hmt_ros.experts.model_file import write_arrays
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.inference.arrays import Array
from msg_tools.files.error_line import error_line

# Largest accepted relative difference of a motion's rate from that of the poses.
SAME_RATE = 0.01

Item = TypeVar('Item')


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _learn, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='learn-motion', description='Learns how the poses of a body move, from motions.'
    )
    parser.add_motions()
    parser.add_model()
    add_sources(parser)
    return parser


def _learn(arguments: argparse.Namespace) -> int:
    output = model_file(arguments.output, overwrite=arguments.overwrite)
    body, quiet = load_body(arguments.body), arguments.quiet
    paths = chosen_motions(arguments.motions, arguments.without)
    sequences = read_motions('learn-motion', paths, arguments.body, _at_rate, quiet=quiet)
    card = data_card(sequences, arguments.acknowledgement)
    with show_progress('learning', quiet=quiet):
        model = learned_motion(body, [one.poses for one in sequences], RATE, card)
    write_arrays(output, model.arrays())
    if not quiet:
        skipped = len(paths) - len(sequences)
        skips = f', {skipped} skipped' if skipped else ''
        size = output.stat().st_size / 1e3
        print(f'{output}: {len(sequences)} motions{skips}, {size:.0f} kB', flush=True)
    return 0


def _at_rate(path: Path, body: Body) -> PoseSequence:
    """The motion in a file, whose rate has to be that of the poses, or a multiple."""
    fps = read_motion(path).fps
    rate = fps / max(round(fps / RATE), 1)
    if abs(rate / RATE - 1.0) > SAME_RATE:
        raise ValueError(f'{fps:g} frames per second, wanted a multiple of {RATE:g}')
    return recorded_sequence(path, body)


def chosen_motions(motions: list[Path], without: list[str]) -> list[Path]:
    """Motion files, and those in folders, but some names of files without suffix (cmu_02_*).

    Raises:
        ValueError: a file that is no motion, a folder without any, or a name of none of them.
    """
    found: list[Path] = []
    for path in motions:
        if path.is_dir():
            found += motion_files(path)
        elif path.suffix.lower() in MOTION_SUFFIXES:
            found.append(path)
        else:
            raise ValueError(f'{path}: wanted a folder or a motion ({", ".join(MOTION_SUFFIXES)})')
    names = [path.stem for path in found]
    left_out: set[str] = set()
    for pattern in without:
        meant = fnmatch.filter(names, pattern)
        if not meant:
            raise ValueError(f'--without: no motion is called {pattern!r}')
        left_out |= set(meant)
    return [path for path in found if path.stem not in left_out]


def read_motions(
    command: str,
    paths: list[Path],
    body: str,
    read: Callable[[Path, Body], Item],
    *,
    quiet: bool = False,
) -> list[Item]:
    """Content of motions, for a body; a line on stderr for each that can not be used.

    Args:
        read: reads one; errors of input and of arithmetic say that it can not be used.

    Raises:
        ValueError: there are motions, and none can be used.
    """
    found = []
    # Not by a fork: threads of other libraries may run in this process.
    context = get_context('spawn')
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 8), context) as pool:
        reading = pool.map(partial(_read_one, read=read, body=body), paths, chunksize=2)
        shown = with_progress(reading, 'reading', 'motions', len(paths), quiet=quiet)
        for path, (one, why) in zip(paths, shown, strict=True):
            if one is None:
                tell_user(command, f'skipped {path.name}: {why}')
            else:
                found.append(one)
    if paths and not found:
        raise ValueError(f'none of the {len(paths)} motions can be used')
    return found


def _read_one(path: Path, read: Callable[[Path, Body], Item], body: str) -> tuple[Item | None, str]:
    """Content of a motion; or the reason why it can not be used."""
    try:
        return read(path, load_body(body)), ''
    except (ValueError, OSError, ArithmeticError, np.linalg.LinAlgError) as error:
        return None, error_line(error)


def shares_of(sequences: list[PoseSequence], alike: str, share: float) -> list[float]:
    """How often each motion is drawn: those whose names start with `alike` less often."""
    return [share if alike and one.name.startswith(alike) else 1.0 for one in sequences]


def data_card(sequences: list[PoseSequence], acknowledgement: str) -> str:
    """Note on the motions that a file was learned from."""
    seconds = sum(len(one.poses) for one in sequences) / RATE
    names = ', '.join(sorted(one.name for one in sequences))
    said = f'{acknowledgement.strip()}\n' if acknowledgement.strip() else ''
    return f'{said}Learned from {len(sequences)} motions, {seconds:.0f} s: {names}.'


# Intervals, in frames of 30 Hz, and the one that couplings are measured at.
INTERVALS = (1, 2, 3, 4, 5, 6)
COUPLED = 3
# Displacements are cut at this quantile of their size: larger ones are faults of recordings.
USUAL = 0.995
# How far correlations are shrunk to 0.
SHRINKAGE = 0.05
# Least variance that a pose gains per second besides, m^2 or rad^2: 3 mm or 0.2 degrees.
LEAST_WHITE = 1e-5
# Bounds of the damping, per second.
DAMPING = (0.2, 60.0)
FEWEST = 200  # pairs of displacements that are needed


def learned_motion(
    body: Body, sequences: Sequence[Array], rate: float, card: str = ''
) -> LearnedMotion:
    """The motion prior of a body, from motions.

    Args:
        sequences: motions, each poses (T, d), in the frame of a camera at rest.
        rate: poses per second.

    Raises:
        ValueError: there is too little motion.
    """
    pairs = {k: _displacements(body, sequences, k) for k in INTERVALS}
    if len(pairs[INTERVALS[-1]]) < FEWEST:
        raise ValueError(
            f'the motions have {len(pairs[INTERVALS[-1]])} moments to learn from, wanted at least '
            f'{FEWEST}: give more of them'
        )
    groups = _groups(body)
    d = body.dimension
    damping, variance, white = np.empty((3, d))
    for group in groups:
        moments = np.array([_moments(pairs[k][:, :, group], k / rate) for k in INTERVALS])
        damping[group], variance[group], white[group] = _fitted(moments)
    correlation = _couplings(pairs[COUPLED], damping, variance, white, COUPLED / rate)
    apart = body.skeleton.dof_index(('root_tx', 'root_ty', 'root_tz'))
    correlation[apart, :] = correlation[:, apart] = 0.0
    correlation[apart, apart] = 1.0
    scale = np.sqrt(2.0 * damping * variance)
    diffusion = correlation * np.outer(scale, scale)
    return LearnedMotion(body.name, tuple(body.dof_names), damping, diffusion, white, card)


def _displacements(body: Body, sequences: Sequence[Array], step: int) -> Array:
    """Pairs (N, 2, d) of displacements over `step` frames, one after the other."""
    found = [np.empty((0, 2, body.dimension))]
    for poses in sequences:
        for seen in (poses, mirror(body, poses)):
            moved = seen[step:] - seen[:-step]
            found.append(np.stack([moved[:-step], moved[step:]], axis=1))
    every = np.concatenate(found)
    if len(every) == 0:
        return every
    limit = np.quantile(np.abs(every), USUAL, axis=(0, 1))
    result: Array = np.clip(every, -limit, limit)
    return result


def _groups(body: Body) -> list[list[int]]:
    """Degrees of freedom that share their parameters: the translations, and the two sides."""
    names = list(body.dof_names)
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        common = name.removeprefix('left_').removeprefix('right_')
        is_translation = not body.skeleton.dof_is_rotation[i]
        groups.setdefault('translation' if is_translation else common, []).append(i)
    return list(groups.values())


def _moments(pairs: Array, interval: float) -> tuple[float, float, float, float]:
    """Interval, variance and covariance of pairs (N, 2, m), and number of independent ones."""
    variance = float(np.mean(pairs**2))
    # Intervals overlap.
    count = len(pairs) * INTERVALS[0] / (interval * len(INTERVALS))
    return interval, variance, float(np.mean(pairs[:, 0] * pairs[:, 1])), count


def modelled_moments(
    interval: float, damping: Array | float, variance: Array | float, white: Array | float
) -> tuple[Array, Array]:
    """Variance and covariance of two displacements in a row; see above."""
    g = np.asarray(damping, dtype=np.float64)
    lost = -np.expm1(-g * interval)
    var = 2.0 * variance / g**2 * (g * interval - lost) + white * interval
    cov = variance / g**2 * lost**2
    return np.asarray(var, dtype=np.float64), np.asarray(cov, dtype=np.float64)


def _fitted(moments: Array) -> tuple[float, float, float]:
    """Damping, variance of the velocity and white noise from moments (I, 4)."""
    interval, var, cov, count = moments.T
    count = count / count.sum()
    floor = 1e-3 * LEAST_WHITE * interval
    var = np.maximum(var, floor)
    cov = np.clip(cov, -var + floor, var - floor)

    def cost(log: Array) -> float:
        g, s, w = np.exp(log)
        seen = [modelled_moments(float(t), g, s, w + LEAST_WHITE) for t in interval]
        v, c = np.array(seen).T
        # In the sum and the difference of the two displacements, which are independent.
        both = np.log(v + c) + (var + cov) / (v + c) + np.log(v - c) + (var - cov) / (v - c)
        return float((count * both).sum())

    bounds = [np.log(DAMPING), (-30.0, 10.0), (-30.0, 10.0)]
    size = float(np.log(var[-1] / interval[-1] ** 2))
    little = float(np.log(0.01 * var[0] / interval[0]))
    starts = [np.array([np.log(g), size, little]) for g in (1.0, 4.0, 16.0)]
    found = [
        minimize(cost, np.clip(x, -29.0, 9.0), method='L-BFGS-B', bounds=bounds) for x in starts
    ]
    g, s, w = np.exp(min(found, key=lambda one: float(one.fun)).x)
    return float(g), float(s), float(w) + LEAST_WHITE


def _couplings(
    pairs: Array, damping: Array, variance: Array, white: Array, interval: float
) -> Array:
    """Correlations (d, d) of the residuals of second displacements, given the first."""
    var, cov = modelled_moments(interval, damping, variance, white)
    surprise = pairs[:, 1] - cov / var * pairs[:, 0]
    both = surprise.T @ surprise / len(surprise)
    size = np.sqrt(np.maximum(np.diagonal(both), 1e-300))
    correlation = (1.0 - SHRINKAGE) * both / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    result: Array = 0.5 * (correlation + correlation.T)
    return result
