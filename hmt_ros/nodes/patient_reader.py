"""Files that parameters name are read by a thread of their own, for which a node waits shortly.

A reader in Python can not be stopped. One that takes longer goes on, alone, and who asks again gets
its result.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

# Longest time that a node waits for a reader, s, and largest share of its time that it waits: many
# questions must not keep it from all else.
LONGEST_WAIT, SHARE = 0.6, 0.5
_GLANCE = 0.01


class PatientReader:
    """Reads for one who asks at a time; all methods are for one thread."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._of: Any = None
        self._error: Exception | None = None
        # Time that the node may wait, s, and when that was known.
        self._left, self._since = LONGEST_WAIT, time.monotonic()

    def read(self, of: Any, action: Callable[[], Any], meanwhile: Callable[[], None]) -> None:
        """Reads files.

        Args:
            of: what is asked for; equal to that of a question before which it repeats.
            action: reads them.
            meanwhile: called while others wait.

        Raises:
            ValueError: others are being read, or these are not read yet; one line.
            Exception: of the action.
        """
        if self._thread is None or (self._of != of and not self._thread.is_alive()):
            self._of = of
            self._thread = threading.Thread(
                target=self._do, args=(action,), name='read files', daemon=True
            )
            self._thread.start()
        elif self._of != of:
            raise ValueError('other files are still being read: ask again later')
        began = time.monotonic()
        left = min(self._left + SHARE * (began - self._since), LONGEST_WAIT)
        while self._thread.is_alive() and (rest := began + left - time.monotonic()) > 0.0:
            self._thread.join(min(rest, _GLANCE))
            meanwhile()
        self._left, self._since = max(began + left - time.monotonic(), 0.0), began
        if self._thread.is_alive():
            raise ValueError('the files are still being read: ask again later')
        self._thread, error = None, self._error
        if error is not None:
            raise error

    def _do(self, action: Callable[[], Any]) -> None:
        self._error = None
        try:
            action()
        except Exception as error:  # noqa: BLE001
            # Raised where the result is asked for.
            self._error = error
