"""distance: how far away a person is taken to be, by what is known of the person and the place.

Rendered clips, keypoints alone, a start from keypoints. The distance is that of the middle of the
hips along the axis of the camera, of the heaviest mode: root mean square and mean of its relative
error over the clips, at the start and later, and the standard deviation that is published.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, find_clips, read_clip, read_detections, table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import description
from benchmarks.runs import keypoints_only, new_tracker, subject_of
from hmt_ros.body import load_body
from hmt_ros.evaluation.pose_scores import HIPS, joint_mixtures
from hmt_ros.tracking import Subject, Tracker, TrackerSettings

NOTHING, FLOOR, STATURE, LENGTHS = (
    'nothing', 'gravity and height of the camera', 'stature', 'lengths of limbs',
)  # fmt: skip
CASES = (NOTHING, FLOOR, STATURE, LENGTHS)
# Images after the start, 30 a second, and one more to have them all where the detector is late.
LATER, MOST = (0, 10, 30), 45
QUICK = 2


def measured(folder: Path, case: str) -> list[tuple[float, float]] | None:
    """Relative errors, and published deviations, of a clip; None: it does not tell the floor."""
    clip = read_clip(folder, MOST)
    if not clip.truth.ground or not (folder / 'keypoints_mediapipe.npz').is_file():
        return None
    keypoints = read_detections(folder).keypoints
    settings = keypoints_only(TrackerSettings())
    tracker = new_tracker(clip, load_body('human37'), settings, 0, with_subject=False)
    if case in (STATURE, LENGTHS):
        subject = subject_of(clip, tracker.model)
        stature = tracker.model.with_segment_lengths(subject.segment_lengths).stature
        lengths = dict(subject.segment_lengths) if case == LENGTHS else {}
        first = clip.stamps[0]
        known = stature if case == STATURE else None
        tracker.reset(Subject(first, keypoints[first], lengths, known))
    found, count = [], 0
    for stamp, image in zip(clip.stamps, clip.images, strict=True):
        if stamp in clip.views:
            rotation, position = clip.views[stamp]
            tracker.set_camera(position, rotation)
        if case == FLOOR and stamp in clip.truth.ground:
            ground = clip.truth.ground[stamp]
            tracker.set_gravity(ground.up, ground.height)
        posterior, _ = tracker.step(image, stamp, keypoints.get(stamp))
        if posterior is None:
            continue
        if count in LATER:
            found.append(_distance(tracker, clip, stamp))
        count += 1
    return found if len(found) == len(LATER) else None


def _distance(tracker: Tracker, clip: Clip, stamp: int) -> tuple[float, float]:
    """Relative error of the distance, and its published deviation."""
    (mixture,) = joint_mixtures(
        tracker.estimate.body, [tracker.estimate.posterior], HIPS, origin=()
    )
    names = clip.truth.joint_names
    true = float(np.mean([clip.truth.joints[stamp][names.index(name)][2] for name in HIPS]))
    own = float(mixture.joints[0, :, 2].mean())
    covariances = mixture.covariances
    assert covariances is not None
    average = np.zeros(3 * len(HIPS))
    average[2::3] = 1.0 / len(HIPS)
    return own / true - 1.0, float(np.sqrt(average @ covariances[0] @ average)) / own


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Errors by case.

    Raises:
        ValueError: there are no clips, or one can not be read.
    """
    folders = find_clips(clips, moving=True)[0][: QUICK if quick else None]
    result: dict[str, Any] = {'machine': description(), 'cases': []}
    for case in told('distance', CASES):
        found = [one for folder in folders if (one := measured(folder, case)) is not None]
        numbers: NDArray[np.float64] = np.array(found).reshape(-1, len(LATER), 2)
        if not len(numbers):
            raise ValueError('no clip has keypoints and a floor in its truth')
        result['cases'].append(
            {
                'known': case,
                'clips': len(numbers),
                'rms': np.sqrt((numbers[:, :, 0] ** 2).mean(0)).tolist(),
                'mean': numbers[:, :, 0].mean(0).tolist(),
                'said': np.sqrt((numbers[:, :, 1] ** 2).mean(0)).tolist(),
            }
        )
    return result


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """What is printed."""
    rows = [['known', 'clips', *(f'error after {n / 30:.1f} s (mean; said), %' for n in LATER)]]
    for one in result['cases']:
        cells = zip(one['rms'], one['mean'], one['said'], strict=True)
        shown = [f'{100 * a:.1f} ({100 * b:+.1f}; {100 * c:.1f})' for a, b, c in cells]
        rows.append([one['known'], str(one['clips']), *shown])
    return table(rows, markdown=markdown)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('distance', __doc__, quick=f'only {QUICK} clips')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(arguments)
    try:
        result = measure(options.clips, quick=options.quick)
    except ValueError as error:
        print(f'distance: {error}', file=sys.stderr)
        return 1
    return show(result, as_text, as_json=options.json)
