"""lifting: poses from keypoints alone, without images and without a track, on clips with truth.

The mixtures of `experts.lifter` on a real detector's keypoints, with later images and without,
gravity given and not, lengths usual or measured:
distances of the heaviest and of the best pose, of the heaviest after the similarity that fits best,
slanted limbs whose slope has the wrong sign, and regions of single joints. The detector's own 3D
stands beside. Clips that settings were chosen on, and the others, apart.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import SCHEME, find_clips, read_clip, read_detections, table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import description
from benchmarks.runs import GIVEN, UNKNOWN, in_processes, recorded
from benchmarks.tracking_means import GROUPS, group_of
from benchmarks.tracking_scores import detector_scores, scores_of
from hmt_ros.body import load_body
from hmt_ros.experts.keypoint_training import (
    WindowSettings,
    keypoint_tracks,
    training_windows,
)
from hmt_ros.experts.lifted_fit import UNKNOWN_SIZE, lift_poses, poses_of
from hmt_ros.experts.lifter import SHIPPED, KeypointHistory, load_lifter
from hmt_ros.experts.lifter_learning import PELVIS, SCORED, lifter_scores
from hmt_ros.experts.predictor_learning import kinds, new_model
from hmt_ros.experts.training_set import motion_files, recorded_sequence
from hmt_ros.tracking import read_subject
from hmt_ros.tracking.initialisation import start_from_keypoints

QUICK = 2
SCORES = (
    'heaviest_mm', 'best_mm', 'aligned_mm', 'wrong_sign', 'joint_coverage_90', 'weights',
)  # fmt: skip
HEADS = ('heaviest', 'best', 'PA', 'wrong sign, %', '90 % regions, %', 'log(K w)')
IMAGES, LENGTHS = ('all images', 'causal'), ('usual', 'known')
CONDITIONS = tuple(product(IMAGES, (UNKNOWN, GIVEN), LENGTHS))
# Images that the cost is the median of.
TIMED = 60
# Windows that contenders learn from, and are tested on; principal components of their inputs.
WINDOWS, TESTED, COMPONENTS = 4000, 1000, 64


def lifted(work: tuple[Path, str, tuple[str, str, str]]) -> dict[str, float]:
    """Scores of one clip: folder, lifter, and what is known."""
    folder, model, (images, gravity, lengths) = work
    clip, usual = read_clip(folder), load_body('human37')
    found = read_detections(folder).keypoints
    stamps = [s for s in clip.stamps if s in found and found[s].seen.any()]
    ups = None
    if gravity == GIVEN:
        ups = np.array([clip.ups.get(stamp, np.zeros(3)) for stamp in stamps])
    body, seen = usual, [found[stamp] for stamp in stamps]
    if lengths == 'known':
        body = start_from_keypoints(usual, clip.camera, read_subject(clip.subject, usual)).body
    mixtures = lift_poses(
        load_lifter(model), body, clip.camera, 1e-9 * np.array(stamps, dtype=np.float64),
        seen, ups, lengths_known=lengths != 'usual', causal=images == 'causal',
        scheme=SCHEME,
    )  # fmt: skip
    rows = [
        i for i, stamp in enumerate(stamps)
        if mixtures[i] is not None and stamp in clip.truth.joints
    ]  # fmt: skip
    chosen = [mixture for i in rows if (mixture := mixtures[i]) is not None]
    record = recorded(
        clip, [body] * len(rows), chosen, [one.means[0] for one in chosen],
        [stamps[i] for i in rows], [0.0] * len(rows), [0.0] * len(rows), 0,
    )  # fmt: skip
    scores = scores_of(replace(record, cpu_seconds=np.zeros(0)))
    return {name: float(scores[name]) for name in SCORES}


def cost(folder: Path, model: str) -> dict[str, float]:
    """Median times of a prediction on one core, ms: of the mixture, and of its poses."""
    clip, body, lifter = read_clip(folder), load_body('human37'), load_lifter(model)
    found = read_detections(folder).keypoints
    history, mixture, poses = KeypointHistory(clip.camera), [], []
    for stamp in clip.stamps[: TIMED + 5]:
        start = time.perf_counter()
        rays, sure = history.add(found[stamp], 1e-9 * stamp)
        one = history.lift(lifter)
        between = time.perf_counter()
        if one is not None:
            poses_of(body, [one], rays[None], sure[None], UNKNOWN_SIZE)
        mixture.append(between - start)
        poses.append(time.perf_counter() - between)
    return {
        'mixture_ms': 1e3 * float(np.median(mixture[5:])),
        'poses_ms': 1e3 * float(np.median(poses[5:])),
    }


def contenders(mocap: Path, model: str, *, quick: bool = False) -> list[dict[str, Any]]:
    """Scores of models on windows of other people: the same motions, inputs and errors.

    Models of kernels and neighbours learn from as many windows as they can take; their inputs are
    principal components, as those of silhouettes are.

    Args:
        mocap: folder with `train`, to learn from, and `dev`, of other people.
        model: lifter.
        quick: few windows.
    """
    lifter = load_lifter(model)
    body, settings = lifter.usual, WindowSettings()
    drawn = []
    for part, count in (('train', WINDOWS), ('dev', TESTED)):
        motions = motion_files(mocap / part)[: 3 if quick else None]
        read = [recorded_sequence(path, body) for path in told(f'lifting: {part}', motions)]
        tracks = keypoint_tracks(
            body, read, [1.0] * len(read), variants=2 if part == 'train' else 1
        )
        rng = np.random.default_rng(0)
        drawn.append(training_windows(tracks, count // (10 if quick else 1), rng, settings))
    (inputs, joints), (seen, true) = drawn
    mean, scale = inputs.mean(0), inputs.std(0) + 0.1
    _, _, axes = np.linalg.svd((inputs - mean) / scale, full_matrices=False)
    axes = axes[:COMPONENTS].T
    learned, tested = (((x - mean) / scale @ axes).astype(np.float64) for x in (inputs, seen))
    targets = joints.reshape(len(joints), -1).astype(np.float64)
    found = lifter_scores(lifter, seen, true)
    rows = [{'model': 'what ships', **asdict(found)}]
    for name in told('lifting: contenders', kinds()):
        one = new_model(name, None, 0, len(learned)).fit(learned, targets)
        weights, means, _ = one.predict_arrays(tested)
        density = one.log_density(tested, true.reshape(len(true), -1)) / targets.shape[1]
        places = means.reshape(*means.shape[:2], -1, 3)
        off = places[:, :, SCORED] - places[:, :, [PELVIS]]
        wanted = true[:, SCORED] - true[:, [PELVIS]]
        distance = np.linalg.norm(off - wanted[:, None], axis=3).mean(2)
        heaviest = distance[np.arange(len(distance)), weights.argmax(1)]
        rows.append(
            {
                'model': name, 'heaviest': float(heaviest.mean()),
                'best': float(np.where(weights > 1e-3, distance, np.inf).min(1).mean()),
                'log_density': float(density.mean()), 'within': float('nan'),
            }
        )  # fmt: skip
    return rows


def measure(
    clips: Path | None = None,
    model: str = SHIPPED,
    mocap: Path | None = None,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Scores over clips.

    Args:
        clips: folder of the clips; None: the development clips.
        model: lifter.
        mocap: folder of motion capture, for the contenders; None: they are left out.
        quick: two clips.
    """
    folders, source = find_clips(clips, moving=True)
    folders = [x for x in folders if (x / 'keypoints_mediapipe.npz').exists()]
    folders = folders[:QUICK] if quick else folders
    if not folders:
        raise FileNotFoundError(f'{source} has no keypoints_mediapipe.npz')
    work = [(folder, model, kind) for kind in CONDITIONS for folder in folders]
    scores = dict(zip(work, in_processes(lifted, work, 0, 'lifting'), strict=True))
    entries = []
    for group in GROUPS:
        own = [folder for folder in folders if group_of(folder.name) == group]
        if not own:
            continue
        for kind in CONDITIONS:
            each = [scores[folder, model, kind] for folder in own]
            means = {name: float(np.nanmean([x[name] for x in each])) for name in SCORES}
            entries.append({'clips': group, 'kind': list(kind), **means})
        of_detector = [detector_scores(folder) for folder in own]
        for one in of_detector:
            one['heaviest_mm'] = one['point_mm']
        said = ('heaviest_mm', 'aligned_mm')
        means = dict.fromkeys(SCORES, float('nan'))
        means |= {name: float(np.mean([x[name] for x in of_detector])) for name in said}
        entries.append({'clips': group, 'kind': ['the detector', '', ''], **means})
    by_clip = [
        {'clip': folder.name, 'kind': list(kind), **scores[folder, model, kind]}
        for kind in CONDITIONS for folder in folders
    ]  # fmt: skip
    return {
        'machine': description(), 'model': model, 'means': entries, 'clips': by_clip,
        'cost': cost(folders[0], model), 'source': source,
        'contenders': [] if mocap is None else contenders(mocap, model, quick=quick),
    }  # fmt: skip


def _cells(entry: dict[str, Any]) -> list[str]:
    scale = {'wrong_sign': 100.0, 'joint_coverage_90': 100.0}
    digits = {'weights': 2}
    values = [scale.get(name, 1.0) * entry[name] for name in SCORES]
    return [
        '-' if not np.isfinite(value) else f'{value:.{digits.get(name, 0)}f}'
        for name, value in zip(SCORES, values, strict=True)
    ]


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """The numbers as tables; mm unless said."""
    parts = []
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows = [[group, 'gravity', 'lengths', *HEADS]]
        rows += [[*x['kind'], *_cells(x)] for x in result['means'] if x['clips'] == group]
        parts.append(table(rows, left=3, markdown=markdown))
    chosen = ['causal', GIVEN, 'known']
    rows = [['clip; causal, gravity and lengths known', *HEADS]]
    rows += [[x['clip'], *_cells(x)] for x in result['clips'] if x['kind'] == chosen]
    parts.append(table(rows, markdown=markdown))
    if result['contenders']:
        rows = [['on motions of other people', 'heaviest', 'best', 'nats a number']]
        rows += [
            [
                x['model'], f'{1e3 * x["heaviest"]:.0f}', f'{1e3 * x["best"]:.0f}',
                f'{x["log_density"]:.2f}',
            ]
            for x in result['contenders']
        ]  # fmt: skip
        parts.append(table(rows, markdown=markdown))
    spent = result['cost']
    parts.append(
        f'a prediction on one core: {spent["mixture_ms"]:.2f} ms, '
        f'its poses {spent["poses_ms"]:.1f} ms'
    )
    return '\n\n'.join(parts)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('lifting', __doc__, quick='two clips')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--lifter', default=SHIPPED, help='file that learn-lifter wrote')
    parser.add_argument('--mocap', type=Path, help='folder of motion capture, for contenders')
    options = parser.parse_args(arguments)
    try:
        result = measure(options.clips, options.lifter, options.mocap, quick=options.quick)
    except FileNotFoundError as error:
        print(f'lifting: skipped, {error}', file=sys.stderr)
        return 0
    return show(result, as_text, as_json=options.json)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
