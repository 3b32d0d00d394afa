"""evaluate: errors and calibration of the mixtures in a bag, against ground truth."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hmt_ros.app.bag_scores import TopicScores, score_bag
from hmt_ros.app.command_line import CommandParser, number, run_command
from hmt_ros.app.truth import Truth, read_truth, recorded_truth
from hmt_ros.evaluation.pose_scores import MODEL_SIGMA

EPILOG = """\
Errors are mean distances of hips, knees, ankles, shoulders, elbows, wrists and neck from where
they were, after the pelvis was brought to its true place: of the heaviest component, of the best
of all, and the mean over the components by weight. A frame is lost when even the best is 150 mm
off. The negative log-likelihood is that of the true joint positions (m), in nats; lower is better.
Coverage is how often the truth lies in the smallest region that holds 50 or 90 percent of the
mixture's probability, for all joints together and for each joint alone: honest mixtures cover 50
and 90 percent.

examples:
  evaluate out --truth truth.npz             a table
  evaluate out                               against the ground truth that the bag itself carries
  evaluate out --truth bags/reach --json     for programs
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: done, 1: bad input, and one line on stderr says which."""
    return run_command(_parser(), _evaluate, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='evaluate',
        description='Errors and calibration of the mixtures in a bag, against ground truth.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'bag', type=Path, metavar='OUT', help='bag with mixtures: a folder, or a file'
    )
    parser.add_argument(
        '--truth',
        type=Path,
        metavar='FILE',
        help='true joint positions: a .npz file with stamps, joint_names and joints, or a bag with '
        'ground truth (OUT itself)',
    )
    parser.add_argument(
        '--topic',
        action='append',
        default=[],
        metavar='NAME',
        help='evaluate this topic only; may be given several times (all topics with mixtures)',
    )
    parser.add_argument(
        '--model-sigma',
        type=number(1e-4, 1, what='a length', unit=' m'),
        default=MODEL_SIGMA,
        metavar='M',
        help='standard deviation, in m, that every coordinate of a joint has besides what the '
        f"mixture says, because the body's lengths are not exactly the person's ({MODEL_SIGMA:g})",
    )
    parser.add_argument(
        '--body',
        metavar='MODEL',
        help='body model whose poses they are: a name or a YAML file (the one that OUT names)',
    )
    parser.add_argument('--seed', type=int, default=0, help='of the samples for coverage (0)')
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    return parser


def _evaluate(options: argparse.Namespace) -> int:
    truth = _truth(options)
    found = _scores(options, truth)
    if options.json:
        print(json.dumps(as_json(found, truth, options.model_sigma), indent=1))
    else:
        print(as_text(found, truth))
    return 0


def _truth(options: argparse.Namespace) -> Truth:
    if options.truth is not None:
        return read_truth(options.truth)
    truth = recorded_truth(options.bag)
    if truth is None:
        raise ValueError(
            f'{options.bag} has no ground truth: name a .npz file or a bag with --truth'
        )
    return truth


def _scores(options: argparse.Namespace, truth: Truth) -> dict[str, TopicScores]:
    if options.seed < 0:
        raise ValueError(f'--seed must not be negative, saw {options.seed}')
    # None: shown where stderr is a terminal.
    with tqdm(unit='message', desc='evaluate', disable=options.quiet or None) as bar:
        return score_bag(
            options.bag,
            truth,
            topics=options.topic,
            model_sigma=options.model_sigma,
            body_model=options.body,
            seed=options.seed,
            progress=bar.update,
        )


def as_json(
    found: dict[str, TopicScores], truth: Truth, model_sigma: float = MODEL_SIGMA
) -> dict[str, Any]:
    """What `--json` prints."""
    return {
        'truth': truth.source,
        'truth_frames': len(truth.joints),
        'model_sigma_m': model_sigma,
        'topics': {
            name: {
                'kind': topic.kind,
                'missing': topic.missing,
                'without_truth': topic.without_truth,
                'note': topic.note,
                **topic.scores.summary(),
            }
            for name, topic in found.items()
        },
    }


def as_text(found: dict[str, TopicScores], truth: Truth, *, by_joint: bool = True) -> str:
    """Tables for people: one row a topic, and the errors joint by joint."""
    rows: list[tuple[str, ...]] = [
        (
            '', 'frames', 'missing', 'modes', 'heaviest', 'best of K', 'expected', 'under',
            '-log p', 'all', 'joints', 'each', 'joint',
        ),
        ('', '', '', '', 'mm', 'mm', 'mm', '150 mm', '', '50 %', '90 %', '50 %', '90 %'),
    ]  # fmt: skip
    summaries = {name: topic.scores.summary() for name, topic in found.items()}
    for name, topic in found.items():
        s = summaries[name]
        rows.append(
            (
                name,
                str(s['frames']),
                str(topic.missing),
                f'{s["modes"]:.1f}',
                f'{s["heaviest_mm"]:.0f}',
                f'{s["best_mm"]:.0f}',
                f'{s["expected_mm"]:.0f}',
                _percent(s['fraction_tracked']),
                '-'
                if s['negative_log_likelihood'] is None
                else f'{s["negative_log_likelihood"]:.1f}',
                *(
                    _percent(s[f'{kind}coverage_{percent}'])
                    for kind in ('', 'joint_')
                    for percent in (50, 90)
                ),
            )
        )
    lines = [f'against {truth.source}, {len(truth.joints)} frames', '', *table(rows)]
    if by_joint:
        joints = [('best of K, mm', *found)]
        for joint in next(iter(found.values())).scores.names:
            cells = [summary['by_joint'][joint]['best_mm'] for summary in summaries.values()]
            joints.append((joint, *(f'{cell:.0f}' for cell in cells)))
        lines += ['', *table(joints)]
    lines += [f'{name}: {topic.note}' for name, topic in found.items() if topic.note]
    return '\n'.join(lines)


def _percent(value: float | None) -> str:
    return '-' if value is None else f'{100 * value:.0f} %'


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column to the left and all others to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        '  '.join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


if __name__ == '__main__':
    sys.exit(main())
