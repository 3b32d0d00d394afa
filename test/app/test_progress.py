"""Progress of commands: a bar on a terminal, lines elsewhere, stdout left to results."""

import io
import os
import queue
import select
import sys
import threading
import time

import pytest

from hmt_learning.app import make_bag
from hmt_ros.app import progress, recover
from hmt_ros.app.progress import INTERVAL, ProgressLines, show_progress, with_progress


class Clock:
    """A clock that a test sets, which is also the event that wakes the thread of the lines.

    Attributes:
        printed: file of the lines.
    """

    def __init__(self):
        self.now, self.waits, self.printed = 0.0, [], io.StringIO()
        self._asked, self._answers = queue.Queue(), queue.Queue()

    def __call__(self):
        return self.now

    def wait(self, seconds):
        self.waits.append(seconds)
        self._asked.put(None)
        return self._answers.get()

    def set(self):
        self._answers.put(True)

    def pass_to(self, now):
        """Lets the wait end at a time, and returns when its line is printed."""
        self._asked.get(timeout=10)
        self.now = now
        self._answers.put(False)
        self._asked.get(timeout=10)
        self._asked.put(None)


@pytest.fixture
def clock():
    return Clock()


def lines(clock, unit='images', total=120):
    return ProgressLines('out', unit, total, file=clock.printed, clock=clock, ended=clock)


def test_a_line_every_ten_seconds(clock, monkeypatch):
    monkeypatch.setattr(progress, 'INTERVAL', 10.0)
    shown = lines(clock)
    with shown:
        clock.pass_to(10.0)  # nothing is done yet, which shows that the command works
        shown.update(40)
        clock.pass_to(20.0)
        shown.update()
        clock.pass_to(82.0)
        shown.update(79)
        clock.now = 90.0
    assert clock.printed.getvalue().splitlines() == [
        'out: 0 of 120 images, 00:10 so far',
        'out: 40 of 120 images, 2 a second, 00:40 left',
        'out: 41 of 120 images, 0.5 a second, 02:38 left',
        'out: 120 images in 01:30',
    ]
    assert set(clock.waits) == {10.0}


def test_without_a_total_or_anything_to_count(clock):
    shown = lines(clock, 'messages', None)
    shown.update(3)
    clock.now = 6.0
    assert shown.line() == '3 messages, 0.5 a second, 00:06 so far'
    shown.total = 2_000_000
    assert shown.line().startswith('3 of 2000000 messages, ')
    shown.total = 2  # fewer than there were: not believed
    assert shown.line() == '3 messages, 0.5 a second, 00:06 so far'
    assert lines(clock, '').line() == '00:00 so far'


def test_a_short_command_prints_nothing(clock):
    shown = lines(clock)
    with shown:
        shown.update(120)
    assert clock.printed.getvalue() == ''


def test_an_error_ends_the_lines(clock):
    """The line about the error is the last."""
    shown, running = lines(clock), threading.active_count()

    def work():
        clock.pass_to(10.0)
        raise ValueError('bad')

    with pytest.raises(ValueError, match='bad'), shown:
        work()
    assert threading.active_count() == running
    assert clock.printed.getvalue() == 'out: 0 of 120 images, 00:10 so far\n'


@pytest.mark.parametrize('columns', [100, 0])
def test_bar_on_a_terminal_that_has_room(monkeypatch, columns):
    monkeypatch.setattr(progress, 'INTERVAL', 1e-3)
    monkeypatch.setattr(os, 'get_terminal_size', lambda _: os.terminal_size((columns, 24)))
    reading, writing = os.openpty()
    with os.fdopen(writing, 'w', encoding='utf-8') as terminal:
        monkeypatch.setattr(sys, 'stderr', terminal)
        items = [time.sleep(0.02) or x for x in with_progress('abc', 'reading', 'motions', 3)]
        shown = ''
        while select.select([reading], [], [], 0)[0]:
            shown += os.read(reading, 65536).decode()
    os.close(reading)
    assert items == ['a', 'b', 'c']
    assert ('reading: 100%' in shown) == (columns > 0)
    assert ('reading: 3 motions in 00:00' in shown) == (columns == 0)


def test_quiet_shows_nothing(capsys, monkeypatch):
    monkeypatch.setattr(progress, 'INTERVAL', 1e-3)
    with show_progress('out', 'images', 2, quiet=True) as shown:
        shown.update(2)
    assert capsys.readouterr() == ('', '')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags') / 'walk'
    small = ['--duration', '0.3', '--fps', '10', '--size', '96x72', '--quiet']
    assert make_bag.main(['walk', '-o', str(folder), *small]) == 0
    return folder


def test_commands_without_a_terminal(bag, tmp_path, capsys, monkeypatch):
    """Lines on stderr, results on stdout."""
    monkeypatch.setattr(progress, 'INTERVAL', 1e-3)
    small = ['--duration', '0.5', '--size', '160x120']
    assert make_bag.main(['reach', '-o', str(tmp_path / 'reach'), *small]) == 0
    streams = capsys.readouterr()
    assert 'reach: ' in streams.err
    assert ' of 15 images' in streams.err
    assert recover.main([str(bag), '-o', str(tmp_path / 'saved')]) == 0
    streams = capsys.readouterr()
    assert f'{tmp_path / "saved"}: 11 messages in 00:00' in streams.err
    assert streams.out.splitlines()[-1] == 'lost: nothing'
    assert INTERVAL >= 3
