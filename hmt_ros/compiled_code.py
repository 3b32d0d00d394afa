"""The folder of compiled kernels: it follows from the state of many sources, not of one file alone.

numba compiles a kernel anew when its own file changes. A kernel holds code of other files, too, and
names their types: code from before one of these changed must not be loaded. All of them lie in
`FOLDERS`, so that other changes compile nothing.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from threading import Event, Thread
from typing import Any

VARIABLE = 'NUMBA_CACHE_DIR'
# Folders of a package in which kernels, and all that they import, lie.
FOLDERS = ('body', 'flips', 'image', 'inference', 'smoothing', 'tracking')
_PREFIX = 'compiled-'
# Code of other states is kept for so long, s: a process that still runs may be using it.
KEPT = 24 * 3600.0
# Between two lines about kernels that are being compiled, s, and between two looks whether any is.
INTERVAL, _GLANCE = 5.0, 0.1


def keep_compiled_code_apart(package: Path) -> None:
    """Makes numba keep compiled code in a folder for this state of a package.

    The folder is in the package, or in the user's cache where that can not be written. There it
    begins with a copy of the code compiled when the package was installed: numba loads nothing
    from a folder that it can not write. One that the environment names (`NUMBA_CACHE_DIR`) is used
    as it is.
    """
    if os.environ.get(VARIABLE):
        return
    folder = folder_of(package)
    if not folder.is_dir():
        for other in folder.parent.glob(f'{_PREFIX}*'):
            if time.time() - other.stat().st_mtime > KEPT:
                shutil.rmtree(other, ignore_errors=True)
        installed = package / '__pycache__' / folder.name
        if installed.is_dir():
            # Where nothing can be written at all, numba says so.
            with suppress(OSError):
                _copy(installed, folder)
    os.environ[VARIABLE] = str(folder)
    if 'numba' in sys.modules:
        sys.modules['numba'].config.CACHE_DIR = str(folder)


def folder_of(package: Path) -> Path:
    """The folder for the code that is compiled from the present sources of a package."""
    state = hashlib.sha256()
    for path in sorted(x for folder in FOLDERS for x in (package / folder).rglob('*.py')):
        found = path.stat()
        state.update(f'{path.relative_to(package)} {found.st_size} {found.st_mtime_ns}\n'.encode())
    parent = package / '__pycache__'
    if not os.access(parent if parent.is_dir() else package, os.W_OK):
        cache = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
        own = hashlib.sha256(str(package).encode()).hexdigest()[:12]
        parent = Path(cache) / 'hmt_ros' / own
    return parent / f'{_PREFIX}{state.hexdigest()[:16]}'


def _copy(source: Path, target: Path) -> None:
    """Copies a folder, the contents of its files alone, so that all of it can be written."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        for path in source.rglob('*'):
            if path.is_file():
                copy = Path(folder) / target.name / path.relative_to(source)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
        # Another process may have been faster.
        (Path(folder) / target.name).rename(target)


def folder_in_use() -> str:
    """The folder in which code that is compiled now is kept."""
    return os.environ.get(VARIABLE, '')


class CompiledFunctions:
    """Functions that numba compiles from now on; those that it loads do not count."""

    def __init__(self) -> None:
        from numba.core import event

        listener = event.RecordingListener()
        event.register('numba:compile', listener)
        self._events: list[tuple[float, Any]] = listener.buffer

    @property
    def count(self) -> int:
        """How many have been compiled."""
        return sum(found.is_end for _, found in self._events)

    @property
    def busy(self) -> bool:
        """Whether one is being compiled."""
        return 2 * self.count < len(self._events)


@lru_cache(maxsize=1)
def compiled_functions() -> CompiledFunctions:
    """The functions that are compiled after the first call."""
    return CompiledFunctions()


def compiling() -> bool:
    """Whether a function is being compiled, of those since the first call; never without numba."""
    return 'numba' in sys.modules and compiled_functions().busy


def prepare(work: Callable[[], None], tell: Callable[[str], None]) -> None:
    """Does work that compiles kernels, or loads them, and reports it while it takes long.

    Args:
        work: runs them.
        tell: takes lines of text: when a kernel begins to be compiled, every `INTERVAL` s from then
            on, and at the end. It is called from another thread, too, but never at the same time.
    """
    compiled, start, ended = compiled_functions(), time.monotonic(), Event()
    before = compiled.count

    def report() -> None:
        while not compiled.busy:
            if ended.wait(_GLANCE):
                return
        tell('compiling kernels, once after an update: this takes about a minute')
        while not ended.wait(INTERVAL):
            tell(f'compiling kernels: {compiled.count - before} functions, {since(start)} so far')

    reporter = Thread(target=report, name='kernels', daemon=True)
    reporter.start()
    try:
        work()
    finally:
        ended.set()
        reporter.join()
    count = compiled.count - before
    done = f'{count} functions compiled in {since(start)}, kept in {folder_in_use()}'
    tell(done if count else f'kernels loaded in {since(start)}')


def since(start: float) -> str:
    """Time since a moment of `time.monotonic`, for a line of text."""
    return f'{time.monotonic() - start:.1f} s'
