"""Merging streams by time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from msg_tools.bags.contents import Source, Timed, merge


def test_merge_sorts_by_time_then_source_then_position() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        streams = [
            [
                (int(t), (s, i))
                for i, t in enumerate(np.sort(rng.integers(0, 20, rng.integers(0, 9))))
            ]
            for s in range(6)
        ]
        sources = [
            Source(stream[0][0] if stream else 0, s, lambda stream=stream: iter(stream))
            for s, stream in enumerate(streams)
        ]
        rng.shuffle(sources)
        merged = list(merge(sources))
        assert merged == sorted(item for stream in streams for item in stream)


def test_merge_opens_a_source_only_when_its_time_has_come() -> None:
    opened = []

    def stream(key: int) -> Iterator[Timed]:
        opened.append(key)
        yield 10 * key, key
        yield 10 * key + 5, key

    merged = merge(Source(10 * key, key, lambda key=key: stream(key)) for key in range(5))
    for step in range(10):
        next(merged)
        assert opened == list(range(step // 2 + 1))


def test_an_item_comes_before_a_later_source_of_the_same_time_is_opened() -> None:
    def broken() -> Iterator[Timed]:
        raise RuntimeError
        yield

    merged = merge([Source(0, 0, lambda: iter([(0, 'a'), (5, 'b')])), Source(5, 1, broken)])
    assert [next(merged)[1] for _ in range(2)] == ['a', 'b']
