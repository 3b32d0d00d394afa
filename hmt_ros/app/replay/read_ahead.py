"""Items that are made in a thread of their own, one ahead of the one that is in use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Generic, TypeVar

Item = TypeVar('Item')


class ReadAhead(AbstractContextManager['ReadAhead[Item]'], Generic[Item]):
    """An iterator whose next item is made meanwhile; a context manager, which ends the thread.

    After an error it may be asked for the next item, as whoever makes them can be.

    Args:
        make: makes the next item; StopIteration when there is none.
        close: what is to be called at the end, in the thread of `make`.
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
