"""Dispatches to the benchmarks: `python -m benchmarks NAME [options]`."""

from __future__ import annotations

import os
import sys

from hmt_ros.app.printing import until_nobody_reads

# Before numpy is imported: with small matrices a second BLAS thread costs more than it brings.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

USAGE = """usage: python -m benchmarks [NAME [options]]

  bags       reading, memory, and what replay adds to the estimate
  experts    conditional densities: a toy, motions of people apart, clips, speed
  tracking   accuracy, calibration and speed of the tracker on clips with known truth
  flips      time per leaf of the interpretation trees
  kjs        kinematic jumps against random sampling at finding minima
  kernels    the compiled likelihood against vectorised numpy
  nodes      images at the rate of a camera, through DDS
  soak       nodes and files under load and fault
  smoothing  exactness, speed and peers of the smoother
  votes      which chain to flip or to search, by the vote that chooses it

Without a name all of them run. Every benchmark takes --json and --help.
"""


def main(argv: list[str]) -> int:
    """Runs one benchmark, or all; the exit code is that of the first that fails."""
    # Only now: they import numpy.
    from benchmarks import (
        bags,
        experts,
        flips,
        kernels,
        kjs,
        nodes,
        smoothing,
        soak,
        tracking,
        votes,
    )

    benchmarks = {
        'bags': bags.main,
        'experts': experts.main,
        'flips': flips.main,
        'kernels': kernels.main,
        'kjs': kjs.main,
        'nodes': nodes.main,
        'smoothing': smoothing.main,
        'soak': soak.main,
        'tracking': tracking.main,
        'votes': votes.main,
    }
    if argv and argv[0] in ('-h', '--help'):
        print(USAGE, end='')
        return 0
    if not argv:
        for name, run in benchmarks.items():
            print(f'== {name}', flush=True)
            if code := run([]):
                return code
        return 0
    if argv[0] not in benchmarks:
        print(f'benchmarks: no {argv[0]!r}, wanted one of {", ".join(benchmarks)}', file=sys.stderr)
        return 1
    return benchmarks[argv[0]](argv[1:])


if __name__ == '__main__':
    sys.exit(until_nobody_reads(lambda: main(sys.argv[1:])))
