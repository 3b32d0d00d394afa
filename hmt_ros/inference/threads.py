"""Distribution of work among threads, for calls that release the interpreter lock.

Each item is computed independently and stored at a separate place, so results do not depend on the
number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

# Maximum number of threads.
MAX_THREADS = 8
_most = MAX_THREADS


def limit_threads(count: int) -> None:
    """Cap the number of worker threads of this process."""
    global _most
    _most = min(count, MAX_THREADS)


def in_threads(
    work: Callable[[int, int], None], count: int, least: int = 4, threads: int = 0
) -> None:
    """Distributes items among threads.

    Args:
        work: function that processes the items from a first index to an end index (exclusive).
        least: minimum number of items per thread.
        threads: maximum number of threads; 0: one per core, up to `MAX_THREADS`, with one core
            left for other processes such as a camera or a smoother.
    """
    threads = min(threads or _cores(), _most, count // least)
    if threads < 2:
        work(0, count)
        return
    ends = [count * i // threads for i in range(threads + 1)]
    jobs = [_pool().submit(work, a, b) for a, b in pairwise(ends[1:])]
    work(0, ends[1])
    for job in jobs:
        job.result()


def together(calls: Sequence[Callable[[], Any]], threads: int = 0) -> list[Any]:
    """Call functions in threads, distributed as by `in_threads`; return their results.

    Args:
        calls: functions that call neither `together` nor `in_threads`.
    """
    results: list[Any] = [None] * len(calls)

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            results[i] = calls[i]()

    in_threads(work, len(calls), 1, threads)
    return results


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MAX_THREADS, thread_name_prefix='hmt_ros')


# A forked child process inherits the pool without its threads.
os.register_at_fork(after_in_child=_pool.cache_clear)


@lru_cache(maxsize=1)
def _cores() -> int:
    return max(len(os.sched_getaffinity(0)) - 1, 1)
