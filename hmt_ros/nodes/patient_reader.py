"""Reads files named by parameters, in a separate thread for which the node waits only briefly.

A Python thread can not be stopped, so a slow reader continues in the background. Repeating the same
request later returns the result.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from threading import Thread
from typing import Any

# Maximum time that a node waits for a reader, s, and maximum fraction of time spent waiting, which
# keeps many requests from blocking the node.
MAX_WAIT, MAX_TIME_SHARE = 0.6, 0.5
_POLLING_PERIOD = 0.01


class PatientReader:
    """Executes one request to read files at a time; not thread-safe."""

    def __init__(self) -> None:
        # The present request and its result.
        self._asked: tuple[Any, Future[None]] | None = None
        # Remaining time that the node may wait, s, and the time of its last update, s.
        self._left, self._since = MAX_WAIT, time.monotonic()

    def read(self, of: Any, action: Callable[[], Any], meanwhile: Callable[[], None]) -> None:
        """Reads files.

        Args:
            of: key of the request; a repeated request has an equal key.
            action: function that reads the files.
            meanwhile: function that is called repeatedly during the wait.

        Raises:
            ValueError: this or an earlier request is still in progress (one-line message).
            Exception: raised by the action.
        """
        if self._asked is None or (self._asked[0] != of and self._asked[1].done()):
            self._asked = of, Future()
            # Not a thread pool, because the process would wait for its threads at exit.
            Thread(target=_do, args=(action, self._asked[1]), name='read', daemon=True).start()
        asked, result = self._asked
        if asked != of:
            raise ValueError('other files are still being read: ask again later')
        began = time.monotonic()
        end = began + min(self._left + MAX_TIME_SHARE * (began - self._since), MAX_WAIT)
        while not result.done() and (rest := end - time.monotonic()) > 0.0:
            wait([result], min(rest, _POLLING_PERIOD))
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
        # `Future.result` raises this error in the thread that waits.
        result.set_exception(error)
