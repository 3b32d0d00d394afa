"""Dispatches to the benchmarks: `python -m benchmarks NAME [options]`."""

from __future__ import annotations

import sys

from benchmarks import BENCHMARKS, benchmark
from hmt_ros.app.last_resort import last_resort

HELP = """\
usage: python -m benchmarks [NAME [options]]

{benchmarks}

Without a name all of them run. Every benchmark takes --json, --quick and --help.
"""


def main(argv: list[str]) -> int:
    """Runs one benchmark or all; returns the exit code of the first that fails."""
    if argv and argv[0] in ('-h', '--help'):
        width = max(map(len, BENCHMARKS))
        lines = [f'  {name:{width}}  {what}' for name, what in BENCHMARKS.items()]
        print(HELP.format(benchmarks='\n'.join(lines)), end='')
        return 0
    if not argv:
        for name in BENCHMARKS:
            print(f'== {name}', flush=True)
            if code := benchmark(name).main([]):
                return int(code)
        return 0
    if argv[0] not in BENCHMARKS:
        print(f'benchmarks: no {argv[0]!r}, wanted one of {", ".join(BENCHMARKS)}', file=sys.stderr)
        return 1
    return int(benchmark(argv[0]).main(argv[1:]))


if __name__ == '__main__':
    sys.exit(last_resort('benchmarks', lambda: main(sys.argv[1:]), debug=True))
