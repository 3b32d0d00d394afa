"""soak: nodes and files under load and faults; actions, their numbers, and losses."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.clips import table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.soak.files import files
from benchmarks.soak.hostile import hostile
from benchmarks.soak.messages import messages
from benchmarks.soak.nodes import nodes
from benchmarks.soak.outcome import Amount, Outcome, place

MINUTES = 10.0

# By case: function, repetitions in full and with --quick, and share of the time.
CASES: dict[str, tuple[Callable[..., Iterator[Outcome]], int, int, float]] = {
    'hostile': (hostile, 100_000, 1, 0.3),
    'messages': (messages, 100_000, 30, 0.15),
    'nodes': (nodes, 200, 2, 0.45),
    'files': (files, 3000, 10, 0.10),
}


def main(argv: list[str]) -> int:
    """Runs the soak test; returns 1 if something was lost or went wrong."""
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
    """Outcomes of the cases."""
    shares = sum(CASES[name][3] for name in only)

    def done(name: str) -> list[dict[str, Any]]:
        case, often, seldom, share = CASES[name]
        amount = Amount(seldom if quick else often, 60.0 * minutes * share / shares)
        found = []
        options = {'given': given} if name == 'hostile' else {}
        for outcome in _to_its_end(name, case(amount, quick=quick, **options)):
            told = outcome.told()
            found.append({**asdict(outcome), 'told': told, 'met': outcome.met})
            tqdm.write(f'  {outcome.of}: {outcome.done}: {told}', file=sys.stderr)
        return found

    stages = {name: functools.partial(done, name) for name in CASES}
    return run_stages('soak', stages, only)


def result_met(result: dict[str, Any]) -> bool:
    """Whether nothing was lost and nothing went wrong."""
    return all(entry['met'] for name in CASES for entry in result.get(name, []))


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [['of', 'what was done', 'times', 'refused', 'lost', 'memory', 'stays', '']]
    for name in CASES:
        for entry in result.get(name, []):
            memory = [entry['growth_mb'], entry['kept_mb']]
            said = ['' if entry['growth_mb'] is None else f'{x:+.0f} MB' for x in memory]
            counts = [str(entry[name]) for name in ('of', 'done', 'times', 'refused', 'lost')]
            rows.append([*counts, *said, entry['told']])
    return table(rows, left=2, markdown=markdown)


def _to_its_end(name: str, outcomes: Iterator[Outcome]) -> Iterator[Outcome]:
    """The outcomes of a stage; a failure of the stage itself becomes an outcome, too."""
    try:
        yield from outcomes
    except Exception as error:  # noqa: BLE001
        yield Outcome(name, 'the stage itself', faults=[place(error)])
