"""real_video: scores of real videos without truth, and contact sheets of all clips.

scores     `park_walk` and `leaflet`, images and keypoints, at the camera's rate:
           held out    root mean square distance of joints of the heaviest mode from keypoints that
                       the tracker was not given: those of every third landmark, which changes from
                       image to image, as a share of the height of the keypoints;
           given       the same of those that it was given;
           feet        median speed of an ankle while the tracker says that the foot stands, m/s;
           lengths     standard deviation over time of the sum of all lengths, relative;
           empty       images without anybody that have a track. See also `absence`.
sheets     a picture of each clip, with --sheets DIR: images with the modes, and the same from the
           side and from above, with the truth where there is one.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.absence import SCENES, Scene
from benchmarks.clips import (
    ROOT,
    development_folder,
    find_clips,
    read_clip,
    read_detections,
    read_messages,
    table,
    with_file,
)
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import description
from benchmarks.runs import new_tracker
from hmt_ros.app.report.skeletons import bones_of
from hmt_ros.body import Camera, load_body
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import Status, Tracker, TrackerSettings
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

Array = NDArray[np.float64]
HELD_OUT = 3  # one landmark in so many
STANDS = 0.8  # probability of contact above which a foot stands
COLUMNS = 8
CELL, REACH = 260, 1.15  # px of a cell of a sheet, and m from its middle to its border
TRUE, OTHERS = (40, 160, 40), (190, 190, 190)


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Scores of the real videos.

    Raises:
        FileNotFoundError: they are not there.
    """
    names = [scene.name for scene in SCENES]
    folders = with_file(names, clips, 'keypoints_mediapipe.npz')
    pairs = told('real_video', zip(folders, SCENES, strict=True), lambda pair: pair[0].name)
    found = [scores_of(folder, scene, 30 if quick else None) for folder, scene in pairs]
    return {'machine': description(), 'clips': found}


@dataclass(frozen=True, eq=False)
class Seen:
    """An image of a video and what the tracker made of it.

    Attributes:
        image: (H, W, 3).
        index: of the image in the video.
        stamp: ns.
        keypoints: of the detector; None: it has not answered.
        tracker: after the image.
        tracked: whether there is a track.
    """

    image: NDArray[np.uint8]
    index: int
    stamp: int
    keypoints: Keypoints | None
    tracker: Tracker
    tracked: bool


def followed(folder: Path, limit: int | None = None, *, held_out: int = 0) -> Iterator[Seen]:
    """A real video through the tracker, images and keypoints.

    Args:
        folder: of the video.
        limit: number of images; None: all.
        held_out: one landmark in so many is not given, another in each image; 0: all are given.
    """
    info, messages = read_messages(folder, frames=limit)
    keypoints = read_detections(folder).keypoints
    tracker: Tracker | None = None
    for i, message in enumerate(messages):
        image, stamp = decode_image(message), time_ns(message.header.stamp)
        if tracker is None:
            camera = camera_from_info(info, (image.shape[1], image.shape[0]))
            tracker = Tracker(load_body('human37'), camera, TrackerSettings())
        every = keypoints.get(stamp)
        given = every
        if every is not None and held_out:
            given = every[np.flatnonzero((np.arange(len(every.names)) + i) % held_out != 0)]
        posterior, _ = tracker.step(image, stamp, given)
        yield Seen(image, i, stamp, every, tracker, posterior is not None)


def scores_of(folder: Path, scene: Scene, limit: int | None = None) -> dict[str, Any]:
    """Scores of a real video."""
    misses: dict[bool, list[float]] = {True: [], False: []}
    sizes: list[float] = []
    empty = [0, 0]
    speeds: list[float] = []
    before: tuple[int, dict[str, Array]] | None = None
    for one in followed(folder, limit, held_out=HELD_OUT):
        if any(start <= one.index < end for start, end in scene.empty):
            empty[0] += one.tracked
            empty[1] += 1
        if not one.tracked or one.tracker.estimate.status is not Status.TRACKING:
            before = None
            continue
        body, pose = one.tracker.estimate.body, one.tracker.estimate.modes.poses[:1]
        joints = dict(zip(body.joint_names, body.joint_positions(pose)[0], strict=True))
        sizes.append(float(sum(body.segment_lengths.values())))
        if any(start <= one.index < end for start, end in scene.whole):
            for held, error in _misses(one, joints):
                misses[held].append(error)
        feet = {f'{side}_foot': joints[f'{side}_ankle'] for side in ('left', 'right')}
        if before is not None:
            dt = 1e-9 * (one.stamp - before[0])
            speeds += [
                float(np.linalg.norm(feet[foot] - before[1][foot])) / dt
                for foot, probability in one.tracker.estimate.contacts.items()
                if probability > STANDS
            ]
        before = one.stamp, feet
    return {
        'clip': folder.name,
        'images': len(sizes),
        'held_out': _rms(misses[True]),
        'given': _rms(misses[False]),
        'feet': float(np.median(speeds)) if speeds else np.nan,
        'standing': len(speeds),
        'lengths': float(np.std(sizes) / np.mean(sizes)) if sizes else np.nan,
        'empty': empty,
    }


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else np.nan


def _misses(one: Seen, joints: dict[str, Array]) -> Iterator[tuple[bool, float]]:
    """Whether a keypoint was held out, and its distance from the joint, over the height."""
    if one.keypoints is None or not one.keypoints.seen.any():
        return
    seen = one.keypoints.seen
    height = float(np.ptp(one.keypoints.pixels[seen][:, 1]))
    for k in np.flatnonzero(seen):
        name = one.keypoints.names[k]
        if name in joints and height > 0:
            pixel = one.tracker.camera.project(joints[name][None])[0]
            error = float(np.linalg.norm(pixel - one.keypoints.pixels[k]))
            yield (int(k) + one.index) % HELD_OUT == 0, error / height


def draw_sheets(out: Path, clips: Path | None = None, *, quick: bool = False) -> list[Path]:
    """Contact sheets of all clips, the real videos and the demonstration, PNG files."""
    out.mkdir(parents=True, exist_ok=True)
    folder = clips or development_folder()
    known = find_clips(clips, moving=True)[0] if folder.is_dir() else []
    if folder.is_dir() and ROOT / 'bags' / 'reach' not in known:
        known = [*known, ROOT / 'bags' / 'reach']
    real = [folder / scene.name for scene in SCENES if (folder / scene.name).is_dir()]
    written = []
    for path in told('real_video', [*known, *real][: 2 if quick else None], lambda x: x.name):
        cells = list(_cells_of_real(path) if path in real else _cells_of_clip(path))
        if cells:
            written.append(out / f'{path.name}.png')
            cv2.imwrite(str(written[-1]), np.hstack(cells))
    return written


def _cells_of_clip(folder: Path) -> Iterator[NDArray[np.uint8]]:
    clip = read_clip(folder)
    detected = (folder / 'keypoints_mediapipe.npz').is_file()
    keypoints = read_detections(folder).keypoints if detected else {}
    tracker = new_tracker(clip, load_body('human37'), TrackerSettings(), 0)
    shown = set(_spread(len(clip.images)))
    for i, (stamp, image) in enumerate(zip(clip.stamps, clip.images, strict=True)):
        if stamp in clip.views:
            rotation, position = clip.views[stamp]
            tracker.set_camera(position, rotation)
        posterior, _ = tracker.step(image, stamp, keypoints.get(stamp))
        if i in shown and posterior is not None:
            true = clip.truth.joints.get(stamp)
            yield _cell(image, tracker, clip.camera, clip.truth.joint_names, true)


def _cells_of_real(folder: Path) -> Iterator[NDArray[np.uint8]]:
    scene = next(scene for scene in SCENES if scene.name == folder.name)
    first, last = scene.whole[0]
    shown = {first + i for i in _spread(last - first)}
    for one in followed(folder, last):
        if one.index in shown and one.tracked:
            yield _cell(one.image, one.tracker, one.tracker.camera, (), None)


def _spread(count: int) -> list[int]:
    return [int((i + 0.5) / COLUMNS * count) for i in range(COLUMNS)]


def _cell(
    image: NDArray[np.uint8], tracker: Tracker, camera: Camera, names: tuple[str, ...],
    true: Array | None,
) -> NDArray[np.uint8]:  # fmt: skip
    """A column of a sheet: the image, the side view and the view from above."""
    body, modes = tracker.estimate.body, tracker.estimate.modes
    weights = np.exp(modes.log_weights - modes.log_weights.max())
    drawn: list[tuple[Array, tuple[str, ...], Any, int]] = [
        (joints, body.joint_names, OTHERS, 1)
        for joints, weight in zip(body.joint_positions(modes.poses), weights, strict=True)
        if weight < 1.0
    ]
    heaviest = body.joint_positions(modes.poses[:1])[0]
    if true is not None:
        drawn.append((true, names, TRUE, 2))
    drawn.append((heaviest, body.joint_names, None, 2))
    picture = image.copy()
    for joints, own, colour, width in drawn:
        good = np.nan_to_num(joints, nan=1.0)
        _draw(picture, camera.project(good), own, np.isfinite(joints).all(1), colour, width)
    pixels = camera.project(heaviest)
    middle = 0.5 * (pixels.min(0) + pixels.max(0))
    half = 0.65 * float(np.ptp(pixels, axis=0).max()) + 10.0
    matrix = np.array([[1.0, 0.0, half - middle[0]], [0.0, 1.0, half - middle[1]]])
    matrix *= CELL / (2.0 * half)
    cells = [cv2.warpAffine(picture, matrix, (CELL, CELL), flags=cv2.INTER_AREA)]
    up = tracker.estimate.ground.up
    away = np.array([0.0, 0.0, 1.0]) - up[2] * up
    away = away / np.linalg.norm(away)
    right = np.cross(up, away)
    centre = heaviest.mean(0)
    for across, above in ((away, up), (right, away)):
        view = np.full((CELL, CELL, 3), 255, np.uint8)
        for joints, own, colour, width in drawn:
            flat = np.stack([(joints - centre) @ across, -(joints - centre) @ above], axis=1)
            places = CELL * (0.5 + 0.5 * flat / REACH)
            finite = np.isfinite(places).all(1)
            _draw(view, np.nan_to_num(places), own, finite, colour, width)
        cells.append(view)
    return np.vstack(cells)


def _draw(
    picture: NDArray[np.uint8], pixels: Array, names: tuple[str, ...], known: NDArray[np.bool_],
    colour: Any, width: int,
) -> None:  # fmt: skip
    for a, b, own in bones_of(names):
        if known[a] and known[b] and np.abs(pixels[[a, b]]).max() < 1e4:
            bgr = colour or tuple(int(own[i : i + 2], 16) for i in (5, 3, 1))
            ends = [tuple(map(int, pixels[x])) for x in (a, b)]
            cv2.line(picture, ends[0], ends[1], bgr, width, cv2.LINE_AA)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """What is printed."""
    rows = [
        ['clip', 'images tracked', 'held out, % of the height', 'given, %',
         'standing feet, m/s', 'lengths, %', 'empty images with a track'],
    ]  # fmt: skip
    rows += [
        [
            one['clip'],
            str(one['images']),
            f'{100 * one["held_out"]:.1f}',
            f'{100 * one["given"]:.1f}',
            f'{one["feet"]:.2f} ({one["standing"]} steps)',
            f'{100 * one["lengths"]:.1f}',
            '{} of {}'.format(*one['empty']),
        ]
        for one in result['clips']
    ]
    return table(rows, markdown=markdown)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('real_video', __doc__, quick='30 images, two sheets')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--sheets', type=Path, metavar='DIR', help='draw sheets, no scores')
    options = parser.parse_args(arguments)
    try:
        if options.sheets is not None:
            for path in draw_sheets(options.sheets, options.clips, quick=options.quick):
                print(path)
            return 0
        result = measure(options.clips, quick=options.quick)
    except FileNotFoundError as error:
        print(f'real_video: skipped, {error}', file=sys.stderr)
        return 0
    except ValueError as error:
        print(f'real_video: {error}', file=sys.stderr)
        return 1
    return show(result, as_text, as_json=options.json)
