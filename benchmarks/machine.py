"""Measurement tools: repeated timing, speed of the machine, memory."""

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
    """Shortest time of several runs, s; the first run is not counted."""
    function()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < least or time.perf_counter() < end:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def dgemm_rate(size: int = 768) -> float:
    """Floating-point operations per second of a matrix product with numpy's BLAS settings."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, size, size))
    return 2.0 * size**3 / best_time(lambda: a @ b, seconds=0.5)


def description() -> dict[str, Any]:
    """Processor, number of usable cores, and versions."""
    model = ''
    info = Path('/proc/cpuinfo')
    if info.is_file():
        lines = info.read_text('utf-8').splitlines()
        model = next((x.partition(':')[2].strip() for x in lines if x.startswith('model name')), '')
    # Imported here, so that it is not in the memory of measured processes.
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
    """Description of a machine in one line, for the foot of a table."""
    versions = ', '.join(f'{name} {machine[name]}' for name in ('python', 'numpy', 'opencv'))
    return f'{machine["processor"]}, {machine["cores"]} cores; {versions}.'


def peak_memory(process: int | str = 'self') -> float:
    """Largest resident memory of a process since it began, or since `forget_peak`, bytes.

    `ru_maxrss` is not used, because a process inherits it from its parent.
    """
    lines = Path(f'/proc/{process}/status').read_text('utf-8').splitlines()
    return 1024.0 * float(next(line.split()[1] for line in lines if line.startswith('VmHWM:')))


def forget_peak(process: int | str = 'self') -> None:
    """Resets the peak that `peak_memory` returns."""
    Path(f'/proc/{process}/clear_refs').write_text('5', 'utf-8')


def resident_memory(process: int | str = 'self') -> float:
    """Resident memory of a process now, bytes."""
    pages = int(Path(f'/proc/{process}/statm').read_text('utf-8').split()[1])
    return float(pages * resource.getpagesize())
