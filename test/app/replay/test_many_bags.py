"""replay of many bags: skipped bags, repeated bags, and the same bytes through Dask."""

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest

from hmt_learning.app.make_bag import main as make_bag
from hmt_ros.app.replay import many_bags
from hmt_ros.app.replay.command import main
from msg_tools import BagReader

TINY = ['--fps', '10', '--size', '240x180', '--fov', '40']
FAST = ['--set', 'max_hypotheses=2', '--set', 'evaluation_budget=100']
FAST += ['--no-smoother']
PERSON = ['--subject', '{bag}/subject.yaml', '--background', '{bag}/background.png', *FAST]


@pytest.fixture(scope='module')
def archive(tmp_path_factory):
    """Two bags of two images, at different depths."""
    folder = tmp_path_factory.mktemp('archive')
    assert make_bag(['reach', '-o', str(folder / 'a'), '--duration', '0.2', *TINY]) == 0
    assert make_bag(['walk', '-o', str(folder / 'day' / 'b'), '--duration', '0.2', *TINY]) == 0
    return folder


@pytest.fixture(scope='module')
def tracked(archive, tmp_path_factory):
    """Folder of the new bags, made one after the other, without output."""
    out, said = tmp_path_factory.mktemp('out') / 'tracked', io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        assert main([str(archive), '-o', str(out), '--quiet', *PERSON]) == 0
    assert said.getvalue() == ''
    return out


def content(folder):
    """Bytes of all bags in a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob('*'))
        if path.suffix in ('.mcap', '.yaml')
    }


def test_every_bag_gets_one_of_its_name(archive, tracked, tmp_path):
    assert sorted(path.name for path in tracked.iterdir()) == ['a', 'a.replay.json', 'day']
    for name in ('a', 'day/b'):
        with BagReader(tracked / name) as bag:
            assert bag.topics['/pose_mixture'].message_count == 2
        record = json.loads((tracked / f'{name}.replay.json').read_text())
        assert record['done'] is True
        assert (record['images'], record['tracked']) == (2, 2)
        assert record['made_from']['parameters']['filter']['subject_file'].startswith('sha256:')
    # The same as a single replay.
    alone = [str(archive / 'a'), '-o', str(tmp_path / 'a'), '--quiet', *PERSON]
    assert main(alone) == 0
    assert (tmp_path / 'a' / 'a.mcap').read_bytes() == (tracked / 'a' / 'a.mcap').read_bytes()


def test_bags_that_are_done_are_skipped(archive, tracked, monkeypatch, capsys):
    def never(source, target, options, notify, **shown):
        raise AssertionError

    before = {path: path.stat().st_mtime_ns for path in tracked.rglob('*')}
    monkeypatch.setattr(many_bags, 'replay_bag', never)
    # Listing the bags gives the same results.
    one_by_one = [str(archive / 'a'), str(archive / 'day')]
    assert main([str(archive), '-o', str(tracked), *PERSON]) == 0
    assert capsys.readouterr().out.splitlines() == [
        'a: done before',
        'day/b: done before',
        f'{tracked}: 0 replayed, 2 done before, 0 failed',
    ]
    assert {path: path.stat().st_mtime_ns for path in tracked.rglob('*')} == before
    # With other parameters they differ, and are not replaced without --overwrite.
    assert main([*one_by_one, '-o', str(tracked), *PERSON, '--seed', '1', '--quiet']) == 1
    streams = capsys.readouterr()
    assert streams.out == ''
    failed, other = streams.err.splitlines()
    assert failed.startswith('replay: a: ')
    assert 'made from other input or with other parameters' in failed
    # In `day` this one is b.
    assert other == 'replay: b: AssertionError: AssertionError'
    (tracked / 'b.replay.json').unlink()


def test_what_was_left_half_done_is_done_anew(archive, tracked, tmp_path, monkeypatch, capsys):
    wanted = content(tracked)
    command = [str(archive), '-o', str(tmp_path / 'out'), *PERSON]
    usual = many_bags.replay_bag
    begun = []

    def killed(source, target, options, notify, **shown):
        """Leaves the files of a process that is killed in its second bag."""
        if begun:
            folder = target.with_name(f'.{target.name}.0123abcd.partial') / target.name
            folder.mkdir(parents=True)
            (folder / 'b.mcap').write_bytes(b'half')
            raise KeyboardInterrupt
        begun.append(target.name)
        return usual(source, target, options, notify, **shown)

    monkeypatch.setattr(many_bags, 'replay_bag', killed)
    assert main(command) == 130
    assert 'interrupted, 1 of 2 bags are done' in capsys.readouterr().err
    assert list((tmp_path / 'out' / 'day').glob('.b.*.partial'))
    monkeypatch.setattr(many_bags, 'replay_bag', usual)
    assert main(command) == 0
    assert capsys.readouterr().out.splitlines()[:2] == [
        'a: done before',
        'day/b: 2 of 2 images tracked',
    ]
    assert content(tmp_path / 'out') == wanted
    assert list((tmp_path / 'out').rglob('.*')) == []
    # A changed bag is made again, too.
    (tmp_path / 'out' / 'a' / 'a.mcap').write_bytes(b'')
    assert main(command) == 0
    assert capsys.readouterr().out.startswith('a: 2 of 2 images tracked')
    assert content(tmp_path / 'out') == wanted


def test_one_that_fails_does_not_keep_the_others(archive, tracked, tmp_path, capsys):
    (tmp_path / 'bad').mkdir()
    (tmp_path / 'bad' / 'broken.mcap').write_bytes(b'no bag at all')
    bags = [str(tmp_path / 'bad'), str(archive / 'a'), str(tmp_path / 'nowhere')]
    assert main([*bags, '-o', str(tmp_path / 'out'), *PERSON]) == 1
    streams = capsys.readouterr()
    assert streams.out.splitlines() == [
        'a: 2 of 2 images tracked',
        f'{tmp_path / "out"}: 1 replayed, 0 done before, 2 failed',
    ]
    broken, nowhere = streams.err.splitlines()
    assert broken.startswith('replay: broken: ')
    assert 'is not a bag' in broken
    assert nowhere.startswith('replay: nowhere: ')
    assert 'No such file' in nowhere


@pytest.mark.parametrize('scheduler', [[], ['--scheduler', 'local']])
def test_any_exception_in_one_of_many_is_one_line(
    archive, tmp_path, monkeypatch, capsys, scheduler
):
    def fail(*_arguments, **_options):
        raise KeyError('\x1b[2J\n' + 1000 * 'long ')

    if scheduler:
        # A worker is another process, so the fault must be in its input.
        pytest.importorskip('distributed')
        monkeypatch.setattr(many_bags, '_replay_in_worker', fail)
    monkeypatch.setattr(many_bags, 'replay_bag', fail)
    command = [str(archive), '-o', str(tmp_path / 'out'), '--quiet', *scheduler, *PERSON]
    assert main(command) == 1
    lines = capsys.readouterr().err.splitlines()
    assert sorted(x[:14] for x in lines) == ['replay: a: Key', 'replay: day/b:']
    assert all(len(x) <= 300 and x.isprintable() for x in lines)


def test_what_can_not_be_begun(archive, tmp_path, monkeypatch, capsys):
    def fails(*arguments):
        assert main([*map(str, arguments), *PERSON]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        return line

    out = tmp_path / 'out'
    a, b = archive / 'a', archive / 'day' / 'b'
    assert '--live replays one bag at a time' in fails(a, b, '-o', out, '--live')
    assert 'is the input folder' in fails(archive, '-o', archive)
    (tmp_path / 'empty').mkdir()
    assert 'empty has no bags in it' in fails(tmp_path / 'empty', a, '-o', out)
    (tmp_path / 'copy').mkdir()
    for name in ('one', 'two'):
        (tmp_path / 'copy' / name).mkdir()
        (tmp_path / 'copy' / name / 'x.mcap').write_bytes(b'')
    copies = [tmp_path / 'copy' / name / 'x.mcap' for name in ('one', 'two')]
    assert f'would both become {out / "x"}' in fails(*copies, '-o', out)
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert 'pip install distributed' in fails(a, b, '-o', out, '--scheduler', 'local')
    with many_bags._alone_in(out):
        assert 'another replay writes into' in fails(a, b, '-o', out)


def test_through_dask_the_bags_are_the_same(archive, tracked, tmp_path, capfd):
    pytest.importorskip('distributed', reason='Dask is not installed (pip install distributed)')
    out = tmp_path / 'out'
    command = [str(archive), str(tmp_path / 'nowhere'), '-o', str(out), *PERSON]
    assert main([*command, '--scheduler', 'local']) == 1
    streams = capfd.readouterr()
    assert sorted(streams.out.splitlines()) == [
        f'{out}: 2 replayed, 0 done before, 1 failed',
        'a: 2 of 2 images tracked',
        'day/b: 2 of 2 images tracked',
    ]
    (line,) = streams.err.splitlines()
    assert line.startswith('replay: nowhere: ')
    assert content(out) == content(tracked)
    # Bags made in one way are not made again in the other.
    assert main([*command[:1], *command[2:]]) == 0
    assert 'day/b: done before' in capfd.readouterr().out
