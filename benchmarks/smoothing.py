"""smoothing: what the smoother of the node makes of clips with known truth, live and offline.

The tracker follows every clip with images, with keypoints as well, and with keypoints alone,
gravity given and not, at the rate of the clip and at lower ones. What it says of each image goes
through a `SmootherSession` with the defaults of the node, live, and through its smoother once, over
the whole clip. Beside it stand

- the filter;
- the simplest smoother: the joints of the filter's heaviest mode, averaged over time with the
  Gaussian kernel that is best in the mean over the clips;
- the limit of what any choice of modes can bring: at each time the mode of the filter that is
  nearest to the truth, averaged in the same way. It knows the truth; no method does.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.clips import Clip, at_rate, find_clips, read_clip, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import (
    GIVEN,
    GRAVITIES,
    IMAGES,
    INPUTS,
    Record,
    Seen,
    in_processes,
    recorded,
    tracked,
)
from benchmarks.tracking_means import GROUPS, group_of
from benchmarks.tracking_scores import heaviest_joints, scores_of
from hmt_ros.body import Body
from hmt_ros.body.mirror import propagated
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.reduction import leaders
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.fixed_frame import FixedFrame
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.smoothed_messages import with_shape
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.transform_buffer import Transform
from hmt_ros.tracking.camera_motion import CameraMotion
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

FILTER, LIVE, OFFLINE = 'filter', 'live', 'offline'
AVERAGED, NEAREST = 'filter, averaged', 'nearest modes, averaged'
# Images a second; 0: all of a clip.
RATES = (0.0, 8.0, 3.0)
# Mixtures that are kept for smoothing over the whole clip.
KEPT = 10_000
# Distance of the joints of two modes, in the mean, from which on they are counted apart, m.
APART = 0.03
# Standard deviations of the kernels that joints are averaged with, images.
KERNELS = (1.0, 2.0, 3.0, 4.0, 6.0)
SCORES = (
    'heaviest_mm',
    'best_mm',
    'acceleration',
    'feet',
    'root_percent',
    'joint_coverage_90',
    'absolute_coverage_90',
)
MODES, MS = 'modes', 'ms'
SMOOTHED = 'smoothed_pose_mixture'
QUICK = 12  # images


class Work(NamedTuple):
    """A clip, and how it is seen: see `Run`; `limit` images at most, None: all."""

    folder: Path
    inputs: str
    gravity: str
    rate: float
    limit: int | None


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('smoothing', __doc__, quick=f'{QUICK} images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--names', nargs='+', default=(), metavar='NAME', help='some of the clips')
    options = parser.parse_args(argv)
    return run_benchmark(
        'smoothing',
        lambda: measure(options.clips, options.names, quick=options.quick),
        as_text,
        as_json=options.json,
    )


def measure(
    clips: Path | None = None, names: Sequence[str] = (), *, quick: bool = False
) -> dict[str, Any]:
    """Scores by clip, and their means over groups of clips.

    Args:
        clips: folder of the clips; None: the development clips, or bags/.
        names: of some of them; empty: all.
        quick: a few images of one clip.

    Raises:
        ValueError: there are no such clips, or one can not be read.
    """
    folders, source = find_clips(clips, moving=True, quick=quick)
    if names:
        folders = [x for x in folders if x.name in names]
    if not folders:
        raise ValueError(f'{source}: none of the clips {list(names)} is there')
    inputs, gravities, rates, limit = INPUTS, GRAVITIES, RATES, None
    if quick:
        folders, inputs, gravities, rates, limit = folders[:1], (IMAGES,), (GIVEN,), (0.0,), QUICK
    work = [
        Work(folder, given, known, rate, limit)
        for rate in rates for given in inputs for known in gravities for folder in folders
        if given == IMAGES or (folder / 'keypoints_mediapipe.npz').is_file()
    ]  # fmt: skip
    found = in_processes(of_clip, work, 1 if quick else 0, 'smoothing')
    entries = [
        {
            'clip': one.folder.name, 'inputs': one.inputs, 'gravity': one.gravity,
            'rate': one.rate, 'scores': scores,
        }
        for one, scores in zip(work, found, strict=True)
    ]  # fmt: skip
    means = []
    for rate in rates:
        for group in GROUPS:
            for given in inputs:
                for known in gravities:
                    kind = {'inputs': given, 'gravity': known, 'rate': rate}
                    own = [
                        x['scores'] for x in entries
                        if group_of(x['clip']) == group and kind.items() <= x.items()
                    ]  # fmt: skip
                    if own:
                        means.append({'clips': group, **kind, 'scores': mean(own)})
    return {'machine': description(), 'clips': entries, 'means': means}


def mean(scores: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Means over clips by way; of kernels the one that is best in the mean."""
    result = {
        way: {name: _known_mean([x[way][name] for x in scores]) for name in scores[0][way]}
        for way in scores[0]
    }
    for way in (AVERAGED, NEAREST):
        kernels = [name for name in result if name.startswith(way)]
        best = min(kernels, key=lambda name: result[name]['heaviest_mm'])
        for name in kernels:
            if name != best:
                del result[name]
    return result


def _known_mean(values: Sequence[float]) -> float:
    """The mean of the values that are known; NaN: none is."""
    known = [x for x in values if np.isfinite(x)]
    return float(np.mean(known)) if known else float('nan')


def of_clip(work: Work) -> dict[str, dict[str, float]]:
    """Scores of one clip by way."""
    clip = at_rate(read_clip(work.folder, work.limit), work.rate)
    seen = tracked(clip, work.inputs, work.gravity)
    mixtures = {FILTER: {x.stamp: x.posterior for x in seen}}
    found, ms = smoothed(seen, clip.views)
    mixtures |= found
    records = {way: record_of(clip, seen, found) for way, found in mixtures.items()}
    result = {}
    for way, record in records.items():
        scores = scores_of(record)
        result[way] = {name: float(scores[name]) for name in SCORES}
        result[way] |= {MODES: modes_apart(record), MS: ms if way == LIVE else float('nan')}
    own = records[FILTER]
    plain = {AVERAGED: heaviest_joints(own), NEAREST: nearest_joints(own)}
    for way, joints in plain.items():
        for width in KERNELS:
            smooth = gaussian_filter1d(joints, width, axis=0)
            one = replace(
                own, joints=smooth[:, None], weights=np.ones((len(smooth), 1)), point=smooth
            )
            result[f'{way} over {width:g} images'] = {
                'heaviest_mm': float(scores_of(one)['heaviest_mm'])
            }
    return result


def modes_apart(record: Record) -> float:
    """How many modes of an image are apart by `APART`, in the mean over images."""
    relative = record.joints - record.joints[:, :, :1]
    counts = []
    for joints, weights in zip(relative, record.weights, strict=True):
        some = joints[weights > 0]

        def distances(i: int, some: Array = some) -> Array:
            return np.asarray(np.nanmean(np.linalg.norm(some - some[i], axis=2), axis=1))

        counts.append(len(leaders(weights[weights > 0], distances, APART)))
    return float(np.mean(counts))


def nearest_joints(record: Record) -> Array:
    """Joints (T, J, 3) of the modes that are nearest to the truth."""
    away = (record.joints - record.joints[:, :, :1]) - (record.true - record.true[:, :1])[:, None]
    known = np.isfinite(record.true).all((0, 2))
    errors = np.linalg.norm(away, axis=3)[:, :, known].mean(2)
    nearest = np.where(record.weights > 0, errors, np.inf).argmin(1)
    return np.asarray(record.joints[np.arange(len(nearest)), nearest])


def smoothed(
    seen: Sequence[Seen], views: Mapping[int, tuple[Array, Array]] = MappingProxyType({})
) -> tuple[dict[str, dict[int, GaussianMixture]], float]:
    """What the node publishes, and what it makes of all images together, by way and stamp.

    Also the median time that it takes over an image, ms.

    Args:
        seen: of the images.
        views: stamp -> rotation (3, 3) and position (3,) of a camera that moves, in the world;
            its node is given likelihoods in the frame of the world, as `fixed_frame` has them.
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
            one.body, likelihood, MixtureKind.LIKELIHOOD, one.stamp, 'camera',
            state=TrackState.TRACKING, track_id=1, error_share=told.errors.independent,
            error_time=told.errors.time, shape_covariance=shapes[one.stamp],
            identities=told.identities, posterior_weights=told.posterior_weights,
            ancestry=told.origins, ancestry_stamp_ns=told.ancestry_stamp or 0,
            ancestry_ids=told.ancestors,
        )  # fmt: skip
        message = pose_mixture_message(messages, content)
        start = time.perf_counter()
        handled = session.take(MIXTURE, message)
        spent.append(time.perf_counter() - start)
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
    return placed, 1e3 * float(np.median(spent))


def _seen_again(mixture: GaussianMixture, body: Body, frame: FixedFrame | None) -> GaussianMixture:
    """A mixture in the frame of the camera again."""
    if frame is None:
        return mixture
    back = CameraMotion(
        frame.motion.rotation.T, -frame.motion.rotation.T @ frame.motion.translation
    )
    means = back.free_poses(body, mixture.means)
    jacobians = back.jacobians(body, mixture.means, means)
    return replace(mixture, means=means, covariances=propagated(jacobians, mixture.covariances))


def record_of(clip: Clip, seen: Sequence[Seen], mixtures: dict[int, GaussianMixture]) -> Record:
    """Mixtures by stamp, with the truth; their point estimate is the heaviest mode."""
    rows = [x for x in seen if x.stamp in mixtures and x.stamp in clip.truth.joints]
    found = [mixtures[x.stamp] for x in rows]
    points = [one.means[one.weights.argmax()] for one in found]
    return recorded(clip, [x.body for x in rows], found, points, [x.stamp for x in rows], 0)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    tables = (error_rows(result), motion_rows(result))
    return '\n\n'.join(table(rows, left=2, markdown=markdown) for rows in tables)


def error_rows(result: dict[str, Any]) -> list[list[str]]:
    """A table for people: errors of the heaviest pose by way, means over groups of clips, mm."""
    ways = [FILTER, LIVE, OFFLINE, AVERAGED, NEAREST]
    rows = [['inputs', 'gravity', 'images a second', *ways]]
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows.append([group, *[''] * (len(rows[0]) - 1)])
        for entry in result['means']:
            if entry['clips'] == group:
                found = {
                    name.split(' over ')[0]: scores['heaviest_mm']
                    for name, scores in entry['scores'].items()
                }
                rate = f'{entry["rate"]:g}' if entry['rate'] else 'all'
                cells = [f'{found[way]:.1f}' for way in ways]
                rows.append([entry['inputs'], entry['gravity'], rate, *cells])
    return rows


def motion_rows(result: dict[str, Any]) -> list[list[str]]:
    """A table for people: what filter and smoother are besides, of all images, by group."""
    rows = [
        [
            'inputs', 'gravity', '', 'best of 8, mm', 'modes apart', 'acceleration', 'feet, m/s',
            'root, %', 'joint 90 %', 'in the camera', 'ms an image',
        ]
    ]  # fmt: skip
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows.append([group, *[''] * (len(rows[0]) - 1)])
        for entry in result['means']:
            if entry['clips'] != group or entry['rate']:
                continue
            for way in (FILTER, LIVE, OFFLINE):
                s = entry['scores'][way]
                cells = [
                    f'{s["best_mm"]:.1f}', f'{s[MODES]:.1f}', f'{s["acceleration"]:.1f}',
                    f'{s["feet"]:.2f}', f'{s["root_percent"]:.1f}',
                ]  # fmt: skip
                cells += [
                    '-' if np.isnan(s[name]) else f'{100 * s[name]:.0f} %' for name in SCORES[-2:]
                ]
                cells.append('' if np.isnan(s[MS]) else f'{s[MS]:.1f}')
                rows.append([entry['inputs'], entry['gravity'], way, *cells])
    return rows
