"""vertical: accuracy and cost of the vertical estimated from the lines of a scene.

It uses all clips whose truth contains gravity, with one image per second. The cost of an estimate
is compared with background subtraction, edges and distance transform of one image, the minimum of a
step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.clips import at_rate, find_clips, read_clip, table
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.tracking_speed import opencv_work
from hmt_ros.image.vertical_lines import seen_vertical, straight_lines

RATE = 1.0  # images per second
REPEATS = 3


def measured(folder: Path) -> dict[str, Any] | None:
    """Errors of a clip, deg, and times, ms; None if its truth lacks gravity."""
    clip = at_rate(read_clip(folder), RATE)
    images = zip(clip.stamps, clip.images, strict=True)
    looks = [(clip.ups[stamp], image) for stamp, image in images if stamp in clip.ups]
    if not looks:
        return None
    errors, said, lines, seconds, floor = [], [], [], [], []
    subtractor = cv2.createBackgroundSubtractorMOG2()
    for up, image in looks:
        found = seen_vertical(image, clip.camera)
        lines.append(len(straight_lines(image, clip.camera).normals))
        seconds.append(_least(lambda image=image: seen_vertical(image, clip.camera)))
        floor.append(_least(lambda image=image: opencv_work(subtractor, image)))
        if found is not None:
            errors.append(float(np.degrees(np.arccos(np.clip(found.up @ up, -1.0, 1.0)))))
            said.append(float(np.degrees(found.sigma)))
    tilt = np.degrees(np.arccos(np.clip(-looks[0][0][1], -1.0, 1.0)))
    return {
        'clip': folder.name,
        'tilt': float(tilt),
        'looks': len(looks),
        'found': len(errors),
        'lines': float(np.mean(lines)),
        'errors': errors,
        'said': said,
        'ms': 1e3 * float(np.mean(seconds)),
        'floor_ms': 1e3 * float(np.mean(floor)),
    }


def _least(work: Callable[[], object]) -> float:
    """Minimum time of some runs, s."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Results of `measured` for all clips.

    Raises:
        ValueError: a clip can not be read.
    """
    folders = find_clips(clips, moving=True, quick=quick)[0]
    found = [one for x in told('vertical', folders, lambda x: x.name) if (one := measured(x))]
    return {'machine': description(), 'clips': found}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [
        ['clip', 'tilt of the camera, deg', 'lines', 'looks that tell', 'median error, deg',
         'largest', 'said', 'ms', 'floors'],
    ]  # fmt: skip
    for one in [*result['clips'], _all(result['clips'])]:
        known = bool(one['errors'])
        rows.append(
            [
                one['clip'],
                f'{one["tilt"]:.0f}',
                f'{one["lines"]:.0f}',
                f'{one["found"]} of {one["looks"]}',
                f'{np.median(one["errors"]):.1f}' if known else '',
                f'{max(one["errors"]):.1f}' if known else '',
                f'{np.mean(one["said"]):.1f}' if known else '',
                f'{one["ms"]:.0f}',
                f'{one["ms"] / one["floor_ms"]:.1f}',
            ]
        )
    return table(rows, markdown=markdown)


def _all(clips: list[dict[str, Any]]) -> dict[str, Any]:
    """Combined result of all clips."""

    def every(name: str) -> list[float]:
        return [x for one in clips for x in one[name]]

    def mean(name: str) -> float:
        return float(np.mean([one[name] for one in clips]))

    return {
        'clip': 'all',
        **{name: mean(name) for name in ('tilt', 'lines', 'ms', 'floor_ms')},
        **{name: sum(one[name] for one in clips) for name in ('looks', 'found')},
        'errors': every('errors'),
        'said': every('said'),
    }


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('vertical', __doc__, quick='one clip')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(arguments)
    return run_benchmark(
        'vertical',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
