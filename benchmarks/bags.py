"""bags: how fast they are read, what replay adds to the estimate, and memory with a large bag."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader

from benchmarks.clips import COMPRESSED, find_clips, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.stages import StageClock, Stages
from hmt_ros.app.replay import command as replay
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions import smoother_session
from hmt_ros.smoothing import SlidingWindow, TrajectoryMixture
from hmt_ros.tracking import Tracker
from msg_tools import BagReader, BagWriter, RosbagsMessages, typestore
from msg_tools.messages.headers import header_message

STAGES = ('reading', 'memory', 'replay')
ROUNDS = 5
LEAST_RATE = 0.5  # of the rate of rosbags
MOST_ADDED = 0.1  # of the time of the estimate
MOST_GROWTH = 32e6  # bytes of memory, from a twentieth of a bag to its end
LARGE = 2_000_000_000  # bytes
QUICK_LARGE = 200_000_000
PICTURE_BYTES = 100_000
# What estimates: all else that replay does is added by it.
ESTIMATE = 'estimate'
ESTIMATORS: Stages = (
    (Tracker, 'step', ESTIMATE),
    (smoother_session, 'merged_if_close', ESTIMATE),
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
    parser = benchmark_parser('bags', __doc__, quick='small bags')
    add_choice(parser, STAGES)
    options = parser.parse_args(argv)
    result = measure(quick=options.quick, only=options.only)
    return show(result, as_text, as_json=options.json)


def measure(*, quick: bool = False, only: tuple[str, ...] = STAGES) -> dict[str, Any]:
    """All stages, on bags in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix='benchmark_bags.') as name:
        folder = Path(name)
        stages = {
            'reading': lambda: reading(folder, 0.02 if quick else 1.0),
            'memory': lambda: memory(folder, QUICK_LARGE if quick else LARGE),
            'replay': lambda: replayed(folder),
        }
        return run_stages('bags', stages, only)


# Reading


def reading(folder: Path, scale: float = 1.0, rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Rates of our reader and of rosbags, on the same files, one after the other."""
    found = []
    cases = {
        'images of 100 kB': pictures(folder / 'pictures', scale * 2e8),
        'joint states of 1 kB': states(folder / 'states', round(scale * 5e4)),
    }
    for what, path in cases.items():
        for how, functions in (
            ('as bytes', (read_our_bytes, read_their_bytes)),
            ('as messages', (read_our_messages, read_their_messages)),
        ):
            seconds = _in_turn(functions, path, rounds)
            count, size = functions[0](path)
            found.append(
                {
                    'what': what,
                    'how': how,
                    'messages': count,
                    'mb': size / 1e6,
                    'ours_mb_per_s': size / 1e6 / seconds[0],
                    'rosbags_mb_per_s': size / 1e6 / seconds[1],
                    'ratio': seconds[1] / seconds[0],
                    'wanted': f'at least {LEAST_RATE:g}',
                    'met': seconds[1] / seconds[0] >= LEAST_RATE,
                }
            )
    return found


def _in_turn(functions: tuple[Callable[[Path], Any], ...], path: Path, rounds: int) -> list[float]:
    """Shortest times, s, of functions that run in turn, so that what else goes on hits all."""
    best = [np.inf] * len(functions)
    for _ in range(rounds):
        for i, function in enumerate(functions):
            start = time.perf_counter()
            function(path)
            best[i] = min(best[i], time.perf_counter() - start)
    return best


def read_our_bytes(path: Path) -> tuple[int, int]:
    """This package reads all messages of a bag, as bytes; how many there are, and their size."""
    count = size = 0
    with BagReader(path) as bag:
        for stored in bag.messages():
            count += 1
            size += len(stored.data)
    return count, size


def read_their_bytes(path: Path) -> tuple[int, int]:
    """rosbags reads all messages of a bag, as bytes; how many there are, and their size."""
    count = size = 0
    with Reader(path) as bag:
        for _, _, data in bag.messages():
            count += 1
            size += len(data)
    return count, size


def read_our_messages(path: Path) -> tuple[int, int]:
    """This package reads and decodes all messages of a bag; how many there are, and their size."""
    count = size = 0
    with BagReader(path) as bag:
        for stored in bag.messages():
            count += stored.message.header.stamp.sec > 0
            size += len(stored.data)
    return count, size


def read_their_messages(path: Path) -> tuple[int, int]:
    """rosbags reads and decodes all messages of a bag; how many there are, and their size."""
    count = size = 0
    store = typestore()
    with Reader(path) as bag:
        for connection, _, data in bag.messages():
            message: Any = store.deserialize_cdr(data, connection.msgtype)
            count += message.header.stamp.sec > 0
            size += len(data)
    return count, size


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


def states(path: Path, count: int) -> Path:
    """A bag with many small messages."""
    messages = RosbagsMessages()
    rng = np.random.default_rng(0)
    names = [f'joint_{i}' for i in range(37)]
    with BagWriter(path) as bag:
        for i in range(max(10, count)):
            stamp = 10**18 + i * 1_000_000
            state = messages.create(
                'sensor_msgs/msg/JointState',
                header=header_message(messages, stamp, 'camera'),
                name=names,
                position=rng.normal(size=37),
            )
            bag.write('joint_states', stamp, state)
    return path


# Memory


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


def replayed(folder: Path) -> list[dict[str, Any]]:
    """What replay adds to the time of the estimate, with and without smoother and BME."""
    source = find_clips(None)[0][-1]
    background = ['--background', str(source / 'background.png')]
    person = ['--subject', str(source / 'subject.yaml'), *background]
    ways = {
        'filter': [*person, '--no-smoother'],
        'filter and smoother': person,
        'filter, smoother and BME': [*person, '--bme'],
    }
    # Kernels are compiled.
    _run(source, folder / 'first', ways['filter, smoother and BME'])
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
    tables = {'reading': _reading_rows, 'memory': _memory_rows, 'replay': _replay_rows}
    return '\n\n'.join(
        table(rows(result[stage]), markdown=markdown)
        for stage, rows in tables.items()
        if stage in result
    )


def _reading_rows(cases: list[dict[str, Any]]) -> list[list[str]]:
    head = ['reading', 'messages', 'this package', 'rosbags', 'ratio', f'at least {LEAST_RATE}']
    return [head] + [
        [
            f'{case["what"]}, {case["how"]}', str(case['messages']),
            f'{case["ours_mb_per_s"]:.0f} MB/s', f'{case["rosbags_mb_per_s"]:.0f} MB/s',
            f'{case["ratio"]:.2f}', _verdict(case),
        ]
        for case in cases
    ]  # fmt: skip


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
