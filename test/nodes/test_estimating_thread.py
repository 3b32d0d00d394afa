import threading

from hmt_ros.nodes.estimating_thread import InputQueue, Waiting


def test_first_in_first_out():
    queue = InputQueue({'image': 2}, counted='image')
    queue.put('info', 'a', 1.0)
    queue.put('image', 'b', 2.0)
    queue.put('info', 'c', 3.0)
    assert len(queue) == 3
    assert queue.get() == Waiting('info', 'a', 1.0, 0)
    assert queue.get() == Waiting('image', 'b', 2.0, 0)
    assert queue.get() == Waiting('info', 'c', 3.0, 0)


def test_oldest_images_are_dropped_and_counted():
    queue = InputQueue({'image': 2, 'info': 1}, counted='image')
    for i in range(5):
        queue.put('image', i, 0.0)
        queue.put('info', i, 0.0)
    assert len(queue) == 3
    assert [queue.get()[1:] for _ in range(3)] == [(3, 0.0, 3), (4, 0.0, 0), (4, 0.0, 0)]
    queue.limit('image', 1)
    queue.put('image', 5, 0.0)
    queue.put('image', 6, 0.0)
    assert queue.get() == Waiting('image', 6, 0.0, 1)


def test_never_grows():
    queue = InputQueue({'image': 3}, counted='image')
    for i in range(10_000):
        queue.put('image', i, 0.0)
    assert len(queue) == 3
    assert queue.get() == Waiting('image', 9997, 0.0, 9997)


def test_closing_ends_who_waits():
    queue = InputQueue({}, counted='image')
    found = []
    thread = threading.Thread(target=lambda: found.append(queue.get()))
    thread.start()
    queue.close()
    thread.join(10)
    assert found == [None]
    queue.put('image', 1, 0.0)
    assert len(queue) == 0
    assert queue.get() is None


def test_closing_returns_what_waited():
    queue = InputQueue({'image': 1}, counted='image')
    queue.put('restart', 'a', 1.0)
    queue.put('image', 'b', 2.0)
    queue.put('image', 'c', 3.0)
    assert queue.close() == [Waiting('restart', 'a', 1.0, 1), Waiting('image', 'c', 3.0, 0)]
    assert queue.close() == []
