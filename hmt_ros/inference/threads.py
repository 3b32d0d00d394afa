"""Work shared among threads, in calls that release the interpreter lock, with the same results.

Each piece is worked on alone and stays in its place, so that nothing depends on their number.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

# Threads at most, however many cores there are.
MOST_THREADS = 8
_most = MOST_THREADS


def limit_threads(count: int) -> None:
    """Shares nothing among more threads than this in this process, whatever is asked for."""
    global _most
    _most = min(count, MOST_THREADS)


def in_threads(
    work: Callable[[int, int], None], count: int, least: int = 4, threads: int = 0
) -> None:
    """Shares poses among threads.

    Args:
        work: on the poses from one number up to another.
        least: number of poses that are worth a thread.
        threads: their number at most; 0: one a core, up to `MOST_THREADS`, but for one core that is
            left to a camera, a smoother and subscribers.
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
    """Results of some calls, shared among threads as poses are.

    Args:
        calls: none of which calls this or `in_threads`.
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


# A child of fork has the pool, but none of its threads.
os.register_at_fork(after_in_child=_pool.cache_clear)


@lru_cache(maxsize=1)
def _cores() -> int:
    return max(len(os.sched_getaffinity(0)) - 1, 1)
