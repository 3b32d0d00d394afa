"""Duration of a step of the tracker, in total and by stage."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.clips import Clip, at_rate, read_clip, table
from benchmarks.machine import forget_peak, peak_memory
from benchmarks.runs import IMAGES, INPUTS, begun

OPENCV = 'MOG2 + Canny + distance transform'
# Lower rate in images per second, and number of images that start a track.
LOW_RATE, STARTING = 3.0, 2
# Clips whose steps are measured, if available.
PRICED = ('walk', 'kick', 'dab', 'turns', 'window')


def speed(clip: Clip) -> dict[str, Any]:
    """Times of a step, of its stages, and of OpenCV's work on the same images, alternating.

    The camera of the clip must be fixed.
    """
    # Imported here, so that the other parts need no inner modules of the tracker.
    from benchmarks.stages import StageClock

    assert clip.background is not None
    forget_peak()
    tracker = begun(clip, IMAGES)[0]
    subtractor = cv2.createBackgroundSubtractorMOG2()
    for _ in range(10):
        subtractor.apply(clip.background)
    # A warm-up loads everything before anything is timed.
    for stamp, image in islice(zip(clip.stamps, clip.images, strict=True), 3):
        tracker.step(image, stamp)
    tracker = begun(clip, IMAGES)[0]
    clock = StageClock()
    steps, reference = [], []
    with clock.running():
        for i, (stamp, image) in enumerate(zip(clip.stamps, clip.images, strict=True)):
            clock.begin_step()
            start = time.perf_counter()
            tracker.step(image, stamp)
            middle = time.perf_counter()
            opencv_work(subtractor, image)
            reference.append(time.perf_counter() - middle)
            steps.append(middle - start)
            if i == 0:  # the start of a track is reported separately
                begin = clock.seconds.copy()
                clock.seconds.clear()
    count = len(steps) - 1
    mean = float(np.mean(steps[1:]))
    stages = {name: 1e3 * spent / count for name, spent in clock.seconds.items()}
    stages['other'] = 1e3 * mean - sum(stages.values())
    height, width = clip.images[0].shape[:2]
    return {
        'clip': clip.name,
        'size': f'{width}x{height}',
        'images': count,
        'steps_per_second': 1.0 / mean,
        'step_ms': 1e3 * mean,
        'start_ms': 1e3 * sum(begin.values()),
        'opencv_ms': 1e3 * float(np.mean(reference[1:])),
        'ratio': mean / float(np.mean(reference[1:])),
        'stages_ms': dict(sorted(stages.items(), key=lambda item: -item[1])),
        'peak_memory_mb': peak_memory() / 1e6,
    }


def costs(folder: Path, limit: int | None = None) -> list[dict[str, Any]]:
    """Processor time of a step relative to OpenCV's work on the same image in the same run.

    There is one row per input and rate: all images, and 3 per second.

    Args:
        folder: folder of a clip with a background.
        limit: maximum number of images; None means all.

    Raises:
        ValueError: the clip can not be read.
    """
    whole, detected = read_clip(folder, limit), (folder / 'keypoints_mediapipe.npz').is_file()
    rows = []
    for inputs in INPUTS if detected else (IMAGES,):
        for rate in (0.0, LOW_RATE):
            clip, subtractor = at_rate(whole, rate), cv2.createBackgroundSubtractorMOG2()
            tracker, known = begun(clip, inputs)
            spent, floor, evaluations = [], [], []
            for stamp, image in zip(clip.stamps, clip.images, strict=True):
                start = time.process_time()
                tracker.step(image, stamp, known.get(stamp))
                middle = time.process_time()
                opencv_work(subtractor, image)
                floor.append(time.process_time() - middle)
                spent.append(middle - start)
                evaluations.append(tracker.estimate.evaluations)
            if len(spent) <= STARTING:
                continue
            # The first images start the track and load everything, so they are not counted.
            steps, one = np.array(spent[STARTING:]), float(np.mean(floor[STARTING:]))
            rows.append(
                {
                    'clip': clip.name,
                    'inputs': inputs,
                    'rate': rate,
                    'images': len(steps),
                    'evaluations': float(np.mean(evaluations[STARTING:])),
                    'cpu_ms': 1e3 * float(steps.mean()),
                    'floor_ms': 1e3 * one,
                    'mean': float(steps.mean()) / one,
                    'median': float(np.median(steps)) / one,
                    'most': float(np.percentile(steps, 99)) / one,
                }
            )
    return rows


def costs_as_text(rows: Sequence[dict[str, Any]], *, markdown: bool = False) -> str:
    """A table, with means over the clips for each input and rate."""
    head = ['clip', 'inputs', 'rate', 'evaluations', 'CPU, ms', 'floors', 'median', '99 %']
    names = ('evaluations', 'cpu_ms', 'mean', 'median', 'most')
    lines = []
    for key in dict.fromkeys((row['inputs'], row['rate']) for row in rows):
        mine = [row for row in rows if (row['inputs'], row['rate']) == key]
        mean = {name: float(np.mean([row[name] for row in mine])) for name in names}
        for row in (*mine, {**mean, 'clip': 'mean', 'inputs': key[0], 'rate': key[1]}):
            rate = f'{row["rate"]:g}' if row['rate'] else 'all'
            numbers = [f'{row[name]:.{0 if name in names[:2] else 1}f}' for name in names]
            lines.append([row['clip'], row['inputs'], rate, *numbers])
    return table([head, *lines], left=2, markdown=markdown)


def opencv_work(subtractor: Any, image: Any) -> Any:
    """OpenCV's work for a silhouette, edges and a distance transform."""
    mask = subtractor.apply(image)
    edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 40, 100)
    return mask, cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5)


def speed_as_text(found: dict[str, Any], cores: int, *, markdown: bool = False) -> str:
    """A line and a table of the stages."""
    line = (
        f'{found["clip"]} {found["size"]}, {found["images"]} images, {cores} cores: '
        f'{found["steps_per_second"]:.1f} steps/s; a step {found["step_ms"]:.1f} ms, {OPENCV} '
        f'{found["opencv_ms"]:.1f} ms, ratio {found["ratio"]:.1f}; start of the track '
        f'{found["start_ms"]:.0f} ms; peak memory {found["peak_memory_mb"]:.0f} MB'
    )
    rows = [['stage', 'ms']]
    rows += [[name, f'{value:.1f}'] for name, value in found['stages_ms'].items()]
    return f'{line}\n\n{table(rows, markdown=markdown)}'
