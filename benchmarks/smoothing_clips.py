"""What the smoother of the node makes of clips with known truth, live and offline.

The tracker follows every clip with images, with keypoints as well, and with keypoints alone,
gravity given and not. What it says of each image goes through a `SmootherSession` with the defaults
of the node, live, and through its smoother once, over the whole clip. Beside it stand the filter
and the simplest smoother: the joints of the heaviest mode of the filter, averaged over time with
the Gaussian kernel that is best in the mean over the clips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.clips import Clip, find_clips, read_clip, read_detections
from benchmarks.runs import (
    GIVEN,
    GRAVITIES,
    IMAGES,
    INPUTS,
    KEYPOINTS,
    Record,
    in_processes,
    keypoints_only,
    new_tracker,
    recorded,
)
from benchmarks.tracking_means import GROUPS, group_of
from benchmarks.tracking_scores import heaviest_joints, scores_of
from hmt_ros.body import Body, load_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.inference.reduction import merged_pairwise
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.smoothing.mixture_smoother import PathSmoother
from hmt_ros.tracking import TrackerSettings
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

FILTER, LIVE, OFFLINE, AVERAGED = 'filter', 'live', 'offline', 'filter, averaged'
# Mixtures that are kept for smoothing over the whole clip, and components of a smoothed pose.
KEPT, COMPONENTS = 10_000, 8
# Standard deviations of the kernels that the heaviest mode is averaged with, images.
KERNELS = (1.0, 2.0, 3.0, 4.0, 6.0)
SCORES = (
    'heaviest_mm', 'best_mm', 'acceleration', 'feet', 'root_percent', 'joint_coverage_90',
    'absolute_coverage_90',
)  # fmt: skip
SMOOTHED = 'smoothed_pose_mixture'


class Seen(NamedTuple):
    """What the tracker says of an image."""

    stamp: int
    body: Body
    posterior: GaussianMixture
    likelihood: GaussianMixture
    errors: CueErrors


Work = tuple[Path, str, str, int | None]


def clips(quick: bool = False) -> dict[str, Any] | str:
    """Scores by clip, and their means over groups of clips, or why there are none."""
    try:
        folders, source = find_clips(None, moving=True)
    except ValueError as error:
        return f'skipped: {error}'
    folders = [x for x in folders if (x / 'keypoints_mediapipe.npz').exists()]
    if not folders:
        return f'skipped: {source} has no keypoints_mediapipe.npz'
    inputs, gravities, limit = INPUTS, GRAVITIES, None
    if quick:
        folders, inputs, gravities, limit = folders[:1], (IMAGES,), (GIVEN,), 12
    work = [(x, given, known, limit) for given in inputs for known in gravities for x in folders]
    found = in_processes(of_clip, work, 0, 'smoothing: clips')
    entries = [
        {'clip': folder.name, 'inputs': given, 'gravity': known, 'scores': scores}
        for (folder, given, known, _), scores in zip(work, found, strict=True)
    ]
    means = []
    for group in GROUPS:
        for given in inputs:
            for known in gravities:
                own = [
                    x['scores'] for x in entries
                    if (group_of(x['clip']), x['inputs'], x['gravity']) == (group, given, known)
                ]  # fmt: skip
                if own:
                    means.append(
                        {'clips': group, 'inputs': given, 'gravity': known, 'scores': mean(own)}
                    )
    return {'clips': entries, 'means': means}


def mean(scores: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Means over clips by way; of the kernels the one that is best in the mean."""
    result = {
        way: {name: _known_mean([x[way][name] for x in scores]) for name in scores[0][way]}
        for way in scores[0]
    }
    kernels = [way for way in result if way.startswith(AVERAGED)]
    best = min(kernels, key=lambda way: result[way]['heaviest_mm'])
    return {way: found for way, found in result.items() if way == best or way not in kernels}


def _known_mean(values: Sequence[float]) -> float:
    """The mean of the values that are known; NaN: none is."""
    known = [x for x in values if np.isfinite(x)]
    return float(np.mean(known)) if known else float('nan')


def of_clip(work: Work) -> dict[str, dict[str, float]]:
    """Scores of one clip by way: folder, inputs, gravity, number of images (None: all)."""
    folder, inputs, gravity, limit = work
    clip = read_clip(folder, limit)
    seen = tracked(clip, inputs, gravity)
    mixtures = {FILTER: {x.stamp: x.posterior for x in seen}}
    mixtures[LIVE], mixtures[OFFLINE] = smoothed(seen)
    records = {way: record_of(clip, seen, found) for way, found in mixtures.items()}
    result = {}
    for way, record in records.items():
        scores = scores_of(record)
        result[way] = {name: float(scores[name]) for name in SCORES}
    heaviest = heaviest_joints(records[FILTER])
    for width in KERNELS:
        joints = gaussian_filter1d(heaviest, width, axis=0)
        record = replace(
            records[FILTER], joints=joints[:, None], weights=np.ones((len(joints), 1)), point=joints
        )
        scores = scores_of(record)
        result[f'{AVERAGED} over {width:g} images'] = {
            name: float(scores[name]) if 'coverage' not in name else np.nan for name in SCORES
        }
    return result


def tracked(clip: Clip, inputs: str, gravity: str) -> list[Seen]:
    """What the tracker says of the images of a clip; `inputs` and `gravity` as of a `Run`."""
    settings = TrackerSettings()
    if inputs == KEYPOINTS:
        settings = keypoints_only(settings)
    found = {} if inputs == IMAGES else read_detections(clip.folder).keypoints
    tracker = new_tracker(clip, load_body('human37'), settings, 0)
    result = []
    for stamp, image in zip(clip.stamps, clip.images, strict=True):
        if stamp in clip.views:
            rotation, position = clip.views[stamp]
            tracker.set_camera(position, rotation)
        if gravity == GIVEN and stamp in clip.ups:
            tracker.set_gravity(clip.ups[stamp])
        posterior, likelihood = tracker.step(image, stamp, found.get(stamp))
        if posterior is not None and likelihood is not None:
            result.append(
                Seen(stamp, tracker.body, posterior, likelihood, tracker.likelihood_errors)
            )
    return result


def smoothed(
    seen: Sequence[Seen],
) -> tuple[dict[int, GaussianMixture], dict[int, GaussianMixture]]:
    """What the node publishes, and what it makes of all images together, by stamp."""
    outputs: list[Output] = []
    messages = RosbagsMessages()
    parameters = with_values(SmootherParameters(), {'window_length': KEPT})
    session = SmootherSession(parameters, outputs.append, SMOOTHED.__eq__)
    for one in seen:
        content = PoseMixture.of_body(
            one.body, one.likelihood, MixtureKind.LIKELIHOOD, one.stamp, 'camera',
            state=TrackState.TRACKING, track_id=1, error_share=one.errors.independent,
            error_time=one.errors.time,
        )  # fmt: skip
        handled = session.take(MIXTURE, pose_mixture_message(messages, content))
        if handled.faults:
            raise ValueError(handled.faults[0])
    whole, _ = session.smoothed_span(PathSmoother)
    assert whole.stamps_ns is not None
    offline = {
        stamp: merged_pairwise(whole.marginal(t), COMPONENTS).normalised()
        for t, stamp in enumerate(whole.stamps_ns)
    }
    session.finish()
    found = [pose_mixture_of(deserialise(x.data, 'hmt_msgs/msg/PoseMixture')) for x in outputs]
    return {x.stamp_ns: x.mixture for x in found}, offline


def record_of(clip: Clip, seen: Sequence[Seen], mixtures: dict[int, GaussianMixture]) -> Record:
    """Mixtures by stamp, with the truth; their point estimate is the heaviest mode."""
    rows = [x for x in seen if x.stamp in mixtures and x.stamp in clip.truth.joints]
    found = [mixtures[x.stamp] for x in rows]
    points = [one.means[one.weights.argmax()] for one in found]
    nothing = [0.0] * len(rows)
    return recorded(
        clip, [x.body for x in rows], found, points, [x.stamp for x in rows], nothing, nothing, 0
    )


def as_rows(result: dict[str, Any]) -> list[list[str]]:
    """A table for people: means over groups of clips."""
    rows = [
        [
            'inputs', 'gravity', '', 'heaviest, mm', 'best of 8', 'acceleration', 'feet, m/s',
            'root, %', 'joint 90 %', 'in the camera',
        ]
    ]  # fmt: skip
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows.append([group, *[''] * (len(rows[0]) - 1)])
        for entry in result['means']:
            if entry['clips'] != group:
                continue
            for way, s in entry['scores'].items():
                cells = [
                    f'{s["heaviest_mm"]:.1f}', f'{s["best_mm"]:.1f}', f'{s["acceleration"]:.1f}',
                    f'{s["feet"]:.2f}', f'{s["root_percent"]:.1f}',
                ]  # fmt: skip
                cells += [
                    '-' if np.isnan(s[name]) else f'{100 * s[name]:.0f} %' for name in SCORES[-2:]
                ]
                rows.append([entry['inputs'], entry['gravity'], way, *cells])
    return rows
