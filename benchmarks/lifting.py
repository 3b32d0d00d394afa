"""lifting: poses from keypoints alone, without images and without a track, on clips with truth.

Mixtures of `experts.lifter` on a real detector's keypoints, with and without later images, with and
without gravity, with usual or measured lengths. Scores: errors of the heaviest and of the best
pose, of the heaviest after the best similarity transform, share of slanted limbs with a wrong sign
of the slope, and coverage of single joints. The detector's own 3D is given for comparison. Clips
used for settings are separate from the others.
"""

from __future__ import annotations

import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import SCHEME, find_clips, read_clip, read_detections, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import GIVEN, UNKNOWN, in_processes, recorded
from benchmarks.tracking_means import GROUPS, group_of
from benchmarks.tracking_scores import detector_scores, scores_of
from hmt_ros.body import load_body
from hmt_ros.experts.lifted_fit import UNKNOWN_SIZE, lift_poses, poses_of
from hmt_ros.experts.lifter import SHIPPED, KeypointHistory, load_lifter
from hmt_ros.tracking import read_subject
from hmt_ros.tracking.initialisation import start_from_keypoints

QUICK = 12  # number of images with --quick
SCORES = (
    'heaviest_mm', 'best_mm', 'aligned_mm', 'wrong_sign', 'joint_coverage_90', 'weights',
)  # fmt: skip
HEADS = ('heaviest', 'best', 'PA', 'wrong sign, %', '90 % regions, %', 'log(K w)')
IMAGES, LENGTHS = ('all images', 'causal'), ('usual', 'known')
CONDITIONS = tuple(product(IMAGES, (UNKNOWN, GIVEN), LENGTHS))
# Number of images for the median cost.
TIMED = 60


def lifted(work: tuple[Path, str, tuple[str, str, str], int | None]) -> dict[str, float]:
    """Scores of one clip, given folder, lifter, conditions, and number of images or None."""
    folder, model, (images, gravity, lengths), limit = work
    clip, usual = read_clip(folder, limit), load_body('human37')
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
        [stamps[i] for i in rows], 0,
    )  # fmt: skip
    scores = scores_of(record)
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


def measure(
    clips: Path | None = None,
    model: str = SHIPPED,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Scores over clips.

    Args:
        clips: folder of the clips; None means the development clips.
        model: name or file of the lifter.
        quick: the first images of one clip.
    """
    folders, source = find_clips(clips, moving=True)
    folders = [x for x in folders if (x / 'keypoints_mediapipe.npz').exists()]
    folders, limit = (folders[:1], QUICK) if quick else (folders, None)
    if not folders:
        raise FileNotFoundError(f'{source} has no keypoints_mediapipe.npz')
    kinds = CONDITIONS[-1:] if quick else CONDITIONS
    work = [(folder, model, kind, limit) for kind in kinds for folder in folders]
    scores = dict(zip(work, in_processes(lifted, work, 1 if quick else 0, 'lifting'), strict=True))
    entries = []
    for group in GROUPS:
        own = [folder for folder in folders if group_of(folder.name) == group]
        if not own:
            continue
        for kind in kinds:
            each = [scores[folder, model, kind, limit] for folder in own]
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
        {'clip': folder.name, 'kind': list(kind), **scores[folder, model, kind, limit]}
        for kind in kinds for folder in folders
    ]  # fmt: skip
    return {
        'machine': description(), 'model': model, 'means': entries, 'clips': by_clip,
        'cost': cost(folders[0], model), 'source': source,
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
    """The numbers as tables; mm unless stated otherwise."""
    parts = []
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows = [[group, 'gravity', 'lengths', *HEADS]]
        rows += [[*x['kind'], *_cells(x)] for x in result['means'] if x['clips'] == group]
        parts.append(table(rows, left=3, markdown=markdown))
    chosen = ['causal', GIVEN, 'known']
    rows = [['clip; causal, gravity and lengths known', *HEADS]]
    rows += [[x['clip'], *_cells(x)] for x in result['clips'] if x['kind'] == chosen]
    parts.append(table(rows, markdown=markdown))
    spent = result['cost']
    parts.append(
        f'a prediction on one core: {spent["mixture_ms"]:.2f} ms, '
        f'its poses {spent["poses_ms"]:.1f} ms'
    )
    return '\n\n'.join(parts)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser(
        'lifting', __doc__, quick=f'{QUICK} images of one clip, all of it known'
    )
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--lifter', default=SHIPPED, help='file that learn lifter wrote')
    options = parser.parse_args(arguments)
    return run_benchmark(
        'lifting',
        lambda: measure(options.clips, options.lifter, quick=options.quick),
        as_text,
        as_json=options.json,
    )
