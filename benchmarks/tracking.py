"""tracking: accuracy, calibration and speed of the tracker on clips with known truth.

The tracker gets the images, the images with the keypoints of a detector, or these keypoints alone.
Clips on which its settings were chosen are reported separately from the others. Runs are cached in
build/benchmarks/tracking until the code changes, so an interrupted benchmark continues.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import tracking_oracles
from benchmarks.clips import find_clips, read_clip
from benchmarks.command import benchmark_parser, run_benchmark, show
from benchmarks.machine import description
from benchmarks.runs import (
    GRAVITIES,
    IMAGES,
    INPUTS,
    STARTS,
    SUBJECT,
    UNKNOWN,
    USUAL_RATE,
    Run,
    parsed_changes,
    records_of,
    run_all,
)
from benchmarks.tracking_means import (
    DETECTOR,
    OF_APART,
    by_clip,
    difference_entries,
    entry_of,
    group_of,
    grouped,
    key_of,
    means_of,
    paired,
)
from benchmarks.tracking_scores import detector_scores, scores_of
from benchmarks.tracking_speed import PRICED, costs, speed
from benchmarks.tracking_tables import COMPARED, HEAVIEST, as_text

PARTS = ('accuracy', 'speed')
ORACLES = 'oracles'  # separate part, with its own clips
SEEDS = (0, 1, 2)
RATES = (USUAL_RATE,)
TIMED = 'walk'  # clip for the speed, if available
QUICK = 10  # number of images with --quick


def main(argv: list[str]) -> int:
    """Runs the benchmark; returns 1 if there are no clips or a setting does not exist."""
    parser = benchmark_parser('tracking', __doc__, quick=f'{QUICK} images of one clip, one seed')
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
    parser.add_argument(
        '--gravity',
        nargs='+',
        choices=GRAVITIES,
        default=GRAVITIES,
        help='whether its direction is given with each image',
    )
    parser.add_argument('--seeds', type=int, nargs='+', metavar='N', default=SEEDS)
    parser.add_argument(
        '--rates',
        type=float,
        nargs='+',
        metavar='HZ',
        default=RATES,
        help=f'images a second at most, {USUAL_RATE:g} or more: all images',
    )
    parser.add_argument(
        '--parts',
        nargs='+',
        choices=(*PARTS, ORACLES),
        help=f'{", ".join(PARTS)}; none where settings or checkouts are compared; '
        f'{ORACLES}, alone: what the truth of one thing at a time would gain, gravity given',
    )
    parser.add_argument(
        '--against', nargs='+', default=(), metavar='SETTING=VALUE',
        help='compare the tracker with itself with these settings, such as max_hypotheses=4',
    )  # fmt: skip
    parser.add_argument(
        '--baseline', type=Path, metavar='DIR',
        help='compare with the kept runs of another checkout, its build/benchmarks/tracking',
    )  # fmt: skip
    parser.add_argument(
        '--processes', type=int, default=0, metavar='N', help='of one thread each (one a core)'
    )
    options = parser.parse_args(argv)
    if ORACLES in (options.parts or ()):
        if options.parts != [ORACLES] or options.against or options.baseline:
            parser.error(f'{ORACLES} stands alone')
        return run_benchmark(
            'tracking',
            lambda: tracking_oracles.measure(
                options.clips,
                options.only,
                [x for x in options.inputs if x in tracking_oracles.INPUTS],
                options.seeds,
                options.processes,
                quick=options.quick,
            ),
            partial(tracking_oracles.as_text, markdown=options.markdown),
            as_json=options.json,
        )
    usual = () if options.against or options.baseline else PARTS
    try:
        result = measure(
            options.clips,
            options.only,
            options.inputs,
            options.seeds,
            options.parts or usual,
            parsed_changes(options.against),
            options.processes,
            quick=options.quick,
            start=options.start,
            rates=options.rates,
            baseline=options.baseline,
            gravity=options.gravity,
        )
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
    *,
    quick: bool = False,
    start: str = SUBJECT,
    rates: Sequence[float] = RATES,
    baseline: Path | None = None,
    gravity: Sequence[str] = (UNKNOWN,),
) -> dict[str, Any]:
    """Runs the requested parts of the benchmark.

    Args:
        clips: folder of the clips; None means the development clips, or bags/.
        only: names of the clips to use; empty means all.
        inputs: some of `runs.INPUTS`.
        seeds: seeds of the tracker.
        parts: some of `PARTS`.
        against: changed settings to compare the tracker with; empty means no comparison.
        processes: number of processes; 0 means one per core.
        quick: a few images of one clip, one seed.
        start: source of the initial pose, one of `runs.STARTS`; images alone use the subject.
        rates: maximum numbers of images per second; `USUAL_RATE` or more means all images.
        baseline: folder with the records of another checkout; None means no comparison.
        gravity: some of `runs.GRAVITIES`; clips without gravity only run with it unknown.

    Raises:
        ValueError: a clip does not exist or can not be read.
    """
    folders, source = find_clips(clips, moving=True, quick=quick)
    limit = None
    if quick:
        limit, seeds, processes = QUICK, seeds[:1], 1
    if only:
        folders = [folder for folder in folders if folder.name in only]
    if not folders:
        raise ValueError(f'none of the clips {list(only)} is there')
    lacking = [folder.name for folder in folders if not _has_keypoints(folder)]

    runs = [
        Run(
            folder,
            given,
            seed,
            limit=limit,
            start=SUBJECT if given == IMAGES else start,
            rate=rate,
            gravity=known,
        )
        for folder in folders
        for rate in dict.fromkeys(rate if 0 < rate < USUAL_RATE else 0.0 for rate in rates)
        for given in inputs
        if given == IMAGES or folder.name not in lacking
        for known in gravity
        if known == UNKNOWN or _has_gravity(folder)
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
            entry_of((folder.name, DETECTOR, rate, UNKNOWN), [detector_scores(folder, limit, rate)])
            for folder in folders
            if folder.name not in lacking
            for rate in dict.fromkeys(one.rate for one in runs)
        ]
        result['accuracy'] = grouped(entries)
    if against:
        result['against'] = comparison(runs, against, processes)
    if baseline is not None:
        result['baseline'] = comparison_with_baseline(runs, baseline, processes)
    still = [folder for folder in folders if (folder / 'background.png').is_file()]
    timed = next((folder for folder in still if folder.name == TIMED), still[-1] if still else None)
    if timed is not None and 'speed' in parts:
        result['speed'] = speed(read_clip(timed, QUICK if quick else 60))
        priced = [folder for folder in still if folder.name in PRICED] or [timed]
        result['costs'] = [row for folder in priced for row in costs(folder, limit)]
    return result


def _has_keypoints(folder: Path) -> bool:
    return (folder / 'keypoints_mediapipe.npz').is_file()


def _has_gravity(folder: Path) -> bool:
    with np.load(folder / 'truth.npz') as content:
        return 'gravity' in content or 'up' in content


def accuracy(runs: Sequence[Run], processes: int = 0) -> list[dict[str, Any]]:
    """Scores of each clip, input, rate and gravity, means over the seeds."""
    found = by_clip(runs, map(scores_of, run_all(runs, processes)))
    return [entry_of(key, [scores for _, scores in mine]) for key, mine in found.items()]


def comparison(
    runs: Sequence[Run], changes: tuple[tuple[str, Any], ...], processes: int = 0
) -> dict[str, Any]:
    """Scores with changed settings minus those with the usual ones, on the same runs."""
    others = [replace(one, changes=changes) for one in runs]
    scores = [scores_of(record) for record in run_all([*runs, *others], processes)]
    usual, own = scores[: len(runs)], scores[len(runs) :]
    return {
        'changes': [f'{name}={value}' for name, value in changes],
        **_compared(runs, own, usual),
    }


def comparison_with_baseline(
    runs: Sequence[Run], folder: Path, processes: int = 0
) -> dict[str, Any]:
    """Scores of this checkout minus those of another one, for the same runs.

    Combinations of clip, input, rate and gravity that lack a seed in the other are left out.

    Args:
        runs: runs to compare.
        folder: folder with the records of the other checkout.
        processes: number of processes; 0 means one per core.

    Raises:
        ValueError: the folder has no record of these runs.
    """
    records = dict(zip(runs, records_of(runs, folder), strict=True))
    lacking = {key_of(x) for x, record in records.items() if record is None}
    both = [one for one in runs if key_of(one) not in lacking]
    if not both:
        raise ValueError(f'{folder} lacks seeds of every clip and input')
    usual = [scores_of(record) for one in both if (record := records[one]) is not None]
    own = [scores_of(record) for record in run_all(both, processes)]
    return {
        'folder': str(folder),
        'lacking': [list(key) for key in sorted(lacking)],
        **_compared(both, own, usual),
    }


def _compared(
    runs: Sequence[Run], own: Sequence[dict[str, Any]], usual: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    names = [column.key for column in COMPARED]
    entries = difference_entries(runs, own, usual, names)
    averaged = [entry for entry in entries if group_of(entry['clip']) != OF_APART]
    return {
        'groups': grouped(entries),
        'means': means_of(averaged),
        'paired': paired(entries, HEAVIEST.key),
    }
