"""Queues of the estimating thread and their order, without ROS."""

import threading
import time
from collections import Counter
from types import SimpleNamespace

import pytest

from hmt_ros.nodes import estimating_thread
from hmt_ros.nodes.estimating_thread import (
    MAX_SHARED_IMAGES,
    Arrived,
    EstimatingThreads,
    Estimator,
    InputQueue,
    Waiting,
    received,
)
from hmt_ros.nodes.subscribed_topic import image_topic
from msg_tools.messages.cdr import serialise
from msg_tools.messages.images import ImageError

PATIENCE = 20.0  # s


def put(queue, *items):
    for source, content in items:
        queue.put(Waiting(source, content, 0.0, content if source == 'image' else 0))


def contents(arrived):
    return [waiting.content for waiting in arrived.waiting]


def test_oldest_images_are_dropped_and_counted():
    queue = InputQueue({'image': 2, 'info': 1}, counted='image')
    for i in range(5):
        put(queue, ('image', i), ('info', i))
    assert len(queue) == 3
    arrived = queue.take()
    assert contents(arrived) == [3, 4, 4]
    assert (arrived.dropped, arrived.stamps_ns) == (3, (0, 1, 2))
    queue.limit('image', 1)
    put(queue, ('image', 5), ('image', 6))
    arrived = queue.take()
    assert (contents(arrived), arrived.dropped, arrived.stamps_ns) == ([6], 1, (5,))


def test_each_source_of_a_kind_has_its_own_limit():
    queue = InputQueue({'mixture': 1}, counted='mixture')
    put(queue, ('mixture of /a', 1), ('mixture of /b', 2), ('mixture of /a', 3), ('image', 4))
    arrived = queue.take()
    assert (contents(arrived), arrived.dropped) == ([2, 3, 4], 1)


def test_closing_returns_what_waited():
    queue = InputQueue({'image': 1}, counted='image')
    put(queue, ('restart', 'a'), ('image', 1), ('image', 2))
    left = queue.close()
    assert (contents(left), left.dropped, left.stamps_ns) == (['a', 2], 1, (1,))
    assert queue.close() == Arrived(())
    put(queue, ('image', 3))
    assert len(queue) == 0


def test_some_of_what_waits_is_taken():
    queue = InputQueue({'image': 2}, counted='image')
    put(queue, ('image', 1), ('info', 2), ('image', 3), ('image', 4))
    assert contents(queue.take(1)) == [2]
    assert contents(queue.take(1)) == [3]
    put(queue, ('image', 5), ('image', 6))
    arrived = queue.take(5)
    assert (contents(arrived), arrived.dropped) == ([5, 6], 1)


class Busy:
    """Stub sessions that record their turns and take some time."""

    def __init__(self):
        self.turns, self.may_go = [], threading.Semaphore(0)
        self.threads = EstimatingThreads()
        self.told = []

    def session(self, name):
        def take(source, message, *, more):
            self.turns.append((name, message))
            assert self.may_go.acquire(timeout=PATIENCE)

        state = SimpleNamespace(counts=Counter(), status='', faults={})
        return SimpleNamespace(
            COUNTED='image', DONE='done', most_waiting=9, publishing=0.0, state=state, take=take,
            count_dropped=lambda number: self.told.append((name, number)),
        )  # fmt: skip

    def serve(self, name, place, *, later=False):
        return Estimator(
            self.session(name), self.threads.later if later else self.threads.poses, place=place,
            report=lambda handled: None, report_change=lambda: None, report_error=pytest.fail,
        )  # fmt: skip

    def until(self, *turns):
        end = time.monotonic() + PATIENCE
        while len(self.turns) < len(turns):
            assert time.monotonic() < end, self.turns
            time.sleep(0.002)
        assert self.turns == list(turns)

    def go(self):
        self.may_go.release()


def send(estimator, content):
    estimator.queue.put(Waiting('image', lambda: content, time.monotonic()))


@pytest.fixture
def busy():
    one = Busy()
    yield one
    for _ in range(100):
        one.go()


def test_turns_go_round_and_what_can_wait_waits(busy, monkeypatch):
    monkeypatch.setattr(estimating_thread, 'MAX_WAIT', PATIENCE)
    later = busy.serve('later', 0, later=True)
    second, first = busy.serve('second', 2), busy.serve('first', 1)
    send(first, 1)
    busy.until(('first', 1))
    for content in (2, 3):
        send(later, content)
    send(second, 1)
    send(first, 2)
    seen = [('first', 1), ('second', 1), ('first', 2), ('later', 2)]
    for count in (2, 3, 4):
        busy.go()
        busy.until(*seen[:count])
    # One message per turn, because an image may have arrived.
    send(second, 4)
    busy.until(*seen, ('second', 4))
    busy.go()
    busy.go()
    busy.until(*seen, ('second', 4), ('later', 3))


def test_what_can_wait_does_not_wait_for_ever(busy, monkeypatch):
    monkeypatch.setattr(estimating_thread, 'MAX_WAIT', 0.05)
    pose, later = busy.serve('pose', 0), busy.serve('later', 1, later=True)
    send(pose, 1)
    busy.until(('pose', 1))
    send(pose, 2)
    send(later, 1)
    busy.until(('pose', 1), ('later', 1))


def test_who_stops_has_no_more_turns_and_the_others_go_on(busy):
    one, other = busy.serve('one', 0), busy.serve('other', 1)
    send(one, 1)
    busy.until(('one', 1))
    send(one, 2)
    assert not one.stop(0.01)
    send(one, 3)
    busy.go()
    assert one.stop(PATIENCE)
    assert busy.told == [('one', 0), ('one', 0)]
    send(other, 1)
    busy.until(('one', 1), ('other', 1))
    busy.go()
    assert other.stop(PATIENCE)
    # The thread has ended; it restarts for the next message.
    again = busy.serve('again', 0)
    send(again, 1)
    busy.until(('one', 1), ('other', 1), ('again', 1))


def test_a_picture_is_decoded_once(small_camera):
    one, other = EstimatingThreads(), EstimatingThreads()
    message = small_camera.image(1)
    picture = one.decode(message)
    assert one.decode(message) is picture
    assert other.decode(message) is not picture
    # Later messages take its place.
    for index in range(MAX_SHARED_IMAGES):
        one.decode(small_camera.image(index))
    assert one.decode(message) is not picture
    broken = small_camera.image(0)
    broken.encoding = 'infrared'
    with pytest.raises(ImageError, match='infrared'):
        one.decode(broken)


def test_bytes_are_read_once_by_whoever_wants_them(small_camera):
    image = small_camera.image(1)
    waiting = received(serialise(image), image_topic('raw'))
    assert waiting.stamp_ns == small_camera.stamp(1)
    assert waiting.content() is waiting.content()
    assert waiting.content().header.stamp == image.header.stamp
