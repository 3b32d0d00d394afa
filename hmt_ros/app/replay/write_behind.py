"""Calls that are made in a thread of their own, in their order, while the caller goes on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

# So many calls may wait; a message or a picture each.
_MOST_WAITING = 32


class WriteBehind(AbstractContextManager['WriteBehind']):
    """A context manager, which waits for all calls at its end, or drops them on an error.

    What a call raises is raised by `check`, or at the end; those behind it are not made. `call`
    itself raises nothing: who calls it may take an error for one of what it works on.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix='write_behind')
        self._waiting: deque[Future[None]] = deque()
        self._error: BaseException | None = None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=kind is not None)
        if kind is None:
            self.check()

    def call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Makes a call when those before are done."""
        while self._waiting and (len(self._waiting) >= _MOST_WAITING or self._waiting[0].done()):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._make, function, arguments))

    def check(self) -> None:
        """Raises what a call has raised."""
        if self._error is not None:
            raise self._error

    def _make(self, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        if self._error is not None:
            return
        try:
            function(*arguments)
        except BaseException as error:  # noqa: BLE001 - told where it belongs
            self._error = error
