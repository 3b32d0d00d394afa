"""rolled: a camera turned about its optical axis, with given gravity, against an upright one.

Images, keypoints, calibration, truth and gravity of clips are turned by 15, 90 and 180 degrees, as
a camera on its side or upside down would have seen the scene. `lift` uses the keypoints alone,
`track` starts from keypoints and also uses images. The scene does not change, so the errors should
not change either.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import SCHEME, Clip, find_clips, read_clip, read_detections, table
from benchmarks.command import add_choice, benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import GIVEN, GRAVITIES, follow, in_processes, new_tracker, recorded
from benchmarks.tracking_scores import scores_of
from hmt_ros.body import Camera, load_body
from hmt_ros.experts.lifted_fit import lift_poses
from hmt_ros.experts.lifter import load_lifter
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import TrackerSettings

ANGLES = (0, 15, 90, 180)
LIFT, TRACK = 'lift', 'track'
STAGES = (LIFT, TRACK)
CLIPS = ('balance', 'walk', 'wander', 'shoot')
QUICK, IMAGES = 12, 45

Array = NDArray[np.float64]


def turned(camera: Camera, degrees: float) -> tuple[Camera, Array]:
    """A camera turned about its optical axis, and the affine map (2, 3) to its pixels.

    The image is large enough for the whole turned image.
    """
    angle = np.radians(degrees)
    cosine, sine = np.round((np.cos(angle), np.sin(angle)), 12)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    corners = np.array([(x, y) for x in (0, camera.width - 1) for y in (0, camera.height - 1)])
    across = np.array([[camera.fx / camera.fy], [1.0]]) ** np.array([[-0.5], [0.5]])
    shape = across * np.eye(2)
    linear = np.linalg.inv(shape) @ turn @ shape
    ends = corners @ linear.T
    shift = -ends.min(0)
    width, height = (int(x) for x in np.round(np.ptp(ends, axis=0)) + 1)
    centre = linear @ (camera.cx, camera.cy) + shift
    bent = camera.distortion
    if len(bent) > 3 and camera.distortion_model != 'equidistant':
        p2, p1 = turn @ (bent[3], bent[2])
        bent = (*bent[:2], float(p1), float(p2), *bent[4:])
    made = replace(
        camera, cx=float(centre[0]), cy=float(centre[1]), width=width, height=height,
        distortion=bent,
    )  # fmt: skip
    return made, np.column_stack([linear, shift])


def rolled(clip: Clip, degrees: float) -> Clip:
    """A clip as seen by a camera turned about its optical axis."""
    camera, pixels = turned(clip.camera, degrees)
    angle = np.radians(degrees)
    cosine, sine = np.round((np.cos(angle), np.sin(angle)), 12)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    def seen(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        made = cv2.warpAffine(image, pixels, (camera.width, camera.height))
        return np.asarray(made, dtype=np.uint8)

    truth = {stamp: joints @ turn.T for stamp, joints in clip.truth.joints.items()}
    return replace(
        clip,
        camera=camera,
        images=[seen(image) for image in clip.images],
        background=None if clip.background is None else seen(clip.background),
        truth=replace(clip.truth, joints=truth),
        pixels={},
        views={stamp: (r @ turn.T, p) for stamp, (r, p) in clip.views.items()},
        ups={stamp: turn @ up for stamp, up in clip.ups.items()},
    )


def rolled_keypoints(found: Keypoints, camera: Camera, degrees: float) -> Keypoints:
    """Keypoints of a detector mapped to the turned camera, without its 3D positions."""
    _, pixels = turned(camera, degrees)
    return replace(found, pixels=found.pixels @ pixels[:, :2].T + pixels[:, 2], positions=None)


def scored(work: tuple[Path, str, str, float, int]) -> float:
    """Mean error of the heaviest mode, mm, given clip, stage, gravity, angle, number of images."""
    folder, stage, gravity, degrees, images = work
    upright = read_clip(folder, images)
    clip, body = rolled(upright, degrees), load_body('human37')
    found = {
        stamp: rolled_keypoints(one, upright.camera, degrees)
        for stamp, one in read_detections(folder).keypoints.items()
    }
    if stage == TRACK:
        tracker = new_tracker(clip, body, TrackerSettings(), 0, with_subject=False)
        record = follow(clip, tracker, 0, found, gravity=gravity)
        return float(scores_of(record).get('heaviest_mm', np.nan))
    stamps = [s for s in clip.stamps if s in found and found[s].seen.any()]
    ups = np.array([clip.ups[stamp] for stamp in stamps]) if gravity == GIVEN else None
    mixtures = lift_poses(
        load_lifter(), body, clip.camera, 1e-9 * np.array(stamps, dtype=np.float64),
        [found[stamp] for stamp in stamps], ups, scheme=SCHEME,
    )  # fmt: skip
    rows = [
        (stamp, one) for stamp, one in zip(stamps, mixtures, strict=True)
        if one is not None and stamp in clip.truth.joints
    ]  # fmt: skip
    record = recorded(
        clip, [body] * len(rows), [one for _, one in rows], [one.means[0] for _, one in rows],
        [stamp for stamp, _ in rows], 0,
    )  # fmt: skip
    return float(scores_of(record)['heaviest_mm'])


def measure(
    clips: Path | None = None,
    names: tuple[str, ...] = CLIPS,
    stages: tuple[str, ...] = STAGES,
    gravities: tuple[str, ...] = (GIVEN,),
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Errors by clip, stage and gravity, at each of `ANGLES`.

    Args:
        clips: folder of the clips; None means the development clips.
        names: names of the clips; missing ones are left out.
        stages: some of `STAGES`.
        gravities: some of `GRAVITIES`.
        quick: a few images of the first clip, lifted.

    Raises:
        FileNotFoundError: none of the clips has keypoints.
    """
    folders, source = find_clips(clips, moving=True)
    folders = [
        x for x in folders if x.name in names and (x / 'keypoints_mediapipe.npz').is_file()
    ][: 1 if quick else None]  # fmt: skip
    if not folders:
        raise FileNotFoundError(
            f'{source} has no keypoints_mediapipe.npz of {", ".join(names)} (set HMT_SHARED, or '
            '--clips)'
        )
    kinds = list(product(stages[:1] if quick else stages, gravities, folders))
    images = QUICK if quick else IMAGES
    work = [(x, stage, gravity, a, images) for stage, gravity, x in kinds for a in ANGLES]
    found = dict(zip(work, in_processes(scored, work, 1 if quick else 0, 'rolled'), strict=True))
    rows = [
        {
            'stage': stage, 'gravity': gravity, 'clip': x.name,
            'mm': {str(a): found[x, stage, gravity, a, images] for a in ANGLES},
        }
        for stage, gravity, x in kinds
    ]  # fmt: skip
    return {'machine': description(), 'source': source, 'rows': rows}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Table of the errors, mm, and of the increase at the worst angle, %."""
    rows = [['mm', 'clip', *(f'{a} degrees' for a in ANGLES), 'at worst, %']]
    for one in result['rows']:
        upright, *others = (one['mm'][str(a)] for a in ANGLES)
        cost = 100.0 * (max(others) / upright - 1.0)
        cells = [f'{one["mm"][str(a)]:.1f}' for a in ANGLES]
        kind = one['stage'] if one['gravity'] == GIVEN else f'{one["stage"]}, {one["gravity"]}'
        rows.append([kind, one['clip'], *cells, f'{cost:+.0f}'])
    return table(rows, left=2, markdown=markdown)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('rolled', __doc__, quick=f'{QUICK} images of one clip, lifted')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--names', nargs='+', default=CLIPS, help='of the clips')
    parser.add_argument('--gravity', nargs='+', choices=GRAVITIES, default=(GIVEN,))
    add_choice(parser, STAGES)
    options = parser.parse_args(arguments)
    return run_benchmark(
        'rolled',
        lambda: measure(
            options.clips,
            tuple(options.names),
            tuple(options.only),
            tuple(options.gravity),
            quick=options.quick,
        ),
        as_text,
        as_json=options.json,
    )
