"""soak: nodes and files under load and fault; what was done, how often, and what was lost."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.clips import table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.soak.files import files
from benchmarks.soak.hostile import hostile
from benchmarks.soak.messages import messages
from benchmarks.soak.nodes import nodes
from benchmarks.soak.outcome import MOST_GROWTH, Amount, Outcome

MINUTES = 10.0

# Each case: what does it, how often in full and with --quick, and its share of the time.
CASES: dict[str, tuple[Callable[..., Iterator[Outcome]], int, int, float]] = {
    'hostile': (hostile, 100_000, 1, 0.3),
    'messages': (messages, 100_000, 60, 0.25),
    'nodes': (nodes, 200, 2, 0.35),
    'files': (files, 3000, 30, 0.10),
}


def main(argv: list[str]) -> int:
    """Runs the soak; 1 where something was lost or went wrong."""
    parser = benchmark_parser('soak', __doc__, quick='each case a few times, with one node')
    add_choice(parser, tuple(CASES), 'CASE')
    text = 'that it may take; what is not done by then is left out (%(default)g)'
    parser.add_argument('--minutes', type=float, default=MINUTES, metavar='M', help=text)
    text = 'hostile files to read, instead of those that are made'
    parser.add_argument('--files', type=Path, metavar='FOLDER', help=text)
    options = parser.parse_args(argv)
    only = ('hostile',) if options.files else tuple(options.only)
    result = measure(options.minutes, quick=options.quick, only=only, given=options.files)
    show(result, as_text, as_json=options.json)
    return 0 if result_met(result) else 1


def measure(
    minutes: float = MINUTES,
    *,
    quick: bool = False,
    only: tuple[str, ...] = tuple(CASES),
    given: Path | None = None,
) -> dict[str, Any]:
    """What came of the cases."""
    shares = sum(CASES[name][3] for name in only)

    def done(name: str) -> list[dict[str, Any]]:
        case, often, seldom, share = CASES[name]
        amount = Amount(seldom if quick else often, 60.0 * minutes * share / shares)
        found = []
        options = {'given': given} if name == 'hostile' else {}
        for outcome in case(amount, quick=quick, **options):
            found.append(_entry(outcome))
            tqdm.write(f'  {outcome.of}: {outcome.done}: {outcome.told()}', file=sys.stderr)
        return found

    stages = {name: functools.partial(done, name) for name in CASES}
    return run_stages('soak', stages, only)


def result_met(result: dict[str, Any]) -> bool:
    """Whether nothing was lost and nothing went wrong."""
    return all(entry['met'] for name in CASES for entry in result.get(name, []))


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    rows = [['of', 'what was done', 'times', 'refused', 'lost', 'memory', 'stays', '']]
    for name in CASES:
        for entry in result.get(name, []):
            growth = entry['growth_mb']
            rows.append(
                [
                    entry['of'], entry['done'], str(entry['times']), str(entry['refused']),
                    str(entry['lost']), '' if growth is None else f'{growth:+.0f} MB',
                    '' if growth is None else f'{entry["kept_mb"]:+.0f} MB', entry['told'],
                ]
            )  # fmt: skip
    return table(rows, left=2, markdown=markdown)


def _entry(outcome: Outcome) -> dict[str, Any]:
    return {
        'of': outcome.of,
        'done': outcome.done,
        'times': outcome.times,
        'refused': outcome.refused,
        'lost': outcome.lost,
        'growth_mb': outcome.growth_mb,
        'kept_mb': outcome.kept_mb,
        'most_growth_mb': MOST_GROWTH,
        'faults': outcome.faults,
        'told': outcome.told(),
        'met': outcome.met,
    }
