"""experts: conditional densities on a toy, on motions and on clips; speed of both uses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import experts_clips, experts_figures, experts_motion, experts_start, experts_toy
from benchmarks.clips import ROOT, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.experts_motion import BEST_OF, COLUMNS, Learned, SeenMotion
from benchmarks.machine import best_time
from hmt_learning.training.predictor_learning import kinds
from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.body import Camera, load_body
from hmt_ros.body.rasterisation import render_silhouettes

STAGES = ('toy', 'oracle', 'learning', 'motion', 'clips', 'start', 'speed', 'figures')
SAMPLES = 6000
FIGURES = ROOT / 'build' / 'benchmarks' / 'experts'
PROPAGATED = tuple(COLUMNS)
MILLISECONDS = {'descriptor': 5.0, 'prediction': 1.0}


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('experts', __doc__, quick='fewer seeds, samples and frames')
    add_choice(parser, STAGES)
    parser.add_argument(
        '--propagate', nargs='*', choices=COLUMNS, default=PROPAGATED, metavar='MODEL',
        help=f'models that also learn dynamics (minutes for experts): {", ".join(COLUMNS)}',
    )  # fmt: skip
    parser.add_argument(
        '--figures', type=Path, default=FIGURES, metavar='DIR',
        help='folder of the figures of the paper (build/benchmarks/experts)',
    )  # fmt: skip
    options = parser.parse_args(argv)
    result = measure(
        quick=options.quick, only=options.only, propagated=options.propagate,
        figures=options.figures,
    )  # fmt: skip
    return show(result, as_text, as_json=options.json)


def measure(
    *,
    quick: bool = False,
    only: Sequence[str] = STAGES,
    propagated: Sequence[str] = PROPAGATED,
    figures: Path = FIGURES,
) -> dict[str, Any]:
    """Runs the stages asked for."""
    stages: dict[str, Callable[[], Any]] = {
        'toy': lambda: experts_toy.toy_scores(*((2, (3,), 150, 500) if quick else ())),
        'oracle': experts_toy.gaussian_mixture_oracle,
        'learning': lambda: {
            'time': experts_toy.learning(*((300, 2, 8, 0.0) if quick else ())),
            'peer': experts_toy.regression_peer(*((200, 4) if quick else ())),
        },
        'motion': lambda: motion(quick, propagated),
        'clips': lambda: experts_clips.clips(quick=quick),
        'start': lambda: experts_start.starts(quick=quick),
        'speed': lambda: speed(0.0 if quick else 1.0, 96 if quick else 3000),
        'figures': lambda: experts_figures.draw(figures, quick=quick),
    }
    return run_stages('experts', stages, only)


def motion(quick: bool = False, propagated: Sequence[str] = PROPAGATED) -> dict[str, Any] | str:
    """Scores on recorded motions of other people, or the reason why there are none."""
    try:
        train, test = (experts_motion.recorded(part) for part in ('train', 'dev'))
    except ValueError as error:
        return f'skipped: {error}'
    learned = experts_motion.learn_from(train, 600 if quick else SAMPLES)
    motions = experts_motion.seen_motions(learned, test, 4 if quick else experts_motion.FRAMES)
    return experts_motion.compared(learned, motions, propagated=propagated)


def made_up(samples: int, frames: int = 6) -> tuple[Learned, list[SeenMotion]]:
    """Procedural motions for learning, and others for tests."""
    body = load_body('human37')
    train = [procedural_sequence(name, body, 4.0, seed) for name in ('walk', 'dance')
             for seed in (0, 1)]  # fmt: skip
    learned = experts_motion.learn_from(train, samples)
    test = [procedural_sequence(name, body, 2.0, 5) for name in ('walk', 'dance')]
    return learned, experts_motion.seen_motions(learned, test, frames)


def speed(seconds: float, samples: int) -> dict[str, Any]:
    """Time per image of 640 x 480 for the descriptor, each model, and the whole prediction, ms."""
    learned, _ = made_up(samples)
    body = learned.body
    sequence = procedural_sequence('walk', body, 1.0, 9)
    poses = sequence.poses[:1].copy()
    poses[:, 2] += 3.5 - poses[:, 2]
    camera = Camera(580.0, 580.0, 319.5, 239.5, 640, 480)
    mask = render_silhouettes(body, poses, camera)[0].view(np.uint8)
    result: dict[str, Any] = {'samples': samples, 'pixels': int(mask.sum()), 'prediction_ms': {}}
    for name in (x for x in COLUMNS if x in kinds()):
        predictor, _ = experts_motion.predictor_of(learned, name, dynamics=False)
        row = predictor.describe(mask, camera)[None]
        model = predictor.model
        result['prediction_ms'][name] = 1e3 * best_time(
            lambda m=model, x=row: m.predict_arrays(x), seconds=seconds
        )
        if name == 'local':
            result['descriptor_ms'] = 1e3 * best_time(
                lambda p=predictor: p.describe(mask, camera), seconds=seconds
            )
            result['whole_ms'] = 1e3 * best_time(
                lambda p=predictor: p.predict(mask, camera), seconds=seconds
            )
    slowest = max(result['prediction_ms'].values())
    result['wanted'] = [
        {
            'what': what, 'value': value, 'wanted': f'at most {MILLISECONDS[what]:g} ms',
            'met': value <= MILLISECONDS[what],
        }
        for what, value in (('descriptor', result['descriptor_ms']), ('prediction', slowest))
    ]  # fmt: skip
    return result


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    parts = []
    rows = _summary_rows(result)
    if len(rows) > 1:
        parts.append(table(rows, markdown=markdown))
    for name in ('motion', 'clips', 'start', 'figures'):
        found = result.get(name)
        if isinstance(found, str):
            parts.append(f'{name}: {found}')
    if isinstance(result.get('figures'), list) and not markdown:
        parts.append(f'figures: {", ".join(result["figures"])}')
    if isinstance(result.get('motion'), dict):
        parts += _motion_tables(result['motion'], markdown)
    if isinstance(result.get('clips'), dict):
        found = result['clips']
        parts.append(table(experts_clips.as_rows(found), left=2, markdown=markdown))
        if found['wanted']:
            parts.append(table(_verdict_rows(found['wanted']), markdown=markdown))
    if isinstance(result.get('start'), dict):
        found = result['start']
        parts.append(table(experts_start.as_rows(found), left=2, markdown=markdown))
        parts.append(table(_verdict_rows(found['wanted']), markdown=markdown))
    return '\n\n'.join(parts)


def _summary_rows(result: dict[str, Any]) -> list[list[str]]:
    rows = [['measure', 'value', 'wanted']]
    if 'toy' in result:
        toy = result['toy']
        rows.append(['toy: mean log p of the truth', f'{toy["ceiling"]:.3f}', ''])
        rows.append(['toy: one regression', f'{toy["regression"]["mean"]:.3f}', ''])
        for name in experts_toy.MODELS:
            for count, entry in toy[name].items():
                value = f'{entry["mean"]:.3f} (worst seed {entry["worst"]:.3f})'
                wanted = '' if entry['wanted'] is None else f'at least {entry["wanted"]:.2f}'
                rows.append([f'toy: {count} {name} experts', value, wanted])
    if 'oracle' in result:
        oracle = result['oracle']
        what = 'linear joint experts from a mixture of Gaussians'
        if isinstance(oracle, str):
            rows.append([what, oracle, ''])
        else:
            rows.append([what, f'{oracle["largest_difference"]:.1e}', f'{oracle["wanted"]:.0e}'])
    if 'learning' in result:
        spent, peer = result['learning']['time'], result['learning']['peer']
        for name in experts_toy.MODELS:
            what = f'{name}: learning {spent["samples"]} samples, {spent["experts"]} experts'
            wanted = f'{spent[name]["learning_wanted_s"]:.0f} s'
            rows.append([what, f'{spent[name]["learning_s"]:.1f} s', wanted])
        if isinstance(peer['peer'], str):
            rows.append(['one regression against sklearn-rvm', peer['peer'], ''])
        else:
            value = f'{peer["times_faster"]:.0f} times faster an output'
            wanted = f'{peer["wanted"]:.0f}'
            rows.append(['one regression against sklearn-rvm', value, wanted])
    if 'speed' in result:
        found = result['speed']
        wanted = f'{MILLISECONDS["descriptor"]:g} ms'
        rows.append(['descriptor, 640x480', f'{found["descriptor_ms"]:.2f} ms', wanted])
        for name, value in found['prediction_ms'].items():
            wanted = f'{MILLISECONDS["prediction"]:g} ms'
            rows.append([f'prediction: {COLUMNS[name]}', f'{value:.2f} ms', wanted])
        rows.append(['mask to mixture over poses', f'{found["whole_ms"]:.2f} ms', ''])
    return rows


def _motion_tables(found: dict[str, Any], markdown: bool) -> list[str]:
    """Errors by activity, calibration by model, and verdicts."""
    names = [name for name in COLUMNS if name in found]
    activities = [*found['ambiguous_share'], 'all']
    parts = []
    for unit, what in (('degrees', 'Joint angles, degrees'), ('mm', 'Joints, mm')):
        head = f'{what}: mean (maximum), best of {BEST_OF}'
        rows = [[head, 'ambiguous', *(COLUMNS[name] for name in names)]]
        for activity in activities:
            share = found['ambiguous_share'].get(activity)
            row = [activity, '' if share is None else f'{100 * share:.0f} %']
            for name in names:
                s = found[name]['alone'][activity]
                digits = 1 if unit == 'degrees' else 0
                row.append(
                    f'{s[unit]:.{digits}f} ({s[f"max_{unit}"]:.0f}), {s[f"best_{unit}"]:.{digits}f}'
                )
            rows.append(row)
        parts.append(table(rows, markdown=markdown))
    rows = [
        [
            'model', 'given', 'degrees', 'mm', 'best, mm', 'log p a frame', '50 %', '90 %',
            'joint 50 %', 'joint 90 %',
        ]
    ]  # fmt: skip
    for name in names:
        for how, given in (
            ('alone', 'r'),
            ('not_propagated', 'r, one view'),
            ('propagated', 'x before, r, one view: rule (1)'),
            ('by_dynamics', 'x before, r, one view: rule (9)'),
        ):
            if how not in found[name]:
                continue
            s = found[name][how]['all']
            shares = ('coverage_50', 'coverage_90', 'joint_coverage_50', 'joint_coverage_90')
            rows.append(
                [
                    COLUMNS[name], given, f'{s["degrees"]:.1f}', f'{s["mm"]:.0f}',
                    f'{s["best_mm"]:.0f}', f'{s["log_density"]:.1f}',
                    *(f'{100 * s[share]:.0f} %' for share in shares),
                ]
            )  # fmt: skip
    parts.append(table(rows, left=2, markdown=markdown))
    if found['wanted']:
        wanted = [
            {**one, 'what': f'{COLUMNS[one["model"]]}: {one["what"]}'} for one in found['wanted']
        ]
        parts.append(table(_verdict_rows(wanted), markdown=markdown))
    return parts


def _verdict_rows(wanted: Sequence[dict[str, Any]]) -> list[list[str]]:
    rows = [['what', 'found', 'wanted', '']]
    for one in wanted:
        missed = ', '.join(one.get('missed', ()))
        verdict = 'met' if one['met'] else f'missed{": " + missed if missed else ""}'
        rows.append([one['what'], f'{one["value"]:.2f}', one['wanted'], verdict])
    return rows
