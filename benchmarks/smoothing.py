"""smoothing: accuracy of the node's smoother on clips with known truth, live and offline.

The tracker follows every clip with images, with images and keypoints, and with keypoints alone, at
the rate of the clip and at lower ones; gravity is given if the clip contains it. Its results go
through a `SmootherSession` with the defaults of the node (live), and once through its smoother over
the whole clip (offline). The filter is scored at the same images.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, at_rate, find_clips, read_clip, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import GIVEN, IMAGES, INPUTS, Record, Seen, in_processes, recorded, tracked
from benchmarks.tracking_means import (
    GROUPS,
    OF_APART,
    OF_CHOSEN,
    OF_OTHERS,
    Key,
    entry_of,
    group_of,
    means_of,
)
from benchmarks.tracking_scores import scores_of
from benchmarks.tracking_tables import Column
from hmt_ros.body import Body
from hmt_ros.body.mirror import propagated
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.fixed_frame import FixedFrame
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.smoothed_messages import with_shape
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.transform_buffer import Transform
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.selection import distinct_hypotheses
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
    pose_mixture_of,
)

Array = NDArray[np.float64]

FILTER, LIVE, OFFLINE = WAYS = 'filter', 'live', 'offline'
# Images per second; 0 means all images of a clip.
RATES = (0.0, 8.0, 3.0)
# Length of the smoothing window, in mixtures, for a whole clip.
KEPT = 10_000
# Minimum mean distance of the joints of distinct modes, m, and minimum weight of a counted mode.
APART, LIKELY = 0.03, 0.01
TOGETHER = 'Both'
GROUP_ORDER = (OF_CHOSEN, OF_OTHERS, TOGETHER, OF_APART)
ERROR = Column('heaviest, mm', 'heaviest_mm', '.1f')
BEST = Column('best, mm', 'best_mm', '.1f')
DENSITY = Column('log density', 'density', '.2f')
DISTINCT = Column('distinct', 'distinct', '.1f')
CPU = Column('CPU, ms', 'cpu_ms', '.1f')
MOTION = (
    Column('joint 90 %', 'joint_coverage_90', factor=100.0),
    Column('absolute 90 %', 'absolute_coverage_90', factor=100.0),
    Column('acceleration', 'acceleration', '.1f'),
    Column('feet, m/s', 'feet', '.2f'),
    Column('root, %', 'root_percent', '.1f'),
    Column('log(K w)', 'weights', '.2f'),
)
# Keys of `scores_of`.
SCORES = tuple(x.key for x in (ERROR, BEST, *MOTION))
PERCENT = 'percent'  # difference from the filter's error, %
SMOOTHED = 'smoothed_pose_mixture'
QUICK = 12  # number of images with --quick


class Work(NamedTuple):
    """A clip and its conditions, see `Run`; `limit` is the maximum number of images or None."""

    folder: Path
    inputs: str
    rate: float
    seed: int
    limit: int | None


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('smoothing', __doc__, quick=f'{QUICK} images of one clip')
    parser.add_argument('--markdown', action='store_true', help='tables for a Markdown page')
    parser.add_argument('--clips', type=Path, metavar='DIR', help='folder of the clips')
    parser.add_argument('--names', nargs='+', default=(), metavar='NAME', help='some of the clips')
    parser.add_argument('--inputs', nargs='+', choices=INPUTS, default=INPUTS)
    parser.add_argument(
        '--rates',
        type=float,
        nargs='+',
        metavar='HZ',
        default=RATES,
        help='images a second at most; 0: all images',
    )
    parser.add_argument(
        '--seeds', type=int, default=1, metavar='N', help='of the tracker, where all images count'
    )
    o = parser.parse_args(argv)
    measured = partial(measure, o.clips, o.names, o.inputs, o.rates, o.seeds, quick=o.quick)
    text = partial(as_text, markdown=o.markdown)
    return run_benchmark('smoothing', measured, text, as_json=o.json)


def measure(
    clips: Path | None = None,
    names: Sequence[str] = (),
    inputs: Sequence[str] = INPUTS,
    rates: Sequence[float] = RATES,
    seeds: int = 1,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Scores by clip, and their means over groups of clips.

    Args:
        clips: folder of the clips; None means the development clips, or bags/.
        names: names of the clips to use; empty means all.
        inputs: some of `runs.INPUTS`.
        rates: maximum numbers of images per second; 0 means all images.
        seeds: number of seeds of the tracker for all images; lower rates have one seed.
        quick: a few images of one clip.

    Raises:
        ValueError: there are no such clips, or a clip can not be read.
    """
    folders, source = find_clips(clips, moving=True, quick=quick)
    if names:
        folders = [x for x in folders if x.name in names]
    if not folders:
        raise ValueError(f'{source}: none of the clips {list(names)} is there')
    limit = None
    if quick:
        folders, inputs, rates, seeds, limit = folders[:1], (IMAGES,), (0.0,), 1, QUICK
    work = [
        Work(folder, given, rate, seed, limit)
        for rate in rates
        for given in inputs
        for folder in folders
        if given == IMAGES or (folder / 'keypoints_mediapipe.npz').is_file()
        for seed in range(1 if rate else seeds)
    ]
    found: dict[Key, list[dict[str, float]]] = {}
    for one, scores in zip(
        work, in_processes(of_clip, work, 1 if quick else 0, 'smoothing'), strict=True
    ):
        key = (one.folder.name, one.inputs, one.rate, GIVEN)
        found.setdefault(key, []).append(scores)
    entries = [entry_of(key, scores) for key, scores in found.items()]
    groups = {title: [x for x in entries if group_of(x['clip']) == title] for title in GROUPS}
    groups[TOGETHER] = groups[OF_CHOSEN] + groups[OF_OTHERS]
    means = {title: means_of(groups[title]) for title in GROUP_ORDER}
    return {'machine': description(), 'seeds': seeds, 'clips': entries, 'means': means}


def of_clip(work: Work) -> dict[str, float]:
    """Scores of one clip, `filter heaviest_mm` and so on.

    For the smoother also the difference of each score from the filter's, `live heaviest_mm change`,
    and that of its errors in % of the filter's, `live percent`.
    """
    clip = at_rate(read_clip(work.folder, work.limit), work.rate)
    seen = tracked(clip, work.inputs, GIVEN, work.seed)
    mixtures, cpu = smoothed(seen, clip.views)
    mixtures[FILTER] = {x.stamp: x.posterior for x in seen}
    shared = set.intersection(*map(set, mixtures.values()))
    rows = [x for x in seen if x.stamp in shared]
    found = {way: _scores(record_of(clip, rows, mixtures[way])) for way in WAYS}
    result = {f'{way} {name}': x for way in WAYS for name, x in found[way].items()}
    own = found[FILTER]
    for way in (LIVE, OFFLINE):
        result |= {f'{way} {name} change': x - own[name] for name, x in found[way].items()}
        result[f'{way} {PERCENT}'] = 100.0 * (found[way][ERROR.key] / own[ERROR.key] - 1.0)
    result[f'{LIVE} {CPU.key}'] = cpu
    return result


def _scores(record: Record) -> dict[str, float]:
    """Scores of a record for the tables, without processor time."""
    scores = scores_of(record)
    joints = record.joint_levels.shape[1]
    return {
        **{name: float(scores[name]) for name in SCORES},
        DENSITY.key: -float(scores['negative_log_likelihood']) / joints,
        DISTINCT.key: modes_apart(record),
    }


def modes_apart(record: Record) -> float:
    """Mean number of likely modes of an image that differ by `APART`."""
    relative = record.joints - record.joints[:, :, :1]
    counts = []
    for joints, weights in zip(relative, record.weights, strict=True):
        likely = weights > LIKELY
        some = joints[likely][:, np.isfinite(joints[likely]).all((0, 2))]
        counts.append(len(distinct_hypotheses(some, weights[likely], APART)))
    return float(np.mean(counts))


def smoothed(
    seen: Sequence[Seen], views: Mapping[int, tuple[Array, Array]] = MappingProxyType({})
) -> tuple[dict[str, dict[int, GaussianMixture]], float]:
    """Mixtures that the node publishes, and those smoothed over all images, by way and timestamp.

    Also returns the mean processor time of the node per image, ms.

    Args:
        seen: results of the tracker for the images.
        views: timestamp -> rotation (3, 3) and position (3,) in the world of a moving camera; the
            node then gets likelihoods in the world frame, as with `fixed_frame`.
    """
    frames: dict[int, FixedFrame] = {}
    turn = 0.0
    for one in seen:
        if one.stamp in views:
            rotation, position = views[one.stamp]
            frame = FixedFrame('world', Transform(rotation, position), turn)
            turn = frame.turn_of(one.body, one.posterior.means[0])
            frames[one.stamp] = frame
    outputs: list[Output] = []
    spent: list[float] = []
    messages = RosbagsMessages()
    parameters = with_values(SmootherParameters(), {'window_length': KEPT})
    session = SmootherSession(parameters, outputs.append, SMOOTHED.__eq__)
    shapes = {x.stamp: x.likelihood.shape_covariance for x in seen}
    for one in seen:
        likelihood, told = one.likelihood.mixture, one.likelihood
        if one.stamp in frames:
            in_world = frames[one.stamp].placed
            likelihood = in_world(one.body, likelihood)[0]
            at_best = replace(one.posterior[[0]], covariances=told.shape_covariance[None])
            shapes[one.stamp] = in_world(one.body, at_best)[0].covariances[0]
        content = PoseMixture.of_body(
            one.body,
            likelihood,
            MixtureKind.LIKELIHOOD,
            one.stamp,
            'camera',
            state=TrackState.TRACKING,
            track_id=1,
            error_share=told.errors.independent,
            error_time=told.errors.time,
            shape_covariance=shapes[one.stamp],
            identities=told.identities,
            posterior_weights=told.posterior_weights,
            ancestry=told.origins,
            ancestry_stamp_ns=told.ancestry_stamp or 0,
            ancestry_ids=told.ancestors,
        )
        message = pose_mixture_message(messages, content)
        start = time.process_time()
        handled = session.take(MIXTURE, message)
        spent.append(time.process_time() - start)
        if handled.faults:
            raise ValueError(handled.faults[0])
    whole, _ = session.smoothed_span()
    assert whole.stamps_ns is not None
    offline = {
        stamp: with_shape(whole.marginal(t), shapes[stamp])
        for t, stamp in enumerate(whole.stamps_ns)
    }
    session.finish()
    found = [pose_mixture_of(deserialise(x.data, 'hmt_msgs/msg/PoseMixture')) for x in outputs]
    result = {LIVE: {x.stamp_ns: x.mixture for x in found}, OFFLINE: offline}
    bodies = {x.stamp: x.body for x in seen}
    placed = {
        way: {t: _seen_again(x, bodies[t], frames.get(t)) for t, x in of_way.items()}
        for way, of_way in result.items()
    }
    return placed, 1e3 * float(np.mean(spent))


def _seen_again(mixture: GaussianMixture, body: Body, frame: FixedFrame | None) -> GaussianMixture:
    """A mixture transformed back to the camera frame."""
    if frame is None:
        return mixture
    back = CameraMotion(
        frame.motion.rotation.T, -frame.motion.rotation.T @ frame.motion.translation
    )
    means = back.free_poses(body, mixture.means)
    jacobians = back.jacobians(body, mixture.means, means)
    return replace(mixture, means=means, covariances=propagated(jacobians, mixture.covariances))


def record_of(clip: Clip, seen: Sequence[Seen], mixtures: dict[int, GaussianMixture]) -> Record:
    """Record of mixtures by timestamp; their point estimate is the heaviest mode."""
    rows = [x for x in seen if x.stamp in clip.truth.joints]
    found = [mixtures[x.stamp] for x in rows]
    points = [one.means[one.weights.argmax()] for one in found]
    return recorded(clip, [x.body for x in rows], found, points, [x.stamp for x in rows], 0)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables."""
    ends = 'the 95 % interval over clips and seeds'
    parts = (
        f'Errors of the heaviest component, mm, and the mean over clips of what they differ from '
        f"the filter's by, %, with {ends}. Seeds: {result['seeds']}, at lower rates 1.",
        table(error_rows(result), left=2, markdown=markdown),
        f'Log density of the true joints, nats a joint, and the difference from the filter, with '
        f'{ends}; components that are {1e3 * APART:.0f} mm apart and have more than '
        f'{100 * LIKELY:.0f} % of the weight; error of the best component, mm. All images.',
        table(density_rows(result), left=2, markdown=markdown),
        'True joints in 90 % regions, relative to the pelvis and in the frame of the camera; '
        'accelerations over the true ones; feet that stand; distance of the root; log(K w) of the '
        'component nearest to the truth; processor time of an image in the node. All images.',
        table(motion_rows(result), left=2, markdown=markdown),
    )
    return '\n\n'.join(parts)


def _of(way: str, column: Column) -> Column:
    """A column of a way."""
    return column._replace(head=f'{way}: {column.head}', key=f'{way} {column.key}')


def _cell(column: Column, entry: dict[str, Any]) -> str:
    """Text of a score of a clip or of means over clips; differences have an interval."""
    value = entry.get(column.key)
    if not isinstance(value, tuple):
        return column.cell(value)
    text = column.cell(value[0])
    if not column.form.startswith('+') or value[1] is None:
        return text
    return f'{text} ({column.cell(value[1])} to {column.cell(value[2])})'


def error_rows(result: dict[str, Any]) -> list[list[str]]:
    """Errors of the heaviest component by way, means over groups of clips."""
    columns = [_of(way, ERROR) for way in WAYS]
    columns += [Column(f'{way}, %', f'{way} {PERCENT}', '+.1f') for way in (LIVE, OFFLINE)]
    rows = [['inputs', 'images a second', *(x.head for x in columns)]]
    for group, means in result['means'].items():
        rows += [[group, *[''] * (len(rows[0]) - 1)]] if means else []
        rows += [
            [one['inputs'], f'{one["rate"]:g}' if one['rate'] else 'all']
            + [_cell(column, one) for column in columns]
            for one in means
        ]
    return rows


def density_rows(result: dict[str, Any]) -> list[list[str]]:
    """Densities and components by clip and way, with means over clips."""
    columns = [_of(way, DENSITY) for way in WAYS]
    columns += [
        Column(f'{way} - filter', f'{way} {DENSITY.key} change', '+.2f') for way in (LIVE, OFFLINE)
    ]
    columns += [_of(way, column) for column in (DISTINCT, BEST) for way in WAYS]
    entries = result['clips'] + [{'clip': 'mean', **x} for x in result['means'][TOGETHER]]
    full = [x for x in entries if not x['rate']]
    return [
        ['clip', 'inputs', *(x.head for x in columns)],
        *(
            [one['clip'], given, *(_cell(column, one) for column in columns)]
            for given in INPUTS
            for one in full
            if one['inputs'] == given
        ),
    ]


def motion_rows(result: dict[str, Any]) -> list[list[str]]:
    """Further scores of filter and smoother, means over groups of clips."""
    columns = (*MOTION, CPU)
    rows = [['inputs', '', *(x.head for x in columns)]]
    for group, means in result['means'].items():
        rows += [[group, *[''] * (len(rows[0]) - 1)]] if means else []
        rows += [
            [one['inputs'], way, *(_cell(_of(way, column), one) for column in columns)]
            for one in means
            if not one['rate']
            for way in WAYS
        ]
    return rows
