"""evaluate: computes errors and calibration of the mixtures in a bag against ground truth.

Each topic of pose mixtures or trajectory mixtures is one track; the bag is read once, in order.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hmt_ros.app.command_line import CommandParser, number, run_command, whole_number
from hmt_ros.app.progress import say, show_progress
from hmt_ros.app.recorded_bodies import BODY, RecordedBodies
from hmt_ros.app.truth import is_truth, read_truth, recorded_truth
from hmt_ros.body import Body
from hmt_ros.evaluation.ground_scores import GravityScores, gravity_scores
from hmt_ros.evaluation.pose_scores import MODEL_SIGMA
from hmt_ros.evaluation.track_scores import Estimate, TrackScorer, TrackScores, Truth
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from msg_tools import BagMessage, BagReader
from msg_tools.files.error_line import one_line
from msg_tools.messages.ground import GROUND, ground_of
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import (
    TRAJECTORY_MIXTURE,
    TrajectoryMixture,
    trajectory_mixture_of,
)

# Maximum length of a name in a table, and of a row of a table, characters.
MAX_CELL_LENGTH, MAX_ROW_LENGTH = 60, 1000

EPILOG = """\
Errors are mean distances of hips, knees, ankles, shoulders, elbows, wrists and neck from their true
positions, after the pelvis was moved to its true position (or, if the truth has no pelvis, the
middle of the hips): of the heaviest component, of the best of all components, and the weighted mean
over all components. A frame is lost when even the best component has an error of 150 mm or more.
The negative log-likelihood is that of the true joint positions (m), in nats; lower is better.
Coverage is the fraction of frames in which the truth lies in the smallest region that contains 50
or 90 percent of the probability of the mixture, for all joints together and for each joint alone:
the regions of a calibrated mixture cover 50 and 90 percent of the frames.

If the truth has gravity and camera_height, the feet of the heaviest component are compared with the
floor: the depth of ankles and toes below it, and the sliding speed of the ankles whose feet truly
stand (contact). The vertical in a topic `ground` is compared with gravity; its stated standard
deviation shows whether it was given or estimated.

examples:
  evaluate out --truth truth.npz             print a table
  evaluate out                               use the ground truth in the bag itself
  evaluate out --truth bags/reach --json     print JSON for programs
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
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
        help='standard deviation of each joint coordinate, in m, that is added to the '
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
    with BagReader(bag) as reader:
        names = chosen_topics(reader, arguments.topics)
        total = reader.message_count({*(x.name for x in reader.topics_of(BODY)), *names})
    with show_progress('evaluate', 'messages', total, quiet=arguments.quiet) as bar:
        found = score_bag(
            bag,
            truth,
            topics=names,
            model_sigma=model_sigma,
            body_model=arguments.body,
            seed=arguments.seed,
            progress=bar.update,
        )
    verticals = score_gravity(bag, truth)
    if arguments.json:
        print(json.dumps(as_json(found, truth, model_sigma, verticals), indent=1))
    else:
        say(as_text(found, truth, verticals), most=MAX_ROW_LENGTH)
    return 0


def as_json(
    found: dict[str, TrackScores],
    truth: Truth,
    model_sigma: float = MODEL_SIGMA,
    verticals: Mapping[str, GravityScores] | None = None,
) -> dict[str, Any]:
    """The JSON object that `--json` prints."""
    return _finite(
        {
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
    )


def _finite(value: Any) -> Any:
    """Replaces infinity and NaN, which JSON can not represent, by None."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_text(
    found: dict[str, TrackScores],
    truth: Truth,
    verticals: Mapping[str, GravityScores] | None = None,
) -> str:
    """Tables as text: one row per topic, then the errors of each joint."""
    found = {one_line(name, MAX_CELL_LENGTH): topic for name, topic in found.items()}
    rows: list[tuple[str, ...]] = [
        (
            '',
            'frames',
            'missing',
            'modes',
            'heaviest',
            'best of K',
            'expected',
            'under',
            '-log p',
            'all',
            'joints',
            'each',
            'joint',
        ),
        ('', '', '', '', 'mm', 'mm', 'mm', '150 mm', '', '50 %', '90 %', '50 %', '90 %'),
    ]
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
    rows = [[one_line(cell, MAX_CELL_LENGTH) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        '  '.join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def score_bag(
    path: Path,
    truth: Truth,
    *,
    topics: Iterable[str] = (),
    model_sigma: float = MODEL_SIGMA,
    body_model: str | None = None,
    seed: int = 0,
    progress: Callable[[int], object] = lambda count: None,
) -> dict[str, TrackScores]:
    """Computes the scores of each topic of a bag, by topic name.

    Args:
        topics: names of the topics to score; empty selects all topics with mixtures.
        model_sigma: see `hmt_ros.evaluation.pose_scores`, m.
        body_model: name or file of the body model, which replaces the name in the bag; None uses
            the name in the bag.

    Raises:
        ValueError: no mixtures, invalid messages, or no frame with ground truth.
    """
    with BagReader(path) as bag:
        names = chosen_topics(bag, topics)
        found = {
            name: TrackScorer(name, truth, model_sigma=model_sigma, seed=seed) for name in names
        }
        bodies = RecordedBodies(body_model)
        for stored in bodies.messages(bag, names, progress):
            if stored.msgtype == POSE_MIXTURE:
                _read_pose(stored, found[stored.topic], bodies)
            else:
                _read_trajectories(stored, found[stored.topic], bodies)
        return {name: track.finish() for name, track in found.items()}


def score_gravity(path: Path, truth: Truth) -> dict[str, GravityScores]:
    """Computes the scores of the estimated vertical for each topic, if the true vertical is known.

    Raises:
        ValueError: invalid messages.
    """
    with BagReader(path) as bag:
        ups: dict[str, dict[int, tuple[Array, float]]] = {
            topic.name: {} for topic in bag.topics.values() if topic.msgtype == GROUND
        }
        if not ups or not truth.ground:
            return {}
        for stored in bag.messages(ups):
            content = stored.content(ground_of)
            ups[stored.topic][content.stamp_ns] = content.up, content.up_sigma
    found = {name: gravity_scores(mine, truth.ground) for name, mine in ups.items()}
    return {name: scores for name, scores in found.items() if scores is not None}


def chosen_topics(bag: BagReader, wanted: Iterable[str]) -> list[str]:
    """Names of the wanted topics with mixtures; by default all in the bag except ground truth.

    Raises:
        ValueError: no topic has mixtures, or a wanted topic has no mixtures.
    """
    poses = [x.name for x in bag.topics_of(POSE_MIXTURE) if not is_truth(bag, x.name)]
    trajectories = [x.name for x in bag.topics_of(TRAJECTORY_MIXTURE)]
    present = [*poses, *trajectories] or [
        topic.name  # topics without messages, because nobody was in view
        for topic in bag.topics.values()
        if topic.msgtype == POSE_MIXTURE and not topic.message_count
    ]
    chosen = [bag.topic(name).name for name in wanted] or present
    for name in chosen:
        if name not in present:
            raise ValueError(f'{bag.path}: topic {name} has no mixtures to evaluate')
    if not chosen:
        raise ValueError(
            f'{bag.path} has no pose mixtures; it has {", ".join(bag.topics) or "no topics"}'
        )
    return chosen


def _read_pose(stored: BagMessage, track: TrackScorer, bodies: RecordedBodies) -> None:
    content = stored.content(pose_mixture_of)
    _check_frame(track, content.frame_id)
    track.kind = content.kind.name.lower()
    if not len(content.weights):
        return  # nobody was seen, so the frame counts as missing
    mixture = None if content.covariances is None else content.mixture
    body = None if mixture is None else bodies.of(stored.topic, content)
    track.take(
        Estimate(
            content.stamp_ns,
            content.weights,
            mixture,
            content.joint_positions,
            content.joint_names,
            body,
        )
    )


def _read_trajectories(stored: BagMessage, track: TrackScorer, bodies: RecordedBodies) -> None:
    """Adds the marginals of a window to the scores."""
    content = stored.content(trajectory_mixture_of)
    _check_frame(track, content.frame_id)
    track.kind = 'trajectories'
    body = bodies.of(stored.topic, content)
    track.take_window([_marginal(content, t, body) for t in range(len(content.stamps_ns))])


def _marginal(content: TrajectoryMixture, t: int, body: Body | None) -> Estimate:
    covariances = content.marginal_covariances
    mixture = None
    if covariances is not None:
        mixture = GaussianMixture(content.weights, content.means[:, t], covariances[:, t])
    positions = None if body is None else body.joint_positions(content.means[:, t])
    names = () if body is None else body.joint_names
    return Estimate(content.stamps_ns[t], content.weights, mixture, positions, names, body)


def _check_frame(track: TrackScorer, frame_id: str) -> None:
    wanted = track.truth.frame_id
    if wanted and frame_id != wanted:
        raise ValueError(
            f'{track.name} is in the frame {frame_id!r}, {track.truth.source} in {wanted!r}'
        )
