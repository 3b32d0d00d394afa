"""evaluate: errors and calibration of the mixtures in a bag against ground truth."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from hmt_ros.app.bag_scores import message_count, score_bag, score_gravity
from hmt_ros.app.command_line import CommandParser, number, run_command, whole_number
from hmt_ros.app.progress import show_progress
from hmt_ros.app.truth import read_truth, recorded_truth
from hmt_ros.evaluation.ground_scores import GravityScores
from hmt_ros.evaluation.pose_scores import MODEL_SIGMA
from hmt_ros.evaluation.track_scores import TrackScores, Truth

EPILOG = """\
Errors are mean distances of hips, knees, ankles, shoulders, elbows, wrists and neck from their true
positions, after the pelvis was moved to its true position (or, if the truth has no pelvis, the
middle of the hips): of the heaviest component, of the best of all components, and the weighted mean
over all components. A frame is lost when even the best component has an error of 150 mm or more.
The negative log-likelihood is that of the true joint positions (m), in nats; lower is better.
Coverage is the fraction of frames in which the truth lies in the smallest region that holds 50 or
90 percent of the probability of the mixture, for all joints together and for each joint alone: the
regions of a calibrated mixture cover 50 and 90 percent of the frames.

Where the truth has gravity and camera_height, the feet of the heaviest component are compared with
the floor: how deep ankles and toes lie below it, and how fast the ankles of feet that truly stand
(contact) slide over it. The vertical of a topic `ground` is compared with gravity: whether it was
given or estimated shows in how well it is said to be known.

examples:
  evaluate out --truth truth.npz             print a table
  evaluate out                               use the ground truth in the bag itself
  evaluate out --truth bags/reach --json     print JSON for programs
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: done, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _evaluate, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'evaluate',
        'Compares the mixtures in a bag with ground truth: errors and calibration.',
        EPILOG,
    )
    parser.add_mixtures('evaluate')
    parser.add_argument(
        '--model-sigma',
        type=number(0, 1, what='a length', unit=' m'),
        default=MODEL_SIGMA,
        metavar='M',
        help='standard deviation, in m, of each coordinate of a joint that is added to the '
        f'covariances of the mixture (default: {MODEL_SIGMA:g})',
    )
    parser.add_argument(
        '--seed',
        type=whole_number(0),
        default=0,
        help='seed of the samples from which coverage is estimated (default: 0)',
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    return parser


def _evaluate(arguments: argparse.Namespace) -> int:
    bag, model_sigma = arguments.bag, arguments.model_sigma
    truth = recorded_truth(bag) if arguments.truth is None else read_truth(arguments.truth)
    if truth is None:
        raise ValueError(f'{bag} has no ground truth: name a .npz file or a bag with --truth')
    total = message_count(bag, arguments.topics)
    with show_progress('evaluate', 'messages', total, quiet=arguments.quiet) as bar:
        found = score_bag(
            bag,
            truth,
            topics=arguments.topics,
            model_sigma=model_sigma,
            body_model=arguments.body,
            seed=arguments.seed,
            progress=bar.update,
        )
    verticals = score_gravity(bag, truth)
    if arguments.json:
        print(json.dumps(as_json(found, truth, model_sigma, verticals), indent=1))
    else:
        print(as_text(found, truth, verticals))
    return 0


def as_json(
    found: dict[str, TrackScores],
    truth: Truth,
    model_sigma: float = MODEL_SIGMA,
    verticals: Mapping[str, GravityScores] | None = None,
) -> dict[str, Any]:
    """The object that `--json` prints."""
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
                **({} if topic.ground is None else {'feet': topic.ground.summary()}),
            }
            for name, topic in found.items()
        },
        'gravity': {name: scores.summary() for name, scores in (verticals or {}).items()},
    }


def as_text(
    found: dict[str, TrackScores],
    truth: Truth,
    verticals: Mapping[str, GravityScores] | None = None,
    *,
    by_joint: bool = True,
) -> str:
    """Tables for people: one row per topic, and the errors joint by joint."""
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
    feet = [f'{name}: {scores}' for name, scores in (verticals or {}).items()]
    feet += [f'{name}: {topic.ground}' for name, topic in found.items() if topic.ground is not None]
    lines += ['', *feet] if feet else []
    lines += [f'{name}: {topic.note}' for name, topic in found.items() if topic.note]
    return '\n'.join(lines)


def _percent(value: float | None) -> str:
    return '-' if value is None else f'{100 * value:.0f} %'


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; the first column is aligned left, all others right."""
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
