"""real_video: scores of real videos without truth.

`park_walk` and `leaflet`, images and keypoints, at the camera's rate:

held out    root mean square distance of the heaviest mode's joints from held-out keypoints (every
            third landmark, others in each image), relative to the height of all keypoints;
given       the same for the keypoints given to the tracker;
feet        median speed of an ankle while the tracker reports that the foot stands, m/s;
lengths     standard deviation over time of the sum of all lengths, relative;
empty       number of images without a person that have a track. See also `absence`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.absence import SCENES, Scene
from benchmarks.clips import read_detections, read_messages, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from hmt_ros.body import load_body
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import Status, Tracker, TrackerSettings
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

Array = NDArray[np.float64]
HELD_OUT = 3  # one of this many landmarks is held out
STANDS = 0.8  # minimum probability of contact of a standing foot
QUICK = 30


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Scores of the real videos.

    Raises:
        FileNotFoundError: the videos are missing.
    """
    scenes = SCENES[:1] if quick else SCENES
    names = [scene.name for scene in scenes]
    folders = with_file(names, clips, 'keypoints_mediapipe.npz')
    pairs = told('real_video', zip(folders, scenes, strict=True), lambda pair: pair[0].name)
    found = [scores_of(folder, scene, QUICK if quick else None) for folder, scene in pairs]
    return {'machine': description(), 'clips': found}


@dataclass(frozen=True, eq=False)
class Seen:
    """An image of a video and the tracker after it.

    Attributes:
        image: (H, W, 3) image, BGR.
        index: index of the image in the video.
        stamp: timestamp, ns.
        keypoints: keypoints of the detector; None if it gave no answer.
        tracker: tracker after the image.
        tracked: whether there is a track.
    """

    image: NDArray[np.uint8]
    index: int
    stamp: int
    keypoints: Keypoints | None
    tracker: Tracker
    tracked: bool


def followed(folder: Path, limit: int | None = None, *, held_out: int = 0) -> Iterator[Seen]:
    """Tracks a real video with images and keypoints.

    Args:
        folder: folder of the video.
        limit: maximum number of images; None means all.
        held_out: one of this many landmarks is held out, others in each image; 0 holds out none.
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
    """Whether a keypoint was held out, and its distance from the joint relative to the height."""
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


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
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
    parser = benchmark_parser('real_video', __doc__, quick=f'{QUICK} images of one video')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(arguments)
    return run_benchmark(
        'real_video',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
