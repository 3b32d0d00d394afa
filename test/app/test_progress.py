"""Progress of commands: a bar on a terminal, lines elsewhere; stdout has only results."""

import os
import select
import sys
import time

import pytest

from hmt_learning.app import make_bag
from hmt_ros.app import progress
from hmt_ros.app.progress import INTERVAL, notify_user, show_progress, with_progress


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(progress, 'INTERVAL', 0.05)


def wait_for(capsys, text):
    """What is printed on stderr until a text appears."""
    printed, end = '', time.monotonic() + 20
    while text not in printed:
        assert time.monotonic() < end, printed
        time.sleep(0.01)
        printed += capsys.readouterr().err
    return printed


@pytest.mark.usefixtures('often')
def test_a_line_every_interval(capsys):
    with show_progress('out', 'images', 120) as shown:
        wait_for(capsys, 'out:   0% 0/120 [00:00<?')  # shows that the command works
        shown.update(60)
        notify_user('replay', 'a line between')
        assert 'replay: a line between\n' in wait_for(capsys, 'out:  50% 60/120 [')
        shown.update(60)
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith('out: 100% 120/120 [00:0')
    assert not any('\r' in line for line in lines)


def test_the_lines_count_the_items(capsys, often):
    for _ in with_progress(range(3), 'reading', 'files', 3):
        time.sleep(0.12)
    lines = capsys.readouterr().err.splitlines()
    assert any('1/3' in line for line in lines)
    assert '3/3' in lines[-1]


@pytest.mark.parametrize('columns', [100, 0])
def test_bar_on_a_terminal_that_has_room(monkeypatch, columns):
    monkeypatch.setattr(progress, 'INTERVAL', 1e-2)
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
    assert ('|' in shown) == (columns > 0)
    assert ('reading: 100% 3/3 [00:00<00:00, ' in shown) == (columns == 0)


def test_commands_without_a_terminal(tmp_path, capsys, monkeypatch):
    """Progress goes to stderr in lines, results go to stdout."""
    monkeypatch.setattr(progress, 'INTERVAL', 1e-3)
    small = ['--duration', '0.5', '--size', '160x120']
    assert make_bag.main(['reach', '-o', str(tmp_path / 'reach'), *small]) == 0
    streams = capsys.readouterr()
    assert 'reach: ' in streams.err
    assert '/15 [' in streams.err
    assert 'progress' not in streams.out
    assert INTERVAL >= 3
