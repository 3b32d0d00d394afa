"""Work divided among threads."""

import threading
import time
from functools import partial

import numpy as np
import pytest

from hmt_ros.inference.threads import MAX_THREADS, in_threads, limit_threads, together


@pytest.mark.parametrize('threads', [1, 2, 5])
@pytest.mark.parametrize('count', [0, 1, 3, 40])
def test_every_pose_is_worked_on_once(count, threads):
    seen = np.zeros(count, dtype=int)

    def work(first, last):
        seen[first:last] += 1

    in_threads(work, count, 2, threads)
    assert (seen == 1).all()


def test_few_poses_are_not_worth_a_thread():
    parts = []
    in_threads(lambda first, last: parts.append((first, last)), 7, 4, 8)
    assert parts == [(0, 7)]


@pytest.mark.parametrize('threads', [1, 2, 5])
def test_results_stay_in_their_place(threads):
    def late(value):
        time.sleep(0.01 * (3 - value))
        return value

    assert together([partial(late, i) for i in range(4)], threads) == [0, 1, 2, 3]
    assert together([], threads) == []


@pytest.mark.parametrize('threads', [1, 2, 3])
def test_calls_use_no_more_threads_than_they_may(threads):
    def working():
        time.sleep(0.01)
        return threading.get_ident()

    assert len(set(together(6 * [working], threads))) <= threads


def test_one_thread_is_the_callers_own():
    assert set(together(3 * [threading.get_ident], 1)) == {threading.get_ident()}


@pytest.mark.parametrize('threads', [1, 2])
@pytest.mark.parametrize('at', [0, 1])
def test_errors_reach_the_caller(at, threads):
    def fail():
        raise ValueError('seen')

    calls = [lambda: 1, lambda: 1]
    calls[at] = fail
    with pytest.raises(ValueError, match='seen'):
        together(calls, threads)


def test_a_process_can_be_limited():
    parts = []
    limit_threads(1)
    try:
        in_threads(lambda first, last: parts.append((first, last)), 40, 2, 4)
        own = set(together(3 * [threading.get_ident], 4))
    finally:
        limit_threads(MAX_THREADS)
    assert parts == [(0, 40)]
    assert own == {threading.get_ident()}
