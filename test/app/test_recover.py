"""recover, as a command."""

import os
import signal
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

from hmt_ros.app.recover import main
from hmt_ros.app.replay.command import main as replay
from msg_tools import BagReader, BagWriter

ROOT = Path(__file__).resolve().parents[2]
REACH = ROOT / 'bags' / 'reach'


def test_what_was_saved_and_what_was_lost(tmp_path, capsys):
    content = (REACH / 'reach.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(content[: len(content) * 9 // 10])
    assert main([str(tmp_path / 'cut.mcap'), '-o', str(tmp_path / 'out')]) == 0
    saved, lost, where = capsys.readouterr().out.splitlines()
    with BagReader(tmp_path / 'out') as bag:
        assert saved.endswith(f'out: {bag.message_count()} messages of 5 topics saved')
        assert bag.damage is None
    assert lost == 'lost: the bag does not tell how many messages'
    assert where.startswith(f'  cut.mcap breaks off after {len(content) * 9 // 10} bytes: ')
    # Nothing is overwritten.
    assert main([str(tmp_path / 'cut.mcap'), '-o', str(tmp_path / 'out')]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'exists, and nothing is overwritten' in line


def test_a_whole_bag_and_a_damaged_one(tmp_path, capsys):
    assert main([str(REACH), '-o', str(tmp_path / 'whole')]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ['lost: nothing']
    with BagReader(REACH) as one, BagReader(tmp_path / 'whole') as other:
        count = one.message_count()
        for a, b in zip(one.messages(), other.messages(), strict=True):
            assert (a.topic, a.log_time_ns, a.data) == (b.topic, b.log_time_ns, b.data)
    content = bytearray((REACH / 'reach.mcap').read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / 'damaged.mcap').write_bytes(content)
    assert main([str(tmp_path / 'damaged.mcap'), '-o', str(tmp_path / 'out')]) == 0
    saved, lost, where = capsys.readouterr().out.splitlines()
    with BagReader(tmp_path / 'out') as bag:
        topics = sum(topic.message_count > 0 for topic in bag.topics.values())
        assert saved.endswith(f'out: {bag.message_count()} messages of {topics} topics saved')
        assert lost == f'lost: {count - bag.message_count()} messages'
    assert 'is damaged in the chunk at byte' in where


def test_what_is_no_bag(tmp_path, capsys):
    (tmp_path / 'text').write_text('Dear diary')
    for broken in ('text', 'nowhere'):
        assert main([str(tmp_path / broken), '-o', str(tmp_path / 'out')]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith('recover: ')
    assert not (tmp_path / 'out').exists()


def test_a_replay_that_was_killed(tmp_path, capsys):
    """What was tracked until then can be looked at."""
    target = tmp_path / 'out'
    with BagReader(REACH) as bag, BagWriter(tmp_path / 'reach') as short:
        for stored in islice(bag.messages(['image/compressed', 'camera_info']), 100):
            short.write(stored.topic, stored.log_time_ns, stored.message)
    person = ['--subject', str(REACH / 'subject.yaml')]
    person += ['--background', str(REACH / 'background.png')]
    fast = ['--set', 'max_hypotheses=2', '--set', 'evaluation_budget=100']
    command = [str(tmp_path / 'reach'), '-o', str(target), *person, *fast, '--no-smoother']
    with subprocess.Popen(
        [sys.executable, '-m', 'hmt_ros', 'replay', *command],
        cwd=ROOT,
        stderr=subprocess.PIPE,
    ) as process:
        size = 0
        # The first chunk is there, of 669 kB.
        while size < 700_000 and process.poll() is None:
            time.sleep(0.02)
            size = sum(file.stat().st_size for file in tmp_path.glob('.out.*.partial/out.mcap'))
        os.kill(process.pid, signal.SIGKILL)
    assert not target.exists()
    assert main([str(target), '-o', str(tmp_path / 'recovered')]) == 0
    assert capsys.readouterr().out.startswith(f'{tmp_path / "recovered"}: ')
    assert replay([*command, '--quiet']) == 0
    with BagReader(tmp_path / 'recovered') as saved, BagReader(target) as whole:
        found = [(m.topic, m.log_time_ns, bytes(m.data)) for m in saved.messages()]
        wanted = [(m.topic, m.log_time_ns, bytes(m.data)) for m in whole.messages()]
    assert len(found) >= 10
    assert found == wanted[: len(found)]
