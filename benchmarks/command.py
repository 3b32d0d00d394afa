"""Common parts of the benchmark commands: options, stages and output."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from tqdm import tqdm

from benchmarks.clips import rounded
from benchmarks.machine import description

Item = TypeVar('Item')


def benchmark_parser(name: str, text: str | None, *, quick: str) -> argparse.ArgumentParser:
    """A parser with the options of every benchmark.

    Args:
        name: name of the benchmark.
        text: description of the benchmark.
        quick: description of --quick.
    """
    parser = argparse.ArgumentParser(
        prog=f'python -m benchmarks {name}',
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('--quick', action='store_true', help=quick)
    return parser


def add_choice(
    parser: argparse.ArgumentParser, stages: Sequence[str], metavar: str = 'STAGE'
) -> None:
    """Adds the option --only, which selects stages."""
    parser.add_argument(
        '--only', nargs='+', choices=stages, default=stages, metavar=metavar,
        help=f'some of {", ".join(stages)}',
    )  # fmt: skip


def show(result: dict[str, Any], text: Callable[[dict[str, Any]], str], *, as_json: bool) -> int:
    """Prints a result; returns the exit code."""
    print(json.dumps(rounded(result), indent=1) if as_json else text(result))
    return 0


def run_benchmark(
    name: str,
    measure: Callable[[], dict[str, Any]],
    text: Callable[[dict[str, Any]], str],
    *,
    as_json: bool,
) -> int:
    """Runs a benchmark and prints its result; returns the exit code.

    Args:
        name: name of the benchmark.
        measure: function that measures.
        text: function that makes a human-readable text of the result.
        as_json: whether to print JSON instead.

    Returns:
        0, also if required data are missing, which a line on stderr reports; 1 after other errors,
        which a line on stderr explains.
    """
    try:
        result = measure()
    except FileNotFoundError as error:
        print(f'{name}: skipped, {error}', file=sys.stderr)
        return 0
    except ValueError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 1
    return show(result, text, as_json=as_json)


def run_stages(
    benchmark: str, stages: Mapping[str, Callable[[], Any]], only: Sequence[str]
) -> dict[str, Any]:
    """Results of the stages in their order, with a description of the machine."""
    chosen = [name for name in stages if name in only]
    result: dict[str, Any] = {'machine': description()}
    for name in told(benchmark, chosen):
        result[name] = stages[name]()
    return result


def told(
    benchmark: str, items: Iterable[Item], name: Callable[[Item], str] = str
) -> Iterator[Item]:
    """Yields the items, with a line on stderr for each, because an item may take minutes."""
    chosen = list(items)
    start = time.monotonic()
    for number, item in enumerate(chosen, 1):
        minutes, seconds = divmod(round(time.monotonic() - start), 60)
        spent = f'{minutes}:{seconds:02d}'
        # tqdm.write does not disturb a progress bar of another part.
        line = f'{benchmark}: {name(item)}, {number} of {len(chosen)}, at {spent}'
        tqdm.write(line, file=sys.stderr)
        yield item
