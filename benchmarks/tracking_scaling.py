"""What a step of the tracker costs by modes, image size and threads, and who executes it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, resized, table
from benchmarks.runs import new_tracker
from benchmarks.stages import StageClock
from hmt_ros.body import load_body
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.observer import Observer

MODES = (1, 2, 4, 8, 16, 32)
EVALUATIONS_A_MODE = 40
HEIGHTS = (120, 240, 480, 720, 1080)
THREADS = (1, 2, 4)
# Images that start a track and load what is compiled.
STARTING = 5
VISION = ((Observer, 'view', 'vision'), (Observer, 'observation', 'vision'))
# Samples a second, and who executes by the name of the file that the code is in.
FREQUENCY = 2000
EXECUTORS = (
    ('compiled', r'^\[JIT\]|^perf-|^//anon|^\[unknown\]|memfd|^anon'),
    ('OpenCV', r'cv2|opencv'),
    ('BLAS', r'openblas|lapack'),
    ('numpy', r'_multiarray|_umath|numpy'),
    ('interpreter', r'python'),
    ('libc', r'libc[.-]|ld-linux|libm[.-]|libstdc'),
    ('kernel', r'^\[kernel|^\[vdso'),
)


def scaling(clip: Clip) -> dict[str, Any]:
    """Costs of a step on one clip, by images: see the module."""
    usual = TrackerSettings(threads=1)
    modes = [
        {'modes': k}
        | _costs(
            clip,
            replace(usual, max_hypotheses=k, evaluation_budget=EVALUATIONS_A_MODE * k),
        )
        for k in MODES
    ]
    sizes = []
    for height in HEIGHTS:
        other = resized(clip, height / clip.camera.height)
        sizes.append({'size': f'{other.camera.width}x{height}'} | _costs(other, usual))
    threads = [{'threads': n} | _costs(clip, replace(usual, threads=n)) for n in THREADS]
    same = all(np.array_equal(threads[0]['poses'], row['poses']) for row in threads)
    for row in (*modes, *sizes, *threads):
        del row['poses']
    return {
        'clip': clip.name, 'modes': modes, 'sizes': sizes, 'threads': threads, 'same': same,
        'executors': executors(clip, usual),
    }  # fmt: skip


def _costs(clip: Clip, settings: TrackerSettings) -> dict[str, Any]:
    """Means over the images of a clip after the first ones, and all poses."""
    tracker = new_tracker(clip, load_body('human37'), settings, 0)
    clock = StageClock(VISION, time.process_time)
    cpu, wall, kept, evaluations = [], [], [], []
    poses: list[NDArray[np.float64]] = []
    with clock.running():
        for i, (stamp, image) in enumerate(zip(clip.stamps, clip.images, strict=True)):
            if i == STARTING:
                clock.seconds.clear()
            start, began = time.process_time(), time.perf_counter()
            tracker.step(image, stamp)
            cpu.append(time.process_time() - start)
            wall.append(time.perf_counter() - began)
            kept.append(len(tracker.estimate.modes))
            evaluations.append(tracker.estimate.evaluations)
            poses.append(tracker.estimate.modes.poses)
    count = len(cpu) - STARTING
    vision = 1e3 * clock.seconds.get('vision', 0.0) / count
    mean = 1e3 * float(np.mean(cpu[STARTING:]))
    return {
        'kept': float(np.mean(kept[STARTING:])),
        'evaluations': float(np.mean(evaluations[STARTING:])),
        'cpu_ms': mean,
        'wall_ms': 1e3 * float(np.mean(wall[STARTING:])),
        'vision_ms': vision,
        'rest_ms': mean - vision,
        'poses': np.concatenate(poses),
    }


def executors(clip: Clip, settings: TrackerSettings) -> dict[str, float]:
    """Shares of the samples of `perf` by who executes; empty where there is no `perf`."""
    if shutil.which('perf') is None:
        return {}
    tracker = new_tracker(clip, load_body('human37'), settings, 0)
    images = list(zip(clip.stamps, clip.images, strict=True))
    for stamp, image in images[:STARTING]:
        tracker.step(image, stamp)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'perf.data'
        with _recording(file):
            for stamp, image in images[STARTING:]:
                tracker.step(image, stamp)
        command = ['perf', 'report', '-i', str(file), '--sort', 'dso', '--stdio', '-q']
        report = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    found: dict[str, float] = defaultdict(float)
    for line in report.splitlines():
        row = re.match(r'\s*([\d.]+)%\s+(\S.*?)\s*$', line)
        if row is None:
            continue
        names = (who for who, pattern in EXECUTORS if re.search(pattern, row[2]))
        found[next(names, 'other')] += float(row[1])
    return dict(sorted(found.items(), key=lambda item: -item[1]))


@contextmanager
def _recording(file: Path) -> Iterator[None]:
    """Has `perf` sample this process."""
    command = [
        'perf',
        'record',
        '-q',
        '-F',
        str(FREQUENCY),
        '-p',
        str(os.getpid()),
        '-o',
        str(file),
    ]
    recorder = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    time.sleep(1.0)
    try:
        yield
    finally:
        recorder.send_signal(signal.SIGINT)
        recorder.wait()


def scaling_as_text(found: dict[str, Any], *, markdown: bool = False) -> str:
    """Four tables."""
    columns = ('cpu_ms', 'vision_ms', 'rest_ms')
    heads = ['CPU, ms', 'vision', 'rest']
    parts = [f'{found["clip"]}, images, one thread: {EVALUATIONS_A_MODE} evaluations a mode']
    rows = [['modes', 'kept', 'evaluations', *heads]]
    for row in found['modes']:
        own = [str(row['modes']), f'{row["kept"]:.1f}', f'{row["evaluations"]:.0f}']
        rows.append([*own, *(f'{row[name]:.1f}' for name in columns)])
    parts.append(table(rows, markdown=markdown))
    rows = [['image', *heads]]
    rows += [[row['size'], *(f'{row[x]:.1f}' for x in columns)] for row in found['sizes']]
    parts.append(table(rows, markdown=markdown))
    rows = [['threads', 'wall, ms', 'CPU, ms']]
    for row in found['threads']:
        rows.append([str(row['threads']), f'{row["wall_ms"]:.1f}', f'{row["cpu_ms"]:.1f}'])
    parts.append(table(rows, markdown=markdown))
    parts.append(f'the same bytes with any number of threads: {"yes" if found["same"] else "NO"}')
    if found['executors']:
        rows = [['executes', 'share, %']]
        rows += [[name, f'{share:.0f}'] for name, share in found['executors'].items()]
        parts.append(table(rows, markdown=markdown))
    return '\n\n'.join(parts)
