"""What a time is measured with: repeated timing, the machine's own speed, memory."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy


def best_time(function: Callable[[], Any], *, seconds: float = 1.0, least: int = 3) -> float:
    """Shortest of several runs, s, which nothing else disturbed; the first is not counted."""
    function()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < least or time.perf_counter() < end:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def dgemm_rate(size: int = 768) -> float:
    """Floating-point operations per second of a product of matrices, as numpy's BLAS is set."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, size, size))
    return 2.0 * size**3 / best_time(lambda: a @ b, seconds=0.5)


def description() -> dict[str, Any]:
    """Processor, cores that may be used, and versions."""
    model = ''
    info = Path('/proc/cpuinfo')
    if info.is_file():
        lines = info.read_text('utf-8').splitlines()
        model = next((x.partition(':')[2].strip() for x in lines if x.startswith('model name')), '')
    # Here, so that a process whose memory is measured does not hold it.
    import cv2

    return {
        'processor': model or platform.machine(),
        'cores': len(os.sched_getaffinity(0)),
        'python': platform.python_version(),
        'numpy': np.__version__,
        'scipy': scipy.__version__,
        'opencv': cv2.__version__,
    }


def on_machine(machine: dict[str, Any]) -> str:
    """A line for the foot of a table."""
    versions = ', '.join(f'{name} {machine[name]}' for name in ('python', 'numpy', 'opencv'))
    return f'{machine["processor"]}, {machine["cores"]} cores; {versions}.'


def peak_memory(process: int | str = 'self') -> float:
    """Largest resident memory of a process since it began, or since `forget_peak`, bytes.

    Not `ru_maxrss`: a process inherits that of the one that started it.
    """
    lines = Path(f'/proc/{process}/status').read_text('utf-8').splitlines()
    return 1024.0 * float(next(line.split()[1] for line in lines if line.startswith('VmHWM:')))


def forget_peak(process: int | str = 'self') -> None:
    """From now on `peak_memory` tells of what follows."""
    Path(f'/proc/{process}/clear_refs').write_text('5', 'utf-8')


def resident_memory(process: int | str = 'self') -> float:
    """Resident memory of a process now, bytes."""
    pages = int(Path(f'/proc/{process}/statm').read_text('utf-8').split()[1])
    return float(pages * resource.getpagesize())
