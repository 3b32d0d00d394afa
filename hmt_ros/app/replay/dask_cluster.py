"""Work that goes through Dask: to a scheduler, or to processes on this machine."""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

from msg_tools.files.error_line import error_line

LOCAL = 'local'
_PATIENCE = 10.0  # s, until a scheduler answers


def through_dask(
    work: Callable[[Any], Any], jobs: Sequence[Any], scheduler: str
) -> Iterator[tuple[Any, Any]]:
    """(job, what came of it) in the order in which they are done; of what failed a line of text.

    Args:
        work: a function of a module, which the workers import.
        jobs: its arguments.
        scheduler: address, or `LOCAL`: one process for each core of this machine.

    Raises:
        ValueError: Dask is not installed, or nobody answers.
    """
    try:
        distributed: Any = importlib.import_module('distributed')
    except ImportError as error:
        raise ValueError(
            f'--scheduler wants Dask, which is not there ({error_line(error)}): '
            '`pip install distributed`, or leave --scheduler out'
        ) from error
    with ExitStack() as opened:
        try:
            if scheduler == LOCAL:
                cluster = distributed.LocalCluster(
                    n_workers=max(1, min(len(jobs), len(os.sched_getaffinity(0)))),
                    threads_per_worker=1,
                    processes=True,
                    host='127.0.0.1',
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
                scheduler = opened.enter_context(cluster)
            client = opened.enter_context(distributed.Client(scheduler, timeout=_PATIENCE))
        except (OSError, ValueError, RuntimeError) as error:
            raise ValueError(f'--scheduler {scheduler}: {error_line(error)}') from error
        job_of = {client.submit(work, job, pure=False): job for job in jobs}
        for future in distributed.as_completed(job_of):
            fault = future.exception()
            if fault is None:
                yield job_of[future], future.result()
            else:
                yield job_of[future], f'{type(fault).__name__}: {error_line(fault)}'
