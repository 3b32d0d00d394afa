"""Files that parameters name are read by a thread of their own, for which a node waits shortly.

A reader in Python can not be stopped. One that takes longer goes on, alone, and who asks again gets
its result.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from threading import Thread
from typing import Any

# Longest time that a node waits for a reader, s, and largest share of its time that it waits: many
# questions must not keep it from all else.
LONGEST_WAIT, SHARE = 0.6, 0.5
_GLANCE = 0.01


class PatientReader:
    """Reads for one who asks at a time; all methods are for one thread."""

    def __init__(self) -> None:
        # What is asked for, and its result.
        self._asked: tuple[Any, Future[None]] | None = None
        # Time that the node may wait, s, and when that was known.
        self._left, self._since = LONGEST_WAIT, time.monotonic()

    def read(self, of: Any, action: Callable[[], Any], meanwhile: Callable[[], None]) -> None:
        """Reads files.

        Args:
            of: what is asked for; equal to that of a question that is asked again.
            action: reads them.
            meanwhile: called while others wait.

        Raises:
            ValueError: others are being read, or these are not read yet; one line.
            Exception: of the action.
        """
        if self._asked is None or (self._asked[0] != of and self._asked[1].done()):
            self._asked = of, Future()
            # Not of a pool: the process would wait for it at its end.
            Thread(target=_do, args=(action, self._asked[1]), name='read', daemon=True).start()
        asked, result = self._asked
        if asked != of:
            raise ValueError('other files are still being read: ask again later')
        began = time.monotonic()
        end = began + min(self._left + SHARE * (began - self._since), LONGEST_WAIT)
        while not result.done() and (rest := end - time.monotonic()) > 0.0:
            wait([result], min(rest, _GLANCE))
            meanwhile()
        self._left, self._since = max(end - time.monotonic(), 0.0), began
        if not result.done():
            raise ValueError('the files are still being read: ask again later')
        self._asked = None
        result.result()


def _do(action: Callable[[], Any], result: Future[None]) -> None:
    try:
        action()
        result.set_result(None)
    except Exception as error:  # noqa: BLE001
        # Raised where the result is asked for.
        result.set_exception(error)
