"""tracking: accuracy, calibration and speed of the tracker on clips with known truth.

The tracker is given the images, the images with the keypoints of a detector, or these keypoints
alone. Clips on which its settings were chosen are told apart from the others. Runs are kept in
build/benchmarks/tracking until the code changes: a benchmark that was broken off goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
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
    GRAVITIES,
    IMAGES,
    INPUTS,
    STARTS,
    SUBJECT,
    UNKNOWN,
    USUAL_RATE,
    Run,
    records_of,
    run_all,
)
from benchmarks.tracker_changes import changed, parsed_changes
from benchmarks.tracking_budgets import budgets
from benchmarks.tracking_means import (
    APART,
    CHOSEN,
    DETECTOR,
    OF_APART,
    by_clip,
    difference_entries,
    entry_of,
    group_of,
    grouped,
    key_of,
    means_of,
    medians_of,
    paired,
)
from benchmarks.tracking_oracle import oracle
from benchmarks.tracking_rules import (
    DECIDE,
    GROUPS_OF_RULES,
    RULES,
    SCREEN,
    Plan,
    effects,
    rules_named,
)
from benchmarks.tracking_scores import detector_scores, interval, scores_of
from benchmarks.tracking_speed import PRICED, costs, memory, speed
from benchmarks.tracking_tables import COMPARED, HEAVIEST, OF_ABLATIONS, as_text
from hmt_ros.tracking import TrackerSettings

Array = NDArray[np.float64]

USUAL_PARTS = ('accuracy', 'ablations', 'sizes', 'oracle', 'speed')
PARTS = (*USUAL_PARTS, 'budgets', 'scaling', 'rules')
SEEDS = (0, 1, 2)
RATES = (USUAL_RATE,)
ABLATIONS: tuple[tuple[str, Any], ...] = (*(('max_hypotheses', k) for k in (1, 2, 4, 8, 16)),)
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
    parser.add_argument(
        '--gravity', nargs='+', choices=GRAVITIES,
        help='whether its direction is given with each image (all; of rules: unknown)',
    )  # fmt: skip
    parser.add_argument(
        '--seeds', type=int, nargs='+', metavar='N',
        help=f'{_listed(SEEDS)}; of rules {_listed(SCREEN.seeds)}, to decide '
        f'{_listed(DECIDE.seeds)}',
    )  # fmt: skip
    parser.add_argument(
        '--rates', type=float, nargs='+', metavar='HZ',
        help=f'images a second at most, {USUAL_RATE:g} or more: all images ({_listed(RATES)}; of '
        f'rules {_listed(SCREEN.rates)}, to decide {_listed(DECIDE.rates)})',
    )  # fmt: skip
    parser.add_argument(
        '--parts', nargs='+', choices=PARTS,
        help=f'{_listed(USUAL_PARTS)}; none where settings or checkouts are compared',
    )  # fmt: skip
    parser.add_argument(
        '--against', nargs='+', default=(), metavar='SETTING=VALUE',
        help='compare the tracker with itself with these settings, such as max_hypotheses=4',
    )  # fmt: skip
    parser.add_argument(
        '--baseline', type=Path, metavar='DIR',
        help='compare with the kept runs of another checkout, its build/benchmarks/tracking',
    )  # fmt: skip
    parser.add_argument(
        '--rules', nargs='+', default=(), metavar='NAME',
        help='some of the rules that the tracker is run without, by name or by group '
        f'({_listed(GROUPS_OF_RULES)}): {_listed(rule.name for rule in RULES)}',
    )  # fmt: skip
    parser.add_argument(
        '--decide', action='store_true', help='run without rules for more seeds and rates'
    )
    parser.add_argument(
        '--others', action='store_true',
        help='run without rules on the clips, too, that settings were not chosen on',
    )  # fmt: skip
    parser.add_argument(
        '--processes', type=int, default=0, metavar='N', help='of one thread each (one a core)'
    )
    parser.add_argument(
        '--frames', type=int, default=0, metavar='N',
        help='follow memory over so many images of a clip that is played back and forth',
    )  # fmt: skip
    options = parser.parse_args(argv)
    compared = options.against or options.baseline
    usual = ('rules',) if options.rules else () if compared else USUAL_PARTS
    parts = options.parts or usual
    plan = DECIDE if options.decide else SCREEN
    try:
        result = measure(
            options.clips, options.only, options.inputs, options.seeds or SEEDS, parts,
            parsed_changes(options.against), options.processes, options.frames,
            quick=options.quick, start=options.start, rates=options.rates or RATES,
            baseline=options.baseline, others=options.others, rules=options.rules,
            gravity=options.gravity or ((UNKNOWN,) if 'rules' in parts else GRAVITIES),
            plan=Plan(options.seeds or plan.seeds, options.rates or plan.rates),
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
    parts: Sequence[str] = USUAL_PARTS,
    against: tuple[tuple[str, Any], ...] = (),
    processes: int = 0,
    frames: int = 0,
    *,
    quick: bool = False,
    start: str = SUBJECT,
    rates: Sequence[float] = RATES,
    baseline: Path | None = None,
    rules: Sequence[str] = (),
    plan: Plan = SCREEN,
    others: bool = False,
    gravity: Sequence[str] = (UNKNOWN,),
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
        rates: images a second at most; `USUAL_RATE` or more: all images.
        baseline: folder of the records of another checkout; None: no comparison.
        rules: names or groups of rules that the tracker is run without; empty: all.
        plan: seeds and rates of the runs without rules.
        others: whether the clips that settings were not chosen on are run without rules, too.
        gravity: some of `runs.GRAVITIES`; clips that do not tell it are only run without.

    Raises:
        ValueError: there is no such clip, or it can not be read.
    """
    chosen_rules = rules_named(rules)
    folders, source = find_clips(clips, moving=True)
    limit, seeds = (QUICK, seeds[:1]) if quick else (None, seeds)
    if only:
        folders = [folder for folder in folders if folder.name in only]
    if not folders:
        raise ValueError(f'none of the clips {list(only)} is there')
    lacking = [folder.name for folder in folders if not _has_keypoints(folder)]

    def runs_of(some: Sequence[Path], seeds: Sequence[int], rates: Sequence[float]) -> list[Run]:
        slower = dict.fromkeys(rate if 0 < rate < USUAL_RATE else 0.0 for rate in rates)
        return [
            Run(
                folder, given, seed, limit=limit, start=SUBJECT if given == IMAGES else start,
                rate=rate, gravity=known,
            )
            for folder in some
            for rate in slower
            for given in inputs
            if given == IMAGES or folder.name not in lacking
            for known in gravity
            if known == UNKNOWN or _has_gravity(folder)
            for seed in seeds
        ]  # fmt: skip

    runs = runs_of(folders, seeds, rates)
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
    if 'budgets' in parts:
        result['budgets'] = budgets(runs, processes)
    if against:
        result['against'] = comparison(runs, against, processes)
    if baseline is not None:
        result['baseline'] = comparison_with_baseline(runs, baseline, processes)
    if 'rules' in parts:
        some = [x for x in folders if x.name not in APART] if others else _to_decide_on(folders)
        own = plan.seeds[:1] if quick else plan.seeds
        result['rules'] = effects(runs_of(some, own, plan.rates), chosen_rules, processes)
    if 'ablations' in parts:
        result['ablations'] = ablations(folders, limit, processes)
    if 'sizes' in parts:
        sized = next((folder for folder in folders if folder.name == SIZED), folders[0])
        result['sizes'] = errors_by_size(sized, seeds, limit, processes)
    if 'oracle' in parts:
        averaged = [folder for folder in folders if folder.name not in APART]
        result['oracle'] = oracle(averaged or folders, limit, processes)
    still = [folder for folder in folders if (folder / 'background.png').is_file()]
    timed = next((folder for folder in still if folder.name == TIMED), still[-1] if still else None)
    if timed is not None and 'speed' in parts:
        result['speed'] = speed(read_clip(timed, QUICK if quick else 60))
        priced = [folder for folder in still if folder.name in PRICED] or [timed]
        result['costs'] = [row for folder in priced for row in costs(folder, limit)]
    if timed is not None and 'scaling' in parts:
        # Here, so that the other parts need no inner modules of the tracker.
        from benchmarks.tracking_scaling import scaling

        result['scaling'] = scaling(read_clip(timed, QUICK if quick else 60))
    if timed is not None and frames > 0:
        result['memory'] = memory(read_clip(timed), frames)
    return result


def _to_decide_on(folders: Sequence[Path]) -> list[Path]:
    """Clips that settings may be chosen on; all where none of them is there."""
    return [folder for folder in folders if folder.name in CHOSEN] or list(folders)


def _listed(items: Iterable[Any]) -> str:
    """Items as words: numbers without decimals that are 0."""
    return ', '.join(f'{x:g}' if isinstance(x, float) else str(x) for x in items)


def _has_keypoints(folder: Path) -> bool:
    return (folder / 'keypoints_mediapipe.npz').is_file()


def _has_gravity(folder: Path) -> bool:
    with np.load(folder / 'truth.npz') as content:
        return 'gravity' in content or 'up' in content


# Accuracy.


def accuracy(runs: Sequence[Run], processes: int = 0) -> list[dict[str, Any]]:
    """Scores of each clip, input, rate and gravity, means over the seeds."""
    found = by_clip(runs, map(scores_of, run_all(runs, processes)))
    return [entry_of(key, [scores for _, scores in mine]) for key, mine in found.items()]


def comparison(
    runs: Sequence[Run], changes: tuple[tuple[str, Any], ...], processes: int = 0
) -> dict[str, Any]:
    """What changed settings change on the same clips, inputs and seeds: their scores minus ours."""
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
    """Our scores minus those of the same runs of another checkout.

    Clips, inputs, rates and gravities of which the other checkout lacks a seed are left out.

    Args:
        runs: to compare.
        folder: of the records of the other checkout.
        processes: number of processes; 0: one a core.

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
        'medians': medians_of(averaged),
        'paired': paired(entries, HEAVIEST.key),
    }


def ablations(folders: Sequence[Path], limit: int | None, processes: int = 0) -> dict[str, Any]:
    """Scores of other numbers of modes and of the other weights, from images alone, one seed.

    On the clips that settings were chosen on; on all where none of them is there.
    """
    folders = _to_decide_on(folders)
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
