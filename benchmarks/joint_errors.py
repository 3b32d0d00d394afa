"""joint_errors: pose-independent errors of joints, and scale of the pose covariances.

With covariances C_jk from those of the pose, the modes k predict for a joint j

    p(x_j) = sum_k w_k N(x_j; m_jk, t C_jk + s_j^2 I)

For each t, s_j is chosen such that the 90 % regions of joint j, relative to the pelvis, contain the
true joint in 90 % of the images of the clips used for settings, over all three inputs together.
Results are in `joint_errors` of `hmt_ros/body/models/human37.yaml`, and in `TOGETHER` of
`hmt_ros/inference/error_model.py`, which is part of the C_jk.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import read_clip, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.runs import INPUTS, begun, stepped
from benchmarks.truth_fits import CLIPS, QUICK, QUICK_IMAGES
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN
from hmt_ros.inference.calibration import (
    levels_of,
    marginal_log_densities,
    stratified_samples,
)
from hmt_ros.inference.mixture import GaussianMixture

Array = NDArray[np.float64]

EVERY = 6  # interval of the used images
HELD = 0.9
SAMPLES = 100
# Values of t, and the bounds of s, m.
SHARES = (0.35, 0.5, 0.7, 1.0, 1.4)
LEAST, MOST = 0.001, 0.1
HALVINGS = 6


class Said(NamedTuple):
    """Distribution of one joint in one image, relative to the pelvis or absolute.

    Attributes:
        joint: name of the joint; left ones are named as the right ones.
        relative: whether it is relative to the pelvis.
        weights: (K,) weights of the modes.
        means: (K, 3) means minus the true position, m.
        covariances: (K, 3, 3) covariances from the pose, m^2.
    """

    joint: str
    relative: bool
    weights: Array
    means: Array
    covariances: Array


def said_of(folder: Path, inputs: str, limit: int | None = None) -> list[Said]:
    """Distributions of the joints of a clip, with one of `runs.INPUTS`.

    Raises:
        ValueError: the clip can not be read.
    """
    clip = read_clip(folder, limit)
    tracker, keypoints = begun(clip, inputs)
    names = [name for name in EVALUATED_JOINTS if name in clip.truth.joint_names]
    which = tracker.estimate.body.skeleton.joint_index([ORIGIN, *names])
    result = []
    for i, (stamp, posterior, *_) in enumerate(stepped(clip, tracker, keypoints)):
        if posterior is None or i % EVERY or stamp not in clip.truth.joints:
            continue
        rows = [clip.truth.joint_names.index(name) for name in (ORIGIN, *names)]
        true = clip.truth.joints[stamp][rows]
        joints = tracker.estimate.body.joint_positions(posterior.means)[:, which]
        jacobians = tracker.estimate.body.joint_jacobians(posterior.means)[:, which]
        for relative in (True, False):
            share = float(relative)
            moved = (jacobians - share * jacobians[:, :1]) @ posterior.cholesky()[:, None]
            covariances = moved @ moved.swapaxes(2, 3)
            off = (joints - share * joints[:, :1]) - (true - share * true[0])
            result += [
                Said(_of_both(name), relative, posterior.weights, off[:, j], covariances[:, j])
                for j, name in enumerate(names, start=1)
            ]
    return result


def _of_both(joint: str) -> str:
    return joint.replace('left_', 'right_')


def levels_and_densities(said: Sequence[Said], share: float, error: float) -> Array:
    """Levels and log densities (N, 2) of the true joints, with t and s."""
    result = np.empty((len(said), 2))
    for row, one in zip(result, said, strict=True):
        covariances = share * one.covariances + error**2 * np.eye(3)
        density = GaussianMixture(one.weights, one.means, covariances)
        drawn = stratified_samples(density, SAMPLES, np.random.default_rng(0))
        found = marginal_log_densities(density, np.concatenate([np.zeros((1, 3)), drawn]), 3)
        row[:] = levels_of(found[:1, 0], found[1:, 0])[0], found[0, 0]
    return result


def error_that_holds(said: Sequence[Said], share: float) -> tuple[float, Array]:
    """The s for which regions of level `HELD` cover as many true joints; levels and densities."""
    low, high = LEAST, MOST
    found = np.empty((0, 2))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        found = levels_and_densities(said, share, middle)
        if (found[:, 0] <= HELD).mean() < HELD:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high), found


def learned(said: Sequence[Said]) -> list[dict[str, Any]]:
    """For each t: s_j in mm, mean log density of a joint, coverage of 50 and 90 % regions."""
    names = list(dict.fromkeys(one.joint for one in said))
    relative, absolute = (
        {name: [x for x in said if x.joint == name and x.relative == kind] for name in names}
        for kind in (True, False)
    )
    result = []
    for share in told('joint_errors', SHARES, str):
        found = {name: error_that_holds(own, share) for name, own in relative.items()}
        near = np.concatenate([numbers for _, numbers in found.values()])
        whole = np.concatenate(
            [levels_and_densities(own, share, found[name][0]) for name, own in absolute.items()]
        )
        result.append(
            {
                'share': share,
                'errors_mm': {name: 1e3 * error for name, (error, _) in found.items()},
                'log_density': float(0.5 * (near[:, 1].mean() + whole[:, 1].mean())),
                'relative': _held(near),
                'absolute': _held(whole),
            }
        )
    return result


def _held(numbers: Array) -> list[float]:
    """Coverage of 50 and 90 % regions, from `levels_and_densities`."""
    return [float((numbers[:, 0] <= p).mean()) for p in (0.5, 0.9)]


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    joints = list(result['shares'][0]['errors_mm'])
    rows = [
        ['t', *(f's of {joint.removeprefix("right_")}, mm' for joint in joints), 'log density',
         'relative in 50 and 90 %', 'absolute in 50 and 90 %'],
    ]  # fmt: skip
    rows += [
        [
            f'{one["share"]:g}',
            *(f'{one["errors_mm"][joint]:.0f}' for joint in joints),
            f'{one["log_density"]:.2f}',
            *(f'{one[kind][0]:.0%}, {one[kind][1]:.0%}' for kind in ('relative', 'absolute')),
        ]
        for one in result['shares']
    ]
    return table(rows, markdown=markdown)


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Results of `learned` on the clips used for settings.

    Raises:
        FileNotFoundError: there are no clips.
        ValueError: one can not be read.
    """
    folders = with_file(CLIPS, clips, 'truth.npz')[: QUICK if quick else None]
    given = INPUTS[:1] if quick else INPUTS
    jobs = [(folder, inputs) for folder in folders for inputs in given]
    said = [
        one
        for job in told('joint_errors', jobs, lambda job: f'{job[0].name}, {job[1]}')
        for one in said_of(*job, QUICK_IMAGES if quick else None)
    ]
    return {'machine': description(), 'clips': [x.name for x in folders], 'shares': learned(said)}


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('joint_errors', __doc__, quick='a few images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(arguments)
    return run_benchmark(
        'joint_errors',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
