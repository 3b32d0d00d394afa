"""detectors: image errors of each installed detector, and errors of the resulting poses.

The detectors of `hmt_ros.detectors` process the images of clips; real clips come first. Errors in
the image are those of shoulders, elbows, wrists, hips, knees and ankles in the truth; `varying` is
without the mean error of each joint, which is partly due to the definition of a joint. Errors of
poses, from images and keypoints with gravity if known, are those of `tracking --parts oracles`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import SCHEME, Clip, table, with_file
from benchmarks.command import add_choice, benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.runs import BOTH, GIVEN
from benchmarks.tracking_oracles import (
    GROUPS,
    PLAIN,
    QUICK,
    Given,
    OracleRun,
    given_of,
    scores_with,
)
from hmt_ros.body.skeleton import other_side
from hmt_ros.detectors.registry import DETECTORS
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.image.terms.keypoints import Keypoints

Array = NDArray[np.float64]

CLIPS = tuple(name for group in GROUPS.values() for name in group)
# Joints of limbs, which all detectors have as landmarks.
JOINTS = tuple(name for name in EVALUATED_JOINTS if other_side(name) != name)


def seen_by(detector: str, given: Given) -> tuple[dict[int, Keypoints], float]:
    """Keypoints of a detector in a clip, by timestamp, and processor time per image, ms.

    Raises:
        DetectorError: the detector is not installed.
    """
    made, found, start = DETECTORS[detector].make(), {}, time.process_time()
    for stamp, image in zip(given.clip.stamps, given.clip.images, strict=True):
        keypoints = made.detect(image, stamp)
        if keypoints is not None:
            found[stamp] = keypoints
    spent = 1e3 * (time.process_time() - start) / len(given.clip.stamps)
    return found, spent


def image_errors(clip: Clip, found: dict[int, Keypoints]) -> tuple[float, float]:
    """Mean distance from the true joints in the image, px, with and without mean errors."""
    truth = clip.truth
    names = [name for name in JOINTS if name in truth.joint_names]
    rows = [truth.joint_names.index(name) for name in names]
    errors = np.array([
        keypoints.pixels[[keypoints.names.index(name) for name in names]] - clip.pixels[stamp][rows]
        for stamp, keypoints in found.items()
        if stamp in clip.pixels
    ])  # fmt: skip
    varying = errors - np.nanmean(errors, axis=0)
    mean, rest = (float(np.nanmean(np.linalg.norm(x, axis=2))) for x in (errors, varying))
    return mean, rest


def of_clip(folder: Path, detector: str, seed: int, limit: int | None) -> dict[str, Any]:
    """Errors of one detector in one clip, and of the poses from images and its keypoints."""
    given = given_of(folder, limit)
    found, spent = seen_by(detector, given)
    mean, varying = image_errors(given.clip, found)
    known = {stamp: x.named_for(given.body, SCHEME)[0] for stamp, x in found.items()}
    run = OracleRun(folder, BOTH, seed, limit=limit, gravity=GIVEN, oracle=PLAIN)
    scores = scores_with(replace(given, keypoints=known), run)[PLAIN]
    return {
        'clip': folder.name, 'detector': detector, 'ms': spent, 'px': mean, 'varying_px': varying,
        'found': [len(found), len(given.clip.stamps)],
        'heaviest_mm': scores['heaviest'], 'best_mm': scores['best'],
    }  # fmt: skip


def measure(only: Sequence[str] = CLIPS, *, seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """Errors by clip and detector.

    Raises:
        FileNotFoundError: the clips are missing.
        ValueError: no detector is installed, or a clip can not be read.
    """
    installed = [name for name, kind in DETECTORS.items() if kind.is_installed()]
    if not installed:
        raise ValueError('no detector is installed: run "python -m hmt_ros install-detector"')
    folders = with_file(only[:1] if quick else only, None, 'truth.npz')
    jobs = [(folder, detector) for folder in folders for detector in installed]
    limit = QUICK if quick else None
    rows = [
        of_clip(folder, detector, seed, limit)
        for folder, detector in told('detectors', jobs, lambda job: f'{job[0].name}, {job[1]}')
    ]
    return {'machine': description(), 'seed': seed, 'rows': rows}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables of means and of clips, real clips first."""
    rows = result['rows']
    detectors = list(dict.fromkeys(row['detector'] for row in rows))
    shown = {'px': '.1f', 'varying_px': '.1f', 'heaviest_mm': '.0f', 'best_mm': '.0f', 'ms': '.0f'}
    heads = ('px', 'varying, px', 'heaviest, mm', 'best, mm', 'CPU, ms an image')

    def cells(own: list[dict[str, Any]]) -> list[str]:
        return [
            format(float(np.mean([x[name] for x in own])), form) for name, form in shown.items()
        ]

    means, clips = ([[first, 'detector', *heads]] for first in ('means', 'clip'))
    for group, names in GROUPS.items():
        for detector in detectors:
            own = [x for x in rows if x['clip'] in names and x['detector'] == detector]
            if own:
                means.append([group, detector, *cells(own)])
            clips += [[x['clip'], detector, *cells([x])] for x in own]
    return '\n\n'.join(table(x, left=2, markdown=markdown) for x in (means, clips))


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('detectors', __doc__, quick='a few images of one clip')
    add_choice(parser, CLIPS, 'CLIP')
    parser.add_argument('--seed', type=int, default=0, help='of the tracker')
    options = parser.parse_args(argv)
    return run_benchmark(
        'detectors',
        lambda: measure(tuple(options.only), seed=options.seed, quick=options.quick),
        as_text,
        as_json=options.json,
    )
