"""Work beside a replay, in threads of its own: messages are read ahead and written behind."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, Generic, TypeVar

Item = TypeVar('Item')

# Maximum number of calls that wait, each with a message or an image.
_MOST_WAITING = 32


class ReadAhead(AbstractContextManager['ReadAhead[Item]'], Generic[Item]):
    """An iterator that makes its next item while the present one is in use.

    Iteration can go on after an error. The context manager ends the thread.

    Args:
        make: makes the next item, or raises StopIteration.
        close: is called at the end, in the thread of `make`.
    """

    def __init__(self, make: Callable[[], Item], close: Callable[[], None]) -> None:
        self._make, self._close = make, close
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix='read_ahead')
        self._next: Future[Item] = self._thread.submit(make)

    def __iter__(self) -> Iterator[Item]:
        return self

    def __next__(self) -> Item:
        made = self._next
        if not isinstance(made.exception(), StopIteration):
            self._next = self._thread.submit(self._make)
        return made.result()

    def __exit__(self, *_: object) -> None:
        self._next.cancel()
        self._thread.submit(self._close)
        self._thread.shutdown(wait=True)


class WriteBehind(AbstractContextManager['WriteBehind']):
    """Makes calls in their order while the caller goes on.

    The context manager waits for all calls at its end, or drops them on an error. An error of a
    call is raised by `check`, or at the end, and later calls are not made. `call` itself raises
    nothing, so that its caller does not take such an error for one of its own.
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
        """Makes a call once the earlier ones are done."""
        while self._waiting and (len(self._waiting) >= _MOST_WAITING or self._waiting[0].done()):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._make, function, arguments))

    def check(self) -> None:
        """Raises the error of a call, if there was one."""
        if self._error is not None:
            raise self._error

    def _make(self, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        if self._error is not None:
            return
        try:
            function(*arguments)
        except BaseException as error:  # noqa: BLE001 - `check` raises it
            self._error = error
