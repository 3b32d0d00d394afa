"""bags: time that replay adds to the estimate."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.clips import COMPRESSED, ROOT, find_clips, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.stages import StageClock, Stages
from hmt_ros.app.replay import command as replay
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.smoothing import SlidingWindow
from hmt_ros.tracking import Tracker
from msg_tools import BagReader

MOST_ADDED = 0.1  # maximum added time, relative to the time of the estimate
# Functions that estimate; all other time is added by replay.
ESTIMATE = 'estimate'
ESTIMATORS: Stages = (
    (Tracker, 'step', ESTIMATE),
    (SlidingWindow, 'step', ESTIMATE),
    (SlidingWindow, 'finish', ESTIMATE),
    (PosePredictor, 'observe', ESTIMATE),
)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('bags', __doc__, quick='the smallest bag, and the filter alone')
    options = parser.parse_args(argv)
    return run_benchmark(
        'bags', lambda: measure(quick=options.quick), as_text, as_json=options.json
    )


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Time that replay adds, with bags in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix='benchmark_bags.') as name:
        return {'machine': description(), 'replay': replayed(Path(name), quick=quick)}


def replayed(folder: Path, *, quick: bool = False) -> list[dict[str, Any]]:
    """Time that replay adds to the estimate, with and without smoother and BME."""
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
    else:
        # A first run fills the file cache.
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


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    most = f'at most {100 * MOST_ADDED:g} %'
    rows = [['replay, per image', 'images', 'estimate', 'added', 'share', most]]
    rows += [
        [
            f'{case["clip"]}, {case["what"]}',
            str(case['images']),
            f'{case["estimate_ms"]:.0f} ms',
            f'{case["added_ms"]:.1f} ms',
            f'{100 * case["share"]:.1f} %',
            'met' if case['met'] else 'missed',
        ]
        for case in result['replay']
    ]
    return table(rows, markdown=markdown)
