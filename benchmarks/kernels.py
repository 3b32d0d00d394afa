"""kernels: times of compiled functions, and of the evaluation of a pose by term.

--against FOLDER also measures in a checkout of another commit, which must be built, alternating
with this one, and prints the ratios.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show
from benchmarks.machine import best_time, description
from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.self_intersection import self_intersection_energy
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera, load_body
from hmt_ros.body.ground_terms import FloorPlane, GroundSettings, GroundTerm
from hmt_ros.body.kinematics import forward
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage
from hmt_ros.image.observation import observe
from hmt_ros.image.optical_flow import FlowTerm
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import seen_points
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.energy import Derivatives, Quadratic
from hmt_ros.tracking.selection import choose_hypotheses

Array = NDArray[np.float64]
CAMERA = Camera(660.0, 660.0, 319.5, 239.5, 640, 480)
PLACING, ALL = 'frames of the segments', 'all together'
# Kinds of derivatives by the name of their columns.
KINDS = {'value': Derivatives.NONE, 'sums': Derivatives.POSITIVE}
# Number of poses in a measured call; number of runs in each of two checkouts.
POSES, RUNS = 64, 5
QUICK = (PLACING, 'keypoints', 'motion')


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('kernels', __doc__, quick=f'less long, and only {", ".join(QUICK)}')
    parser.add_argument('--against', metavar='FOLDER', type=Path, help='checkout to compare with')
    options = parser.parse_args(argv)
    try:
        result = measure(quick=options.quick, against=options.against)
    except (OSError, RuntimeError) as error:
        parser.error(str(error))
    return show(result, as_text, as_json=options.json)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables."""
    ratios = 'ratio' in result['cases'][0]
    rows = [['what', 'batch', 'ms', *(['of the other'] if ratios else [])]]
    for one in result['cases']:
        rows.append([one['what'], str(one['batch']), f'{one["ms"]:.2f}'])
        rows[-1] += [f'{one["ratio"]:.2f}'] if ratios else []
    parts = [table(rows, markdown=markdown)]
    rows = [['of an evaluation']]
    for kind in KINDS:
        rows[0] += [f'{kind}, us', *(['of the other'] if ratios else [])]
    for entry in result['evaluation']:
        row = [entry['what']]
        for kind in KINDS:
            own = entry[kind]
            row += [f'{own["us"]:.1f}', *([f'{own["ratio"]:.2f}'] if ratios else [])]
        rows.append(row)
    parts.append(table(rows, markdown=markdown))
    return '\n\n'.join(parts)


def measure(*, quick: bool = False, against: Path | None = None) -> dict[str, Any]:
    """Times of compiled functions, and of the evaluation of a pose.

    Args:
        quick: shorter measurements of fewer terms.
        against: another checkout, compared by the medians of alternating runs.

    Raises:
        RuntimeError: the other checkout can not be measured.
    """
    if against is None:
        seconds = 0.05 if quick else 1.0
        return {
            'machine': description(),
            'cases': list(_cases(seconds)),
            'evaluation': list(_evaluation(seconds, QUICK if quick else None)),
        }
    here = Path(__file__).resolve().parent.parent
    runs: dict[Path, list[Any]] = {here: [], against.resolve(): []}
    for _ in range(1 if quick else RUNS):
        for folder, found in runs.items():
            found.append(_measured_in(folder, quick=quick))
    own, other = (_median(found) for found in runs.values())
    for mine, theirs in zip(own['cases'], other['cases'], strict=True):
        mine['ratio'] = mine['ms'] / theirs['ms']
    for mine, theirs in zip(own['evaluation'], other['evaluation'], strict=True):
        for kind in KINDS:
            mine[kind]['ratio'] = mine[kind]['us'] / theirs[kind]['us']
    return {**own, 'against': str(against)}


def _measured_in(folder: Path, *, quick: bool) -> Any:
    """Result of this benchmark in a checkout."""
    paths = [str(folder), *filter(None, os.environ.get('PYTHONPATH', '').split(os.pathsep))]
    command = [sys.executable, '-m', 'benchmarks', 'kernels', '--json']
    done = subprocess.run(
        [*command, *(['--quick'] if quick else [])],
        cwd=folder,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f'{folder} can not be measured: {done.stderr.strip()[-400:]}')
    return json.loads(done.stdout)


def _median(runs: Sequence[Any]) -> Any:
    """Several results as one, with the medians of their numbers."""
    if isinstance(runs[0], dict):
        return {key: _median([x[key] for x in runs]) for key in runs[0]}
    if isinstance(runs[0], list):
        return [_median(parts) for parts in zip(*runs, strict=True)]
    return float(np.median(runs)) if isinstance(runs[0], float) else runs[0]


def _cases(seconds: float) -> Iterator[dict[str, Any]]:
    """Times of selecting hypotheses, of flips and of self-intersection, ms."""
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
    """Times of one evaluation, us; terms without the time for the frames of the segments."""
    every, poses = energies(POSES)
    placed = dict.fromkeys(KINDS, 0.0)
    for what in names or every:
        times = {
            kind: 1e6
            / POSES
            * best_time(
                partial(every[what].energy, poses, derivatives=derivatives), seconds=seconds
            )
            for kind, derivatives in KINDS.items()
        }
        alone = what in {PLACING, ALL}
        yield {
            'what': what,
            **{kind: {'us': times[kind] - (0.0 if alone else placed[kind])} for kind in KINDS},
        }
        if what == PLACING:
            placed = times


def energies(poses: int) -> tuple[dict[str, PoseEnergy], Array]:
    """Energies of a walking person, for each term and for all, and random poses (N, d)."""
    body = load_body('human37')
    view = Viewpoint(distance=3.6)
    shown = procedural_motion('walk', body, 0.8, 10.0, 3, viewpoint=view)[4:6]
    _, now = render_frames(body, shown, CAMERA, Scene(viewpoint=view))
    rng = np.random.default_rng(0)
    pixels = CAMERA.project(body.joint_positions(shown[1:]))[0]
    pixels += 2.0 * rng.normal(size=pixels.shape)
    covariances = np.tile(4.0 * np.eye(2), (len(pixels), 1, 1))
    keypoints = Keypoints(body.joint_names, pixels, covariances, np.ones(len(pixels)))
    observation = observe(now.image, now.mask, keypoints=keypoints)
    x = shown[1] + 0.1 * rng.normal(size=(poses, body.dimension))
    x[:, :3] = shown[1, :3] + 0.03 * rng.normal(size=(poses, 3))
    x = np.clip(x, body.lower, body.upper)

    likelihood = ImageLikelihood(body, CAMERA, threads=1)
    image, joints = likelihood.seen(observation)
    prior, overlaps = likelihood.priors
    ground = GroundTerm(
        body, GroundSettings(), FloorPlane(np.array([0.0, -1.0, 0.0]), 0.05, 1.2, 0.02)
    )
    flow = FlowTerm(
        seen_points(body, CAMERA, forward(body.skeleton, x)),
        ImageMap(rng.normal(0.0, 3.0, (2, 480, 640)).astype(np.float32)), 5.0,
    )  # fmt: skip
    nothing = PoseEnergy(likelihood, ())

    def without(name: str) -> PoseEnergy:
        own = getattr(likelihood.settings, name)
        settings = replace(likelihood.settings, **{name: replace(own, weight=0.0)})
        fewer = replace(likelihood, settings=settings)
        return PoseEnergy(fewer, (ObservedImage(fewer, observation),))

    return {
        PLACING: nothing,
        'image, contour and coverage': without('edges'),
        'image, contour and edges': without('coverage'),
        'keypoints': replace(nothing, terms=(joints,)),
        'pose prior': replace(nothing, terms=(prior,)),
        'self-intersection': replace(nothing, terms=(overlaps,)),
        'ground': replace(nothing, terms=(ground,)),
        'optical flow': replace(nothing, terms=(flow,)),
        'motion': replace(nothing, motion=Quadratic(shown[1], 5.0 * np.eye(body.dimension))),
        ALL: PoseEnergy(
            likelihood, (image, joints, prior, overlaps, ground),
            Quadratic(shown[1], 5.0 * np.eye(body.dimension)),
        ),
    }, x  # fmt: skip


def _any_poses(count: int) -> Any:
    body = load_body('human37')
    rng = np.random.default_rng(1)
    spread = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.0)
    poses = body.prior_mean + spread * rng.normal(size=(count, body.dimension))
    poses[:, :3] = [0.0, 0.0, 4.0]
    return np.clip(poses, body.lower, body.upper)
