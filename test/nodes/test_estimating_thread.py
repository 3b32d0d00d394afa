import threading

from hmt_ros.nodes.estimating_thread import Arrived, InputQueue, Waiting


def put(queue, *items):
    for source, content in items:
        queue.put(Waiting(source, content, 0.0, content if source == 'image' else 0))


def contents(arrived):
    return [waiting.content for waiting in arrived.waiting]


def test_first_in_first_out():
    queue = InputQueue({'image': 2}, counted='image')
    waiting = [Waiting('info', 'a', 1.0), Waiting('image', 'b', 2.0, 7), Waiting('info', 'c', 3.0)]
    for one in waiting:
        queue.put(one)
    assert len(queue) == 3
    assert queue.get() == Arrived(tuple(waiting))
    assert len(queue) == 0


def test_oldest_images_are_dropped_and_counted():
    queue = InputQueue({'image': 2, 'info': 1}, counted='image')
    for i in range(5):
        put(queue, ('image', i), ('info', i))
    assert len(queue) == 3
    arrived = queue.get()
    assert contents(arrived) == [3, 4, 4]
    assert (arrived.dropped, arrived.stamps_ns) == (3, (0, 1, 2))
    queue.limit('image', 1)
    put(queue, ('image', 5), ('image', 6))
    arrived = queue.get()
    assert (contents(arrived), arrived.dropped, arrived.stamps_ns) == ([6], 1, (5,))


def test_each_source_of_a_kind_has_its_own_limit():
    queue = InputQueue({'mixture': 1}, counted='mixture')
    put(queue, ('mixture of /a', 1), ('mixture of /b', 2), ('mixture of /a', 3), ('image', 4))
    arrived = queue.get()
    assert (contents(arrived), arrived.dropped) == ([2, 3, 4], 1)


def test_never_grows():
    queue = InputQueue({'image': 3}, counted='image')
    put(queue, *(('image', i) for i in range(10_000)))
    assert len(queue) == 3
    arrived = queue.get()
    assert (contents(arrived), arrived.dropped) == ([9997, 9998, 9999], 9997)
    assert arrived.stamps_ns == tuple(range(9897, 9997))


def test_closing_ends_who_waits():
    queue = InputQueue({}, counted='image')
    found = []
    thread = threading.Thread(target=lambda: found.append(queue.get()))
    thread.start()
    queue.close()
    thread.join(10)
    assert found == [None]
    put(queue, ('image', 1))
    assert len(queue) == 0
    assert queue.get() is None


def test_closing_returns_what_waited():
    queue = InputQueue({'image': 1}, counted='image')
    put(queue, ('restart', 'a'), ('image', 1), ('image', 2))
    left = queue.close()
    assert (contents(left), left.dropped, left.stamps_ns) == (['a', 2], 1, (1,))
    assert queue.close() == Arrived(())
