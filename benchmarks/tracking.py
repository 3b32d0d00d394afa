"""tracking: accuracy, calibration and speed of the tracker on clips with known truth.

The tracker is given the images, the images with the keypoints of a detector, or these keypoints
alone. Clips on which its settings were chosen are told apart from the others. Runs are kept in
build/benchmarks/tracking until the code changes: a benchmark that was broken off goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import find_clips, read_clip
from benchmarks.command import benchmark_parser, show
from benchmarks.machine import description
from benchmarks.runs import (
    IMAGES,
    INPUTS,
    STARTS,
    SUBJECT,
    Run,
    run_all,
)
from benchmarks.tracker_changes import changed, parsed_changes
from benchmarks.tracking_oracle import oracle
from benchmarks.tracking_scores import detector_scores, interval, scores_of
from benchmarks.tracking_speed import memory, speed
from benchmarks.tracking_tables import COMPARED, HEAVIEST, OF_ABLATIONS, as_text
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.tracking import TrackerSettings

Array = NDArray[np.float64]

PARTS = ('accuracy', 'ablations', 'sizes', 'oracle', 'speed')
SEEDS = (0, 1, 2)
# Clips that settings of the tracker were chosen on.
CHOSEN = ('walk', 'charleston', 'wander', 'shoot', 'signals', 'scoop', 'kick', 'follow')
GROUPS = {True: 'Clips that settings were chosen on', False: 'Other clips'}
DETECTOR = 'MediaPipe 3D'
ABLATIONS: tuple[tuple[str, Any], ...] = (
    *(('max_hypotheses', k) for k in (1, 2, 4, 8, 16)),
    ('reweighting', 'ancestry'),
    ('reweighting', 'bhattacharyya'),
)
TIMED = 'walk'  # if it is there
SIZED = 'signals'  # if it is there
SIZES = (0.25, 0.5, 1.0)  # of the images
QUICK = 20  # images a clip


def main(argv: list[str]) -> int:
    """Runs the benchmark; 1: there is nothing to run it on, or no such setting."""
    parser = benchmark_parser('tracking', __doc__, quick=f'{QUICK} images a clip, one seed')
    parser.add_argument('--markdown', action='store_true', help='tables for a Markdown page')
    parser.add_argument(
        '--clips', type=Path, metavar='DIR', help='their folder (the development clips, or bags/)'
    )
    parser.add_argument('--only', nargs='+', default=(), metavar='NAME', help='some of the clips')
    parser.add_argument('--inputs', nargs='+', choices=INPUTS, default=INPUTS)
    parser.add_argument(
        '--start', choices=STARTS, default=SUBJECT,
        help='start from the subject file of a clip, or from its keypoints where they are an input',
    )  # fmt: skip
    parser.add_argument('--seeds', type=int, nargs='+', default=SEEDS, metavar='N')
    parser.add_argument(
        '--parts', nargs='+', choices=PARTS, help='all, or none where settings are compared'
    )
    parser.add_argument(
        '--against', nargs='+', default=(), metavar='SETTING=VALUE',
        help='compare the tracker with itself with these settings, such as max_hypotheses=4',
    )  # fmt: skip
    parser.add_argument(
        '--processes', type=int, default=0, metavar='N', help='of one thread each (one a core)'
    )
    parser.add_argument(
        '--frames', type=int, default=0, metavar='N',
        help='follow memory over so many images of a clip that is played back and forth',
    )  # fmt: skip
    options = parser.parse_args(argv)
    parts = options.parts or (() if options.against else PARTS)
    try:
        result = measure(
            options.clips, options.only, options.inputs, options.seeds, parts,
            parsed_changes(options.against), options.processes, options.frames,
            quick=options.quick, start=options.start,
        )  # fmt: skip
    except ValueError as error:
        print(f'tracking: {error}', file=sys.stderr)
        return 1
    return show(result, partial(as_text, markdown=options.markdown), as_json=options.json)


def measure(
    clips: Path | None = None,
    only: Sequence[str] = (),
    inputs: Sequence[str] = INPUTS,
    seeds: Sequence[int] = SEEDS,
    parts: Sequence[str] = PARTS,
    against: tuple[tuple[str, Any], ...] = (),
    processes: int = 0,
    frames: int = 0,
    *,
    quick: bool = False,
    start: str = SUBJECT,
) -> dict[str, Any]:
    """Everything that was asked for.

    Args:
        clips: their folder; None: the development clips, or bags/.
        only: names of some of them; empty: all.
        inputs: some of `runs.INPUTS`.
        seeds: of the tracker.
        parts: some of `PARTS`.
        against: changed settings that the tracker is compared with; empty: no comparison.
        processes: number of processes; 0: one a core.
        frames: over so many images memory is followed.
        quick: 20 images a clip, one seed.
        start: what tracks start from, one of `runs.STARTS`; with images alone always the subject.

    Raises:
        ValueError: there is no such clip, or it can not be read.
    """
    folders, source = find_clips(clips, moving=True)
    limit, seeds = (QUICK, seeds[:1]) if quick else (None, seeds)
    if only:
        folders = [folder for folder in folders if folder.name in only]
    if not folders:
        raise ValueError(f'none of the clips {list(only)} is there')
    lacking = [folder.name for folder in folders if not _has_keypoints(folder)]
    runs = [
        Run(folder, given, seed, limit=limit, start=SUBJECT if given == IMAGES else start)
        for folder in folders
        for given in inputs
        if given == IMAGES or folder.name not in lacking
        for seed in seeds
    ]
    result: dict[str, Any] = {
        'machine': description(),
        'clips': source,
        'seeds': list(seeds),
        'without_keypoints': lacking if set(inputs) - {IMAGES} else [],
    }
    if 'accuracy' in parts:
        entries = accuracy(runs, processes)
        entries += [
            _entry(folder.name, DETECTOR, [detector_scores(folder, limit)])
            for folder in folders
            if folder.name not in lacking
        ]
        result['accuracy'] = grouped(entries)
    if against:
        result['against'] = comparison(runs, against, processes)
    if 'ablations' in parts:
        result['ablations'] = ablations(folders, limit, processes)
    if 'sizes' in parts:
        sized = next((folder for folder in folders if folder.name == SIZED), folders[0])
        result['sizes'] = errors_by_size(sized, seeds, limit, processes)
    if 'oracle' in parts:
        result['oracle'] = oracle(folders, limit, processes)
    still = [folder for folder in folders if (folder / 'background.png').is_file()]
    timed = next((folder for folder in still if folder.name == TIMED), still[-1] if still else None)
    if timed is not None and 'speed' in parts:
        result['speed'] = speed(read_clip(timed, QUICK if quick else 60))
    if timed is not None and frames > 0:
        result['memory'] = memory(read_clip(timed), frames)
    return result


def _has_keypoints(folder: Path) -> bool:
    return (folder / 'keypoints_mediapipe.npz').is_file()


# Accuracy.


def accuracy(runs: Sequence[Run], processes: int = 0) -> list[dict[str, Any]]:
    """Scores of each clip and input, means over the seeds."""
    return [
        _entry(clip, given, [scores for _, scores in found])
        for (clip, given), found in _by_clip(runs, processes).items()
    ]


def _by_clip(
    runs: Sequence[Run], processes: int
) -> dict[tuple[str, str], list[tuple[Run, dict[str, Any]]]]:
    """Scores of runs, by clip and input."""
    result: dict[tuple[str, str], list[tuple[Run, dict[str, Any]]]] = {}
    for one, record in zip(runs, run_all(runs, processes), strict=True):
        result.setdefault((one.clip, one.inputs), []).append((one, scores_of(record)))
    return result


def _entry(clip: str, given: str, scores: list[dict[str, Any]]) -> dict[str, Any]:
    """Scores of a clip by seed, and their means; None: unknown."""
    numbers = {
        key: [_known(one[key]) for one in scores] for key in scores[0] if key != 'by_joint_90'
    }
    result: dict[str, Any] = {'clip': clip, 'inputs': given, 'by_seed': numbers}
    for key, values in numbers.items():
        known = [value for value in values if value is not None]
        result[key] = float(np.mean(known)) if len(known) == len(values) else None
    if 'by_joint_90' in scores[0]:
        shares = np.mean([one['by_joint_90'] for one in scores], axis=0)
        result['by_joint_90'] = dict(zip(EVALUATED_JOINTS, map(_known, shares), strict=True))
    return result


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def grouped(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Clips that settings were chosen on, and the others, with means over the clips."""
    result = []
    for chosen, title in GROUPS.items():
        mine = [entry for entry in entries if (entry['clip'] in CHOSEN) == chosen]
        mine.sort(key=lambda entry: (entry['clip'], _rank(entry['inputs'])))
        if mine:
            result.append({'group': title, 'clips': mine, 'means': means_of(mine)})
    return result


def _rank(given: str) -> int:
    return (*INPUTS, DETECTOR).index(given)


def means_of(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the clips by input: mean, lower and upper end; see `tracking_scores.interval`."""
    result = []
    for given in sorted({entry['inputs'] for entry in entries}, key=_rank):
        mine = [entry for entry in entries if entry['inputs'] == given]
        means: dict[str, Any] = {'inputs': given}
        for key in mine[0]['by_seed']:
            values = np.array([entry['by_seed'][key] for entry in mine], dtype=float)
            means[key] = interval(values)
        if 'by_joint_90' in mine[0]:
            shares = np.array([[*entry['by_joint_90'].values()] for entry in mine], dtype=float)
            known = np.isfinite(shares)
            sums = np.where(known, shares, 0.0).sum(0)
            means['by_joint_90'] = {
                name: float(total / count) if count else None
                for name, total, count in zip(EVALUATED_JOINTS, sums, known.sum(0), strict=True)
            }
        result.append(means)
    return result


def comparison(
    runs: Sequence[Run], changes: tuple[tuple[str, Any], ...], processes: int = 0
) -> dict[str, Any]:
    """What changed settings change on the same clips, inputs and seeds: their scores minus ours."""
    others = [replace(one, changes=changes) for one in runs]
    entries = []
    for (clip, given), found in _by_clip([*runs, *others], processes).items():
        ours = [scores for one, scores in found if not one.changes]
        theirs = [scores for one, scores in found if one.changes]
        differences = [
            {column.key: own[column.key] - usual[column.key] for column in COMPARED}
            for usual, own in zip(ours, theirs, strict=True)
        ]
        entries.append(_entry(clip, given, differences))
    return {
        'changes': [f'{name}={value}' for name, value in changes],
        'groups': grouped(entries),
        'means': means_of(entries),
    }


def ablations(folders: Sequence[Path], limit: int | None, processes: int = 0) -> dict[str, Any]:
    """Scores of other numbers of modes and of the other weights, from images alone, one seed.

    On the clips that settings were chosen on; on all where none of them is there.
    """
    folders = [folder for folder in folders if folder.name in CHOSEN] or list(folders)
    variants = [
        # The usual setting is no change: its runs are those of the accuracy.
        () if changed((change,)) == TrackerSettings() else (change,)
        for change in ABLATIONS
    ]
    runs = [Run(folder, IMAGES, 0, own, limit) for own in variants for folder in folders]
    found = {
        one: scores_of(record)
        for one, record in zip(runs, run_all(runs, processes), strict=True)
    }  # fmt: skip
    rows = []
    for (name, value), own in zip(ABLATIONS, variants, strict=True):
        scores = [found[Run(folder, IMAGES, 0, own, limit)] for folder in folders]
        means = {
            column.key: interval(np.array([[x[column.key]] for x in scores]))
            for column in OF_ABLATIONS
        }
        rows.append({'setting': name, 'value': value, **means})
    return {'clips': [folder.name for folder in folders], 'rows': rows}


def errors_by_size(
    folder: Path, seeds: Sequence[int], limit: int | None, processes: int = 0
) -> dict[str, Any]:
    """Errors on a clip with smaller images, images alone; differences are relative to the whole."""
    runs = [Run(folder, IMAGES, seed, limit=limit, size=size) for size in SIZES for seed in seeds]
    errors = np.array([scores_of(record)[HEAVIEST.key] for record in run_all(runs, processes)])
    means = errors.reshape(len(SIZES), -1).mean(1)
    rows = [
        {'size': size, HEAVIEST.key: float(error)} for size, error in zip(SIZES, means, strict=True)
    ]
    largest = float(np.abs(means / means[SIZES.index(1.0)] - 1.0).max())
    return {'clip': folder.name, 'rows': rows, 'largest_difference': largest}
