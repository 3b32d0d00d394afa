import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from msg_tools.files.new_folder import FolderKind, new_file

KIND = FolderKind('a box', 'lid', ('*.txt',))


def fill(folder, text='new'):
    folder.mkdir()
    (folder / 'lid').write_text(text)
    (folder / 'a.txt').write_text(text)


def write(target, kind, **options):
    """Writes a folder or a file to its place."""
    if kind == 'folder':
        with KIND.new(target, overwrite=True) as folder:
            fill(folder, **options)
    else:
        with new_file(target) as file:
            file.write(b'new')


@pytest.mark.parametrize('kind', ['folder', 'file'])
@pytest.mark.parametrize('dangling', [False, True])
def test_links_are_never_written_through(tmp_path, kind, dangling):
    elsewhere, target = tmp_path / 'elsewhere', tmp_path / 'out'
    if not dangling and kind == 'folder':
        fill(elsewhere, 'mine')
    elif not dangling:
        elsewhere.write_text('mine')
    target.symlink_to(elsewhere)
    with pytest.raises(ValueError, match='is not replaced'):
        write(target, kind)
    assert target.is_symlink()
    assert elsewhere.exists() != dangling
    if not dangling:
        assert (elsewhere / 'lid' if kind == 'folder' else elsewhere).read_text() == 'mine'
    assert not list(tmp_path.glob('.*'))


@pytest.mark.parametrize('kind', ['folder', 'file'])
def test_folder_that_is_a_link_is_written_into(tmp_path, kind):
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'data').symlink_to(tmp_path / 'disk')
    write(tmp_path / 'data' / 'out', kind)
    assert [x.name for x in (tmp_path / 'disk').iterdir()] == ['out']


def test_link_that_comes_meanwhile_is_replaced_not_followed(tmp_path):
    with new_file(tmp_path / 'out') as file:
        file.write(b'new')
        (tmp_path / 'out').symlink_to(tmp_path / 'elsewhere')
    assert (tmp_path / 'out').read_bytes() == b'new'
    assert [x.name for x in tmp_path.iterdir()] == ['out']


@pytest.mark.parametrize('kind', ['folder', 'file'])
def test_what_is_no_file_of_ours_is_not_replaced(tmp_path, kind):
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(ValueError, match='pipe is not replaced'):
        write(tmp_path / 'pipe', kind)


KILLED = """\
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from test_new_folder import KIND, fill, new_file
target = Path(sys.argv[1])
if sys.argv[2] == 'folder':
    with KIND.new(target, overwrite=True) as folder:
        fill(folder)
        os.kill(os.getpid(), signal.SIGKILL)
with new_file(target) as file:
    file.write(b'half')
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize('kind', ['folder', 'file'])
def test_remains_of_a_killed_process_are_named_and_removed_on_success(tmp_path, kind, caplog):
    command = [sys.executable, '-c', KILLED, tmp_path / 'out', kind, Path(__file__).parent]
    assert subprocess.run(command, check=False).returncode == -9
    (left,) = tmp_path.iterdir()
    with pytest.raises(ZeroDivisionError), KIND.new(tmp_path / 'out', overwrite=False):
        raise ZeroDivisionError
    assert left.exists()
    caplog.clear()
    write(tmp_path / 'out', kind)
    assert [x.name for x in tmp_path.iterdir()] == ['out']
    assert caplog.messages == [f'{left}: removed; a run that was killed had left it']


@pytest.mark.parametrize('kind', ['folder', 'file'])
def test_work_of_a_process_that_lives_is_let_alone(tmp_path, kind, caplog):
    if kind == 'folder':
        with KIND.new(tmp_path / 'out', overwrite=True) as folder:
            fill(folder, 'first')
            write(tmp_path / 'out', kind)
        assert (tmp_path / 'out' / 'lid').read_text() == 'first'
    else:
        with new_file(tmp_path / 'out') as file:
            write(tmp_path / 'out', kind)
            file.write(b'first')
        assert (tmp_path / 'out').read_bytes() == b'first'
    assert caplog.messages == []
    assert [x.name for x in tmp_path.iterdir()] == ['out']


@pytest.mark.parametrize('kind', ['folder', 'file'])
def test_what_only_looks_like_remains_is_let_alone(tmp_path, kind, caplog):
    fill(tmp_path / 'mine')
    foreign = tmp_path / '.out.0123abcd.partial' / 'out'
    foreign.mkdir(parents=True)
    (foreign / 'thesis.tex').write_text('mine')
    other = tmp_path / '.out.01234567.partial' / 'thesis'
    other.mkdir(parents=True)
    (tmp_path / '.out.89abcdef.partial').symlink_to(tmp_path / 'mine')
    os.mkfifo(tmp_path / '.out.aaaaaaaa.partial')
    (tmp_path / '.out.partial').mkdir()
    (tmp_path / '.outer.0123abcd.partial' / 'outer').mkdir(parents=True)
    before = sorted(tmp_path.rglob('*'))
    write(tmp_path / 'out', kind)
    assert caplog.messages == []
    (tmp_path / 'out').rename(tmp_path.parent / f'{tmp_path.name}_out')
    assert sorted(tmp_path.rglob('*')) == before


def test_file_that_fails_leaves_what_was_there(tmp_path):
    (tmp_path / 'out').write_text('before')
    with pytest.raises(TypeError, match='bytes-like'), new_file(tmp_path / 'out') as file:
        file.write('half')
    assert (tmp_path / 'out').read_text() == 'before'
    assert [x.name for x in tmp_path.iterdir()] == ['out']


def test_file_system_without_locks_keeps_remains(tmp_path, monkeypatch):
    def refused(*_):
        raise OSError(95, 'Operation not supported')

    left = tmp_path / '.out.0123abcd.partial'
    left.write_text('half')
    monkeypatch.setattr(fcntl, 'flock', refused)
    write(tmp_path / 'out', 'file')
    assert left.exists()
    assert (tmp_path / 'out').read_bytes() == b'new'
