"""Where compiled kernels are kept: by the state of all sources, and not by that of one file alone.

numba compiles a kernel anew when its own file changes. A kernel holds code of other files, too, and
names types of them: what was compiled before one of these changed must not be loaded.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

VARIABLE = 'NUMBA_CACHE_DIR'
_PREFIX = 'compiled-'
# Code of other states is kept for so long, s: a process that still runs may be using it.
KEPT = 24 * 3600.0


def keep_compiled_code_apart(package: Path) -> None:
    """Has numba keep what it compiles in a folder of this state of a package.

    The folder is in the package, or in the user's cache where that can not be written. One that
    the environment names (`NUMBA_CACHE_DIR`) is used as it is.
    """
    if os.environ.get(VARIABLE):
        return
    folder = folder_of(package)
    if not folder.is_dir():
        for other in folder.parent.glob(f'{_PREFIX}*'):
            if time.time() - other.stat().st_mtime > KEPT:
                shutil.rmtree(other, ignore_errors=True)
    os.environ[VARIABLE] = str(folder)
    if 'numba' in sys.modules:
        sys.modules['numba'].config.CACHE_DIR = str(folder)


def folder_of(package: Path) -> Path:
    """The folder for the code that is compiled from the present sources of a package."""
    state = hashlib.sha256()
    for path in sorted(package.rglob('*.py')):
        found = path.stat()
        state.update(f'{path.relative_to(package)} {found.st_size} {found.st_mtime_ns}\n'.encode())
    parent = package / '__pycache__'
    if not os.access(parent if parent.is_dir() else package, os.W_OK):
        cache = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
        own = hashlib.sha256(str(package).encode()).hexdigest()[:12]
        parent = Path(cache) / 'hmt_ros' / own
    return parent / f'{_PREFIX}{state.hexdigest()[:16]}'


def folder_in_use() -> str:
    """Where code that is compiled now is kept."""
    return os.environ.get(VARIABLE, '')


class CompiledFunctions:
    """Functions that numba compiles from now on; those that it loads are none of them."""

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
