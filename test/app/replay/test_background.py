"""Background threads of a replay keep order and errors, and none is left running."""

import threading

import pytest

from hmt_ros.app.replay.one_bag import ReadAhead, WriteBehind


def made(items):
    """Yields the items, and raises those that are errors."""
    for item in items:
        if isinstance(item, Exception):
            raise item
        yield item


def test_items_come_in_their_order_and_errors_in_their_place():
    sources = [iter(range(5)), made([5, 6, ValueError('seven')]), iter([8])]
    threads, closed = set(), []

    def make():
        threads.add(threading.current_thread().name)
        item = next(sources[0], None)
        while item is None and sources[1:]:
            sources.pop(0)
            item = next(sources[0], None)
        if item is None:
            raise StopIteration
        return item

    def close():
        closed.append(threading.current_thread().name)

    with ReadAhead(make, close) as ahead:
        assert [next(ahead) for _ in range(7)] == list(range(7))
        with pytest.raises(ValueError, match='seven'):
            next(ahead)
        assert list(ahead) == [8]
        assert list(ahead) == []
    assert set(closed) == threads
    assert threads.isdisjoint({threading.current_thread().name})
    assert not [t for t in threading.enumerate() if t.name.startswith('read_ahead')]


def test_calls_are_made_in_their_order():
    found = []
    with WriteBehind() as behind:
        for i in range(1000):
            behind.call(found.append, i)
    assert found == list(range(1000))
    assert not [t for t in threading.enumerate() if t.name.startswith('write_behind')]


def test_an_error_ends_the_calls():
    found = []

    def write(i):
        if i == 50:
            raise OSError(28, 'No space left on device')
        found.append(i)

    def write_all(count):
        with WriteBehind() as behind:
            for i in range(count):
                behind.call(write, i)
            if count > 51:
                behind.check()
                raise AssertionError('an error is told within 32 calls')

    for count in (51, 1000):
        found.clear()
        with pytest.raises(OSError, match='No space left'):
            write_all(count)
        assert found == list(range(50))
