"""forecast: the tracker's predictions of future poses, compared with holding the last pose.

The tracker follows all clips with known truth, with given gravity. After each image it predicts the
pose at later times: `forecast`, as in `pose_forecast`. This is compared with the pose of that image
held, and moved at the velocity of the mode; and with the error of the pose in its own image, which
is the least that a forecast can have.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clips import find_clips, read_clip, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import BOTH, GIVEN, IMAGES, begun, in_processes, stepped
from benchmarks.tracking_means import GROUPS, group_of
from hmt_ros.body import Body
from hmt_ros.evaluation.track_scores import Estimate, TrackScorer
from hmt_ros.inference import GaussianMixture
from msg_tools.messages.headers import SECOND_NS

AHEAD = (0.1, 0.2, 0.5)  # times of the forecasts after an image, s
FORECAST, HELD, CONSTANT, THEN = 'forecast', 'held', 'constant velocity', 'in its own image'
WAYS = (FORECAST, HELD, CONSTANT, THEN)
QUICK = 12  # number of images with --quick
# Maximum difference between the time of a forecast and that of the nearest truth, s.
NEAR = 0.02


class Work(NamedTuple):
    """A clip, the inputs of the tracker, and the maximum number of images or None."""

    folder: Path
    inputs: str
    limit: int | None


def of_clip(work: Work) -> dict[str, dict[str, float]]:
    """Error of the heaviest mode, mm, and coverage of 90 % regions, by time ahead and way."""
    clip = read_clip(work.folder, work.limit)
    tracker, keypoints = begun(clip, work.inputs)
    scorers = {f'{way} {ahead:g}': TrackScorer(way, clip.truth) for way in WAYS for ahead in AHEAD}
    stamps = np.array(sorted(clip.truth.joints))
    for stamp, posterior, *_ in stepped(clip, tracker, keypoints, gravity=GIVEN):
        if posterior is None:
            continue
        for ahead in AHEAD:
            then = int(stamps[np.argmin(abs(stamps - stamp - round(ahead * SECOND_NS)))])
            if abs(then - stamp - ahead * SECOND_NS) > NEAR * SECOND_NS:
                continue
            interval = (then - stamp) / SECOND_NS
            velocities = tracker.estimate.velocities
            moved = posterior.means.copy()
            if velocities is not None:
                moved += interval * velocities
            made = {
                FORECAST: (then, tracker.estimate.forecaster.at(then)),
                HELD: (then, posterior),
                CONSTANT: (then, replace(posterior, means=moved)),
                THEN: (stamp, posterior),
            }
            for way, (at, mixture) in made.items():
                scorers[f'{way} {ahead:g}'].take(_estimate(at, mixture, tracker.estimate.body))
    found = {name: scorer.finish().scores.summary() for name, scorer in scorers.items()}
    # None if the truth has no such time.
    scores = {
        name: [np.nan if one[x] is None else one[x] for x in ('heaviest_mm', 'joint_coverage_90')]
        for name, one in found.items()
    }
    return {name: dict(zip(('mm', 'region'), one, strict=True)) for name, one in scores.items()}


def _estimate(stamp: int, mixture: GaussianMixture, body: Body) -> Estimate:
    return Estimate(
        stamp, mixture.weights, mixture, body.joint_positions(mixture.means), body.joint_names, body
    )


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Scores of `of_clip` for all clips, as means over groups of clips.

    Raises:
        ValueError: there are no clips, or one can not be read.
    """
    folders = find_clips(clips, quick=quick)[0]
    folders = [
        x for x in folders if quick or clips is not None or (x / 'keypoints_mediapipe.npz').exists()
    ]
    inputs, limit = (IMAGES, BOTH), None
    if quick:
        folders, inputs, limit = folders[:1], (IMAGES,), QUICK + 6
    work = [Work(x, given, limit) for given in inputs for x in folders]
    found = in_processes(of_clip, work, 1 if quick else 0, 'forecast')
    means = []
    for group in GROUPS:
        for given in inputs:
            own = [
                scores for one, scores in zip(work, found, strict=True)
                if one.inputs == given and group_of(one.folder.name) == group
            ]  # fmt: skip
            means += [
                {
                    'clips': group, 'inputs': given, 'ahead': ahead,
                    **{way: _mean(own, f'{way} {ahead:g}') for way in WAYS},
                }
                for ahead in AHEAD if own
            ]  # fmt: skip
    return {'machine': description(), 'means': means}


def _mean(scores: list[dict[str, dict[str, float]]], name: str) -> dict[str, float]:
    known = [one[name] for one in scores if np.isfinite(one[name]['mm'])]
    mean = {x: [one[x] for one in known] or [np.nan] for x in ('mm', 'region')}
    return {what: float(np.mean(values)) for what, values in mean.items()}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [['inputs', 'ahead', *WAYS, 'forecast : held', '90 % regions']]
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows.append([group, *[''] * (len(rows[0]) - 1)])
        rows += [
            [
                one['inputs'], f'{one["ahead"]:g} s',
                *(f'{one[way]["mm"]:.0f} mm' for way in WAYS),
                f'{one[FORECAST]["mm"] / one[HELD]["mm"]:.2f}',
                f'{100 * one[FORECAST]["region"]:.0f} %',
            ]
            for one in result['means'] if one['clips'] == group
        ]  # fmt: skip
    return table(rows, markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('forecast', __doc__, quick=f'{QUICK} images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of clips')
    options = parser.parse_args(argv)
    return run_benchmark(
        'forecast',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
