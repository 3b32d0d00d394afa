"""bags: what replay adds to the estimate, and memory with a large bag."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import COMPRESSED, ROOT, find_clips, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.stages import StageClock, Stages
from hmt_ros.app.replay import command as replay
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import SlidingWindow, TrajectoryMixture
from hmt_ros.tracking import Tracker
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.headers import header_message

STAGES = ('memory', 'replay')
MOST_ADDED = 0.1  # of the time of the estimate
MOST_GROWTH = 32e6  # bytes of memory, from a twentieth of a bag to its end
LARGE = 2_000_000_000  # bytes
QUICK_LARGE = 20_000_000
PICTURE_BYTES = 100_000
# What estimates: all else that replay does is added by it.
ESTIMATE = 'estimate'
ESTIMATORS: Stages = (
    (Tracker, 'step', ESTIMATE),
    (SlidingWindow, 'step', ESTIMATE),
    (SlidingWindow, 'finish', ESTIMATE),
    (TrajectoryMixture, 'marginal', ESTIMATE),
    (GaussianMixture, 'reduce', ESTIMATE),
    (BackgroundModel, 'learn', ESTIMATE),
    (BackgroundModel, 'silhouette', ESTIMATE),
    (PosePredictor, 'observe', ESTIMATE),
)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('bags', __doc__, quick='a small bag, and a replay of one kind')
    add_choice(parser, STAGES)
    options = parser.parse_args(argv)
    result = measure(quick=options.quick, only=options.only)
    return show(result, as_text, as_json=options.json)


def measure(*, quick: bool = False, only: tuple[str, ...] = STAGES) -> dict[str, Any]:
    """All stages, on bags in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix='benchmark_bags.') as name:
        folder = Path(name)
        stages = {
            'memory': lambda: memory(folder, QUICK_LARGE if quick else LARGE),
            'replay': lambda: replayed(folder, quick=quick),
        }
        return run_stages('bags', stages, only)


# Memory


def pictures(path: Path, size: float) -> Path:
    """A bag with so many bytes of what can not be compressed, as pictures are."""
    messages = RosbagsMessages()
    rng = np.random.default_rng(0)
    with BagWriter(path) as bag:
        for i in range(max(10, round(size / PICTURE_BYTES))):
            stamp = 10**18 + i * 33_333_333
            picture = messages.create(
                'sensor_msgs/msg/CompressedImage',
                header=header_message(messages, stamp, 'camera'),
                format='jpeg',
                data=rng.integers(0, 256, PICTURE_BYTES, dtype=np.uint8),
            )
            bag.write('image/compressed', stamp, picture)
    return path


def memory(folder: Path, size: int) -> dict[str, Any]:
    """Resident memory while a large bag is written, and while it is read."""
    forget_peak()
    path = pictures(folder / 'large', size)
    writing = peak_memory()
    stored = sum(file.stat().st_size for file in path.iterdir())
    track: list[list[float]] = []
    forget_peak()
    start = time.perf_counter()
    with BagReader(path) as bag:
        count = bag.message_count()
        marks = {round(share * (count - 1)) for share in np.linspace(0.05, 1.0, 20)}
        for i, stored_message in enumerate(bag.messages()):
            assert len(stored_message.message.data) == PICTURE_BYTES
            if i in marks:
                track.append([i / (count - 1), resident_memory() / 1e6])
    growth = 1e6 * (max(used for _, used in track) - track[0][1])
    return {
        'gb': stored / 1e9,
        'seconds': time.perf_counter() - start,
        'writing_mb': writing / 1e6,
        'reading_mb': peak_memory() / 1e6,
        'resident_mb': track,
        'growth_mb': growth / 1e6,
        'wanted': f'at most {MOST_GROWTH / 1e6:g} MB more from a twentieth of it to the end',
        'met': growth <= MOST_GROWTH,
    }


# Replay


def replayed(folder: Path, *, quick: bool = False) -> list[dict[str, Any]]:
    """What replay adds to the time of the estimate, with and without smoother and BME."""
    source = ROOT / 'bags' / 'reach' if quick else find_clips(None)[0][-1]
    background = ['--background', str(source / 'background.png')]
    person = ['--subject', str(source / 'subject.yaml'), *background]
    ways = {
        'filter': [*person, '--no-smoother'],
        'filter and smoother': person,
        'filter, smoother and BME': [*person, '--bme'],
    }
    if quick:
        ways = {'filter': ways['filter']}
    # Kernels are compiled.
    _run(source, folder / 'first', [*ways.values()][-1])
    found = []
    for number, (what, options) in enumerate(ways.items()):
        clock = StageClock(ESTIMATORS)
        with clock.running():
            start = time.perf_counter()
            _run(source, folder / str(number), options)
            seconds = time.perf_counter() - start
        estimate = clock.seconds[ESTIMATE]
        added = seconds - estimate
        with BagReader(source) as bag:
            images = bag.find_topic([COMPRESSED]).message_count
        found.append(
            {
                'what': what,
                'clip': source.name,
                'images': images,
                'estimate_ms': 1e3 * estimate / images,
                'added_ms': 1e3 * added / images,
                'share': added / estimate,
                'wanted': f'at most {100 * MOST_ADDED:g} %',
                'met': added <= MOST_ADDED * estimate,
            }
        )
    return found


def _run(source: Path, target: Path, options: list[str]) -> None:
    if code := replay.main([str(source), '-o', str(target), '--quiet', *options]):
        raise ValueError(f'replay of {source} ended with {code}')


# What is printed


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    tables = {'memory': _memory_rows, 'replay': _replay_rows}
    return '\n\n'.join(
        table(rows(result[stage]), markdown=markdown)
        for stage, rows in tables.items()
        if stage in result
    )


def _memory_rows(case: dict[str, Any]) -> list[list[str]]:
    return [
        [
            'resident memory', 'size', 'growth on the way', 'most, reading', 'most, writing',
            f'at most {MOST_GROWTH / 1e6:g} MB more',
        ],
        [
            'one large bag', f'{case["gb"]:.2f} GB', f'{case["growth_mb"]:.1f} MB',
            f'{case["reading_mb"]:.0f} MB', f'{case["writing_mb"]:.0f} MB', _verdict(case),
        ],
    ]  # fmt: skip


def _replay_rows(cases: list[dict[str, Any]]) -> list[list[str]]:
    most = f'at most {100 * MOST_ADDED:g} %'
    return [['replay, per image', 'images', 'estimate', 'added', 'share', most]] + [
        [
            f'{case["clip"]}, {case["what"]}', str(case['images']),
            f'{case["estimate_ms"]:.0f} ms', f'{case["added_ms"]:.1f} ms',
            f'{100 * case["share"]:.1f} %', _verdict(case),
        ]
        for case in cases
    ]  # fmt: skip


def _verdict(case: dict[str, Any]) -> str:
    return 'met' if case['met'] else 'missed'
