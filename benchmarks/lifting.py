"""lifting: poses from keypoints alone, without images and without a track, on clips with truth.

The mixtures of `experts.lifter` on a real detector's keypoints, with later images and without,
gravity given and not, lengths usual or measured:
distances of the heaviest and of the best pose, of the heaviest after the similarity that fits best,
slanted limbs whose slope has the wrong sign, and regions of single joints. The detector's own 3D
stands beside. Clips that settings were chosen on, and the others, apart. With motion capture of
other people: the models that could be in its place, and how it does on poses that are rare.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.clips import SCHEME, find_clips, read_clip, read_detections, table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.experts_motion import mocap_folder
from benchmarks.machine import description
from benchmarks.runs import GIVEN, UNKNOWN, in_processes, recorded
from benchmarks.tracking_means import GROUPS, group_of
from benchmarks.tracking_scores import detector_scores, scores_of
from hmt_learning.app.motions import read_motions, shares_of
from hmt_learning.training.keypoint_training import (
    JOINTS,
    VARIANTS,
    KeypointTracks,
    WindowSettings,
    keypoint_tracks,
    training_windows,
)
from hmt_learning.training.lifter_learning import PELVIS, SCORED, lifter_scores
from hmt_learning.training.predictor_learning import kinds, new_model
from hmt_learning.training.training_set import motion_files, recorded_sequence
from hmt_ros.body import load_body
from hmt_ros.experts.lifted_fit import UNKNOWN_SIZE, lift_poses, poses_of
from hmt_ros.experts.lifter import SHIPPED, KeypointHistory, Lifter, load_lifter
from hmt_ros.image.lifted_poses import HIPS
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
# Windows that contenders learn from by name, and are tested on; principal components of inputs.
WINDOWS = {
    'network': 40_000, 'local': 40_000, 'nearest': 40_000, 'conditional': 4000, 'joint': 4000,
    'relevance-vector': 4000,
}  # fmt: skip
TESTED, COMPONENTS = 1000, 64
# Windows whose poses are rare or not; poses that were learned from; groups by rarity.
RARE, KNOWN, QUARTERS = 4000, 40_000, 4
CERTAIN = WindowSettings(
    cut=0.0, causal=1.0, gravity_spread=0.0, gravity=1.0, lengths_spread=0.0, lengths=1.0
)
LEARNED = ('train', 'train_more', 'train_wide')
# Motions that are few exercises, each done many times, and how often these are drawn.
ALIKE, ALIKE_SHARE = 'prmd', 0.35


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


class Motions(NamedTuple):
    """Tracks of the motions that a lifter learned from, and of other people's."""

    learned: KeypointTracks
    others: KeypointTracks


def motions_of(lifter: Lifter, mocap: Path, *, quick: bool = False) -> Motions:
    """The motions in the card of a lifter, and those of `dev`, under a folder of motion capture."""
    # The card ends with the names of the motions.
    names = set(str(lifter.notes.get('card', '')).rpartition(' s: ')[2].rstrip('.').split(', '))
    found = []
    for parts, variants in ((LEARNED, VARIANTS), (('dev',), 1)):
        files = [x for part in parts if (mocap / part).is_dir() for x in motion_files(mocap / part)]
        files = [x for x in files if parts != LEARNED or x.stem in names]
        files = files[: 3 if quick else None]
        read = read_motions('lifting', files, lifter.usual.name, recorded_sequence)
        shares = shares_of(read, ALIKE, ALIKE_SHARE)
        found.append(keypoint_tracks(lifter.usual, read, shares, variants=variants))
    return Motions(*found)


def contenders(motions: Motions, lifter: Lifter, *, quick: bool = False) -> list[dict[str, Any]]:
    """Scores of models on windows of other people: the same motions, inputs and errors.

    Models of kernels learn from as many windows as they can take; the inputs of all are principal
    components, as those of silhouettes are.

    Args:
        motions: to learn from, and of other people.
        lifter: what ships.
        quick: few windows.
    """
    settings, size = WindowSettings(), 10 if quick else 1
    rng = np.random.default_rng(0)
    inputs, joints = training_windows(motions.learned, max(WINDOWS.values()) // size, rng, settings)
    seen, true = training_windows(motions.others, TESTED // size, rng, settings)
    mean, scale = inputs.mean(0), inputs.std(0) + 0.1
    some = (inputs[: WINDOWS['conditional']] - mean) / scale
    axes = np.linalg.svd(some, full_matrices=False)[2][:COMPONENTS].T
    learned, tested = (((x - mean) / scale @ axes).astype(np.float64) for x in (inputs, seen))
    targets = joints.reshape(len(joints), -1).astype(np.float64)
    found = lifter_scores(lifter, seen, true)
    rows: list[dict[str, Any]] = [{'model': 'what ships', 'windows': 0, **asdict(found)}]
    for name in told('lifting: contenders', kinds()):
        count = WINDOWS[name] // size
        one = new_model(name, None, 0, count).fit(learned[:count], targets[:count])
        weights, means, _ = one.predict_arrays(tested)
        density = one.log_density(tested, true.reshape(len(true), -1)) / targets.shape[1]
        places = means.reshape(*means.shape[:2], -1, 3)
        off = places[:, :, SCORED] - places[:, :, [PELVIS]]
        wanted = true[:, SCORED] - true[:, [PELVIS]]
        distance = np.linalg.norm(off - wanted[:, None], axis=3).mean(2)
        heaviest = distance[np.arange(len(distance)), weights.argmax(1)]
        rows.append(
            {
                'model': name, 'windows': count, 'heaviest': float(heaviest.mean()),
                'best': float(np.where(weights > 1e-3, distance, np.inf).min(1).mean()),
                'log_density': float(density.mean()), 'within': float('nan'),
            }
        )  # fmt: skip
    return rows


def by_rarity(motions: Motions, lifter: Lifter, *, quick: bool = False) -> list[dict[str, float]]:
    """Scores on other people's windows, by how far the nearest pose is that was learned from.

    Args:
        motions: that were learned from, and of other people.
        lifter: what ships.
        quick: few windows.
    """
    rng, size = np.random.default_rng(0), 20 if quick else 1
    _, learned = training_windows(motions.learned, KNOWN // size, rng, CERTAIN)
    inputs, joints = training_windows(motions.others, RARE // size, rng, CERTAIN)
    away, _ = cKDTree(_turned(learned)).query(_turned(joints))
    away = away / np.sqrt(len(JOINTS))
    rows = []
    for quarter in np.array_split(np.argsort(away), QUARTERS):
        found = lifter_scores(lifter, inputs[quarter], joints[quarter])
        rows.append({'nearest': float(np.median(away[quarter])), **asdict(found)})
    return rows


def _turned(joints: Any) -> Any:
    """Joints (N, 3 J) of persons who are turned until their hips are level and across."""
    left, right = (joints[:, JOINTS.index(name)] for name in HIPS)
    neck = joints[:, JOINTS.index('neck')]
    x = left - right
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    z = np.cross(x, neck)
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    frame = np.stack([x, np.cross(z, x), z], axis=1)
    return np.einsum('nij,nkj->nki', frame, joints).reshape(len(joints), -1)


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
        mocap: folder of motion capture, for the contenders; None: the shared one, if there is one.
        quick: two clips, and no contenders unless `mocap` is given.
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
    against: dict[str, Any] = {'contenders': [], 'rarity': []}
    if (mocap := mocap or (None if quick else shared_mocap())) is not None:
        lifter = load_lifter(model)
        motions = motions_of(lifter, mocap, quick=quick)
        against = {
            'contenders': contenders(motions, lifter, quick=quick),
            'rarity': by_rarity(motions, lifter, quick=quick),
        }
    return {
        'machine': description(), 'model': model, 'means': entries, 'clips': by_clip,
        'cost': cost(folders[0], model), 'source': source, **against,
    }  # fmt: skip


def shared_mocap() -> Path | None:
    """The folder of motion capture, if there is one."""
    try:
        return mocap_folder('dev').parent
    except ValueError:
        return None


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
        rows = [['on motions of other people', 'windows', 'heaviest', 'best', 'nats a number']]
        rows += [
            [
                x['model'], str(x['windows'] or 'all'), f'{1e3 * x["heaviest"]:.0f}',
                f'{1e3 * x["best"]:.0f}', f'{x["log_density"]:.2f}',
            ]
            for x in result['contenders']
        ]  # fmt: skip
        parts.append(table(rows, markdown=markdown))
    if result['rarity']:
        rows = [['nearest pose learned from, mm', 'heaviest', 'best', 'nats', '90 % marginals, %']]
        rows += [
            [
                f'{1e3 * x["nearest"]:.0f}', f'{1e3 * x["heaviest"]:.0f}', f'{1e3 * x["best"]:.0f}',
                f'{x["log_density"]:.2f}', f'{100 * x["within"]:.0f}',
            ]
            for x in result['rarity']
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
