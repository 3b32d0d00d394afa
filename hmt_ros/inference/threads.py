"""Work shared among threads, in calls that release the interpreter lock, with unchanged results.

Each piece is computed independently and keeps its place, so results do not depend on the number of
threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

# Maximum number of threads, for any number of cores.
MOST_THREADS = 8
_most = MOST_THREADS


def limit_threads(count: int) -> None:
    """Cap the number of worker threads of this process."""
    global _most
    _most = min(count, MOST_THREADS)


def in_threads(
    work: Callable[[int, int], None], count: int, least: int = 4, threads: int = 0
) -> None:
    """Shares poses among threads.

    Args:
        work: on the poses from one number up to another.
        least: minimum number of poses per thread.
        threads: maximum number of threads; 0: one per core, up to `MOST_THREADS`, with one core
            left for a camera, a smoother and subscribers.
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
    """Return the results of calls, shared among threads as in `in_threads`.

    Args:
        calls: functions that call neither this nor `in_threads`.
    """
    results: list[Any] = [None] * len(calls)

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            results[i] = calls[i]()

    in_threads(work, len(calls), 1, threads)
    return results


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MOST_THREADS, thread_name_prefix='hmt_ros')


# A forked child inherits the pool, but none of its threads.
os.register_at_fork(after_in_child=_pool.cache_clear)


@lru_cache(maxsize=1)
def _cores() -> int:
    return max(len(os.sched_getaffinity(0)) - 1, 1)
