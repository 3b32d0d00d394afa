"""real: clips of real people, in a separate table before those of rendered ones.

desk_1, desk_3       a man at a desk, visible from the waist up, by `track-video` with MediaPipe's
                     keypoints; six joints, aligned at the middle of the shoulders, and the
                     published deviation of the ankles, which no image shows
balance              a man on a beam, images and keypoints; joints aligned at the middle of the hips
park_walk, leaflet   an empty scene that is then visited, images and keypoints; without truth

The truth is triangulated from other cameras and has errors of 8 to 20 mm. The heaviest mode is
compared with MediaPipe's own 3D.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import (
    development_folder,
    read_clip,
    read_detections,
    read_messages,
    table,
    with_file,
)  # fmt: skip
from benchmarks.command import add_choice, benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.runs import BOTH, Run, run
from benchmarks.tracking_scores import scores_of
from hmt_ros.app import track_video
from hmt_ros.body import load_body
from hmt_ros.tracking import Status, Tracker
from msg_tools import BagReader
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

Array = NDArray[np.float64]

DESKS, BEAM, VISITS = ('desk_1', 'desk_3'), 'balance', ('park_walk', 'leaflet')
CLIPS = (*DESKS, BEAM, *VISITS)
SIX = tuple(f'{side}_{x}' for x in ('shoulder', 'elbow', 'wrist') for side in ('left', 'right'))
ANKLES = ('left_ankle', 'right_ankle')
NEAR_NS = 20_000_000  # maximum difference between timestamps of a truth and its image


def of_desk(folder: Path, end: float | None = None) -> dict[str, Any]:
    """Errors of six joints, mm, and the deviation of the ankles, cm, until the time `end`, s."""
    options = [] if end is None else ['--end', str(end)]
    with tempfile.TemporaryDirectory() as made:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            code = track_video.main(
                [
                    str(folder / f'{folder.name}.mp4'), '--camera', str(folder / 'camera.yaml'),
                    '--keypoints', str(folder / 'keypoints_mediapipe.npz'), '--fps', '6', '--quiet',
                    '-o', made + '/out', *options,
                ]
            )  # fmt: skip
        if code:
            raise ValueError(f'{folder}: track-video ended with {code}')
        with BagReader(Path(made) / 'out' / 'tracked') as bag:
            (topic,) = (x for x in bag.topics if x.endswith('/pose_mixture') or x == 'pose_mixture')
            mixtures = {time_ns(x.message.header.stamp): x.message for x in bag.messages([topic])}
    truth = np.load(folder / 'truth.npz')
    detections = read_detections(folder)
    names = list(truth['joint_names'])
    ours, theirs, spread = [], [], []
    for stamp, joints in zip(truth['stamps'], truth['joints'], strict=True):
        known = [x for x in SIX if np.isfinite(joints[names.index(x)]).all()]
        near = min(mixtures, key=lambda x: abs(x - int(stamp)))
        if abs(near - int(stamp)) > NEAR_NS or not {*SIX[:2]} <= {*known}:
            continue
        mixture = mixtures[near]
        true = {x: joints[names.index(x)] for x in known}
        if not len(mixture.components):
            continue
        ours.append(_from_shoulders(_places(mixture.components[0], mixture), true))
        own = detections.joints.get(int(stamp))
        if own is not None:
            theirs.append(_from_shoulders(dict(zip(detections.names, own, strict=True)), true))
        spread.append(_deviation(mixture))
    return {
        'images': len(truth['stamps']), 'answered': len(ours), 'error_mm': 1e3 * np.mean(ours),
        'detector_mm': 1e3 * np.mean(theirs), 'ankles_cm': 1e2 * np.mean(spread),
    }  # fmt: skip


def _places(component: Any, mixture: Any) -> dict[str, Array]:
    points = zip(mixture.joint_names, component.joint_positions, strict=True)
    return {name: np.array([p.x, p.y, p.z]) for name, p in points}


def _from_shoulders(said: dict[str, Array], true: dict[str, Array]) -> float:
    """Mean distance of joints, m, after alignment at the middle of the shoulders."""
    middles = [0.5 * (x['left_shoulder'] + x['right_shoulder']) for x in (said, true)]
    off = [said[x] - middles[0] - true[x] + middles[1] for x in true]
    return float(np.linalg.norm(off, axis=1).mean())


def _deviation(mixture: Any) -> float:
    """Root of the trace of an ankle's covariance over all components, m, mean of both ankles."""
    weights = np.array([x.weight for x in mixture.components])
    result = []
    for ankle in ANKLES:
        at = list(mixture.joint_names).index(ankle)
        places = np.array([_places(x, mixture)[ankle] for x in mixture.components])
        own = [
            np.trace(np.reshape(x.joint_covariances, (-1, 3, 3))[at]) for x in mixture.components
        ]
        apart = np.square(places - weights @ places).sum(1)
        result.append(np.sqrt(weights @ (np.array(own) + apart)))
    return float(np.mean(result))


def of_beam(folder: Path, limit: int | None = None) -> dict[str, Any]:
    """Errors of the heaviest mode from images and keypoints, and of the detector, mm."""
    record = run(Run(folder, BOTH, 0, limit=limit))
    clip, detections = read_clip(folder, limit), read_detections(folder)
    names = [x for x in clip.truth.joint_names if x in detections.names]
    hips = ('left_hip', 'right_hip')
    errors = []
    for stamp, own in detections.joints.items():
        if stamp in clip.truth.joints:
            said = dict(zip(detections.names, own, strict=True))
            true = dict(zip(clip.truth.joint_names, clip.truth.joints[stamp], strict=True))
            middles = [0.5 * (x[hips[0]] + x[hips[1]]) for x in (said, true)]
            off = [said[x] - middles[0] - true[x] + middles[1] for x in names]
            errors.append(np.linalg.norm(off, axis=1).mean())
    scores = scores_of(record)
    return {
        'images': len(clip.stamps), 'answered': len(record.stamps),
        'error_mm': float(scores['hips_mm']), 'detector_mm': 1e3 * float(np.mean(errors)),
    }  # fmt: skip


def of_visit(folder: Path, limit: int | None = None) -> dict[str, Any]:
    """Numbers of images in which MediaPipe sees a person, and of these tracked or called empty."""
    info, messages = read_messages(folder, frames=limit)
    detections = read_detections(folder)
    images = [decode_image(message) for message in messages]
    height, width = images[0].shape[:2]
    tracker = Tracker(load_body('human37'), camera_from_info(info, (width, height)))
    seen = tracked = nobody = 0
    for message, image in zip(messages, images, strict=True):
        stamp = time_ns(message.header.stamp)
        keypoints = detections.keypoints.get(stamp)
        tracker.step(image, stamp, keypoints)
        if keypoints is not None and keypoints.seen.any():
            seen += 1
            tracked += tracker.estimate.status is Status.TRACKING
            nobody += tracker.estimate.status is Status.NOBODY
    return {'images': len(images), 'seen': seen, 'answered': tracked, 'nobody': nobody}


def measure(only: tuple[str, ...] = CLIPS, *, quick: bool = False) -> dict[str, Any]:
    """The table.

    Raises:
        FileNotFoundError: the development data are missing.
        ValueError: a clip can not be read.
    """
    with_file(only, None, 'keypoints_mediapipe.npz')
    rows = []
    for name in told('real', only[:1] if quick else only):
        folder, limit = development_folder() / name, 6 if quick else None
        if name in DESKS:
            row = of_desk(folder, 1.0 if quick else None)
        else:
            row = (of_beam if name == BEAM else of_visit)(folder, limit)
        rows.append({'clip': name, **row})
    return {'machine': description(), 'rows': rows}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [['clip', 'tracked', 'said empty', 'error, mm', 'MediaPipe, mm', 'ankles +-, cm']]
    for one in result['rows']:
        of = one.get('seen', one['images'])
        numbers = [f'{one[x]:.0f}' if x in one else '-' for x in ('error_mm', 'detector_mm')]
        ankles = f'{one["ankles_cm"]:.0f}' if 'ankles_cm' in one else '-'
        nobody = str(one.get('nobody', '-'))
        rows.append([one['clip'], f'{one["answered"]} of {of}', nobody, *numbers, ankles])
    return table(rows, markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('real_clips', __doc__, quick='a second of one clip')
    add_choice(parser, CLIPS, 'CLIP')
    options = parser.parse_args(argv)
    return run_benchmark(
        'real_clips',
        lambda: measure(tuple(options.only), quick=options.quick),
        as_text,
        as_json=options.json,
    )
