"""Every error of a command gives one short line and exit code 1, never a traceback."""

import importlib
import os
import signal
import struct
import subprocess
import sys
import threading
import warnings
import zlib
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

import hmt_learning.app
import hmt_ros.app
from hmt_ros.app import command_line
from hmt_ros.app.command_line import CommandParser, run_program

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = {**hmt_ros.app.COMMANDS, **hmt_learning.app.COMMANDS}
HOSTILE = '\x1b[2Jnew\nline\u202e\udcff' + 1000 * 'long '
FAULTS = [
    ValueError(HOSTILE),
    OSError(2, HOSTILE, f'/data/{HOSTILE}'),
    MemoryError(),
    RecursionError('maximum recursion depth exceeded'),
    KeyError(HOSTILE),
    AssertionError(HOSTILE),
    TypeError(HOSTILE),
    OverflowError(HOSTILE),
    zlib.error(HOSTILE),
    struct.error(HOSTILE),
    cv2.error(HOSTILE),
    np.linalg.LinAlgError(HOSTILE),
    UnicodeDecodeError('utf-8', b'\xff\xfe', 0, 1, HOSTILE),
    ImportError(HOSTILE),
    NotImplementedError(HOSTILE),
    StopIteration(HOSTILE),
]


def only_line(text):
    """The only line of a text, checked to be short and printable."""
    assert text.endswith('\n')
    line = text[:-1]
    assert len(line) <= 300, line
    assert line.isprintable(), line
    return line


@pytest.fixture
def run_with(monkeypatch):
    """Function (command, work, *options) that runs a command with another work function."""

    def run(command, work, *options):
        module = importlib.import_module(COMMANDS[command][0])
        usual = command_line.run_command

        def instead(parser, _work, argv, **given):
            # The parser ignores the arguments of the command.
            bare = CommandParser(parser.prog)
            return usual(bare, lambda arguments: work(arguments), argv, **given)

        monkeypatch.setattr(module, 'run_command', instead)
        return module.main(list(options))

    return run


@pytest.mark.parametrize('fault', FAULTS, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize('command', COMMANDS)
def test_any_exception_is_one_line(command, fault, run_with, capsys):
    def fail(_):
        raise fault

    assert run_with(command, fail) == 1
    told = capsys.readouterr()
    line = only_line(told.err)
    assert told.out == ''
    assert line.startswith(f'{command}: ')
    unexpected = not isinstance(fault, (ValueError, OSError))
    assert line.endswith('; --debug shows where') == unexpected
    assert (f'{command}: {type(fault).__name__}: ' in line) == unexpected


@pytest.mark.parametrize('command', COMMANDS)
def test_traceback_comes_with_debug_only(command, run_with, capsys):
    def fail(arguments):
        assert not hasattr(arguments, 'debug')
        raise ZeroDivisionError('by zero')

    assert run_with(command, fail, '--debug') == 1
    text = capsys.readouterr().err
    assert text.startswith('Traceback (most recent call last):\n')
    assert 'in fail' in text
    assert text.endswith(f'{command}: ZeroDivisionError: by zero; --debug shows where\n')


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_has_debug(command, capsys):
    module = importlib.import_module(COMMANDS[command][0])
    with pytest.raises(SystemExit) as caught:
        module.main(['--help'])
    assert caught.value.code == 0
    assert '--debug ' in capsys.readouterr().out


def test_command_that_can_not_be_imported(capsys):
    assert run_program('hmt_ros', {'gone': ('hmt_ros.app.gone', '')}, '', argv=['gone']) == 1
    line = only_line(capsys.readouterr().err)
    assert line.startswith("hmt_ros: ModuleNotFoundError: No module named 'hmt_ros.app.gone'; ")


def test_unknown_command_with_a_hostile_name(capsys):
    assert hmt_ros.app.main([HOSTILE]) == 1
    assert 'hmt_ros: no command' in only_line(capsys.readouterr().err)


def test_interrupt_key_is_one_line(run_with, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    assert run_with('evaluate', interrupted) == 130
    assert capsys.readouterr().err == 'evaluate: interrupted\n'
    assert run_with('replay', interrupted) == 130
    assert capsys.readouterr().err == 'replay: interrupted, nothing is written\n'


def test_finalisers_of_what_an_error_held_are_lines(run_with, capsys):
    class Held:
        def __del__(self):
            raise KeyError(HOSTILE)

    def work(_):
        held = Held()
        raise ValueError(f'held {held is None}')

    assert run_with('export', work) == 1
    first, second = capsys.readouterr().err.splitlines(keepends=True)
    assert only_line(first) == 'export: held False'
    assert only_line(second).startswith('export: KeyError: ')


def test_warnings_and_ends_of_threads_are_lines(run_with, capsys):
    class Finalised:
        def __del__(self):
            raise RuntimeError(HOSTILE)

    def fail():
        raise KeyError(HOSTILE)

    def work(_):
        with warnings.catch_warnings():
            warnings.simplefilter('always')
            warnings.warn(f'{HOSTILE}', RuntimeWarning, stacklevel=1)
        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()
        Finalised()
        return 0

    assert run_with('export', work) == 0
    lines = capsys.readouterr().err.splitlines(keepends=True)
    assert len(lines) == 3
    for line, kind in zip(lines, ('RuntimeWarning', 'KeyError', 'RuntimeError'), strict=True):
        assert kind in only_line(line)


WORK = """\
import os, sys
from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import say, notify_user
def work(arguments):
    os.write(2, b'libpng error: CRC\\n')
    notify_user('work', 'told')
    say('done \\udcff')
    return 0
sys.exit(run_command(CommandParser('work'), work))
"""


def ended(*command, **options):
    """Exit code, stdout and stderr of a program."""
    given = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, **options}
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, text=True, check=False, timeout=300, **given
    )
    return done.returncode, done.stdout, done.stderr


def test_lines_of_libraries_come_with_debug_only():
    assert ended('-c', WORK) == (0, 'done \\udcff\n', 'work: told\n')
    assert ended('-c', WORK, '--debug')[2] == 'libpng error: CRC\nwork: told\n'


def test_full_disk_under_stdout_is_one_line():
    with Path('/dev/full').open('w') as full:
        code, _, line = ended('-c', WORK, stdout=full)
        assert code == 1
        assert line.splitlines()[-1] == 'work: [Errno 28] No space left on device'
        code, _, line = ended('-m', 'hmt_ros', '--help', stdout=full)
        assert (code, line) == (1, 'hmt_ros: [Errno 28] No space left on device\n')


WRITES = """\
import os, sys
from pathlib import Path
from hmt_ros.app.command_line import CommandParser, run_command
from msg_tools.files.new_folder import new_file
def work(arguments):
    with new_file(Path(sys.argv[1])) as file:
        print('printed')
        print('printed', file=sys.stderr)
        os.write(2, b'printed')
        file.write(b'content')
    return 0
sys.exit(run_command(CommandParser('work'), work, []))
"""


def test_closed_standard_files_are_no_files_of_ours(tmp_path):
    """Otherwise the next opened file would get their descriptors, and the printed text."""

    def close():
        os.close(1)
        os.close(2)

    assert ended('-c', WRITES, tmp_path / 'out', preexec_fn=close)[0] == 0
    assert (tmp_path / 'out').read_bytes() == b'content'


FILLS = """\
import os, resource, sys
from hmt_ros.app.command_line import CommandParser, run_command
from msg_tools import BagWriter, RosbagsMessages
def work(arguments):
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))
    with BagWriter(sys.argv[1]) as bag:
        for stamp in range(100):
            text = os.urandom(10_000).hex()
            bag.write('text', stamp, RosbagsMessages().create('std_msgs/msg/String', data=text))
    return 0
sys.exit(run_command(CommandParser('work'), work, []))
"""


def test_full_disk_under_a_bag_is_one_line(tmp_path):
    code, out, error = ended('-c', FILLS, tmp_path / 'out')
    assert (code, out) == (1, '')
    assert only_line(error) == f'work: {tmp_path}/out can not be written: File too large'
    assert list(tmp_path.iterdir()) == []


def fail_there(_):
    raise MemoryError(HOSTILE)


@pytest.mark.parametrize('pool', [ProcessPoolExecutor, ThreadPoolExecutor])
def test_exception_in_a_worker_is_one_line(pool, run_with, capsys):
    def work(_):
        with pool(1) as workers:
            return list(workers.map(fail_there, [0]))

    assert run_with('learn', work) == 1
    assert only_line(capsys.readouterr().err).startswith('learn: MemoryError: ')


def test_worker_that_is_killed_is_one_line(run_with, capsys):
    def work(_):
        with ProcessPoolExecutor(1) as workers:
            return list(workers.map(os._exit, [9]))

    assert run_with('learn', work) == 1
    assert only_line(capsys.readouterr().err).startswith('learn: BrokenProcessPool: ')


WAITS = """\
import sys, time
from pathlib import Path
from hmt_ros.app.command_line import CommandParser, run_command
from msg_tools.files.new_folder import new_file
def work(arguments):
    with new_file(Path(sys.argv[1])) as file:
        print('begun', flush=True)
        time.sleep(60)
    return 0
sys.exit(run_command(CommandParser('work'), work, []))
"""


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_leave_nothing_behind(tmp_path, number):
    command = [sys.executable, '-c', WAITS, tmp_path / 'out']
    with subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # a shell may ignore it
    ) as process:
        assert process.stdout.readline() == 'begun\n'
        process.send_signal(number)
        _, error = process.communicate(timeout=30)
    assert process.returncode == 128 + number
    assert error == ('work: interrupted\n' if number == signal.SIGINT else '')
    assert list(tmp_path.iterdir()) == []


NAMES = [
    b'new\nline',
    b'\x1b[2J\x1b]0;title\x07',
    b'\xff\xfe',
    '\u202ereversed\u2028'.encode(),
    100_000 * b'x',
    b'-\n',
    b'a' * 300 + b'/b',
]


@pytest.mark.parametrize(
    'command',
    [
        ('replay', '{}', '-o', '{}'),
        ('evaluate', '{}', '--truth', '{}'),
        ('export', '{}', '-o', '{}.csv'),
        ('report', '{}', '-o', '{}', '--images', '{}'),
        ('import-video', '{}', '-o', '{}', '--fov', '60'),
        ('import-video', 'setup.py', '-o', '{}', '--camera', '{}'),
        ('lift', '{}', '--fov', '60', '--fps', '30', '--size', '64x64'),
        ('track-video', '{}', '--keypoints', '{}'),
        ('install-detector', '{}'),
        ('train', '-o', '{}', '--mocap', '{}'),
        ('learn', 'prior', '{}', '-o', '{}'),
        ('learn', '{}'),
        ('make-bag', '{}', '-o', '{}'),
        ('replay', 'bags/reach', '-o', 'out', '--set', '{}=1'),
        ('replay', 'bags/reach', '-o', 'out', '--image-topic', '{}'),
    ],
    ids=lambda x: ' '.join(x).replace('{}', 'NAME'),
)
def test_hostile_names_are_one_line(command, tmp_path, monkeypatch, capsys):
    bags = ROOT / 'bags'
    monkeypatch.chdir(tmp_path)
    for name in map(os.fsdecode, NAMES):
        words = [x.replace('{}', name).replace('bags/', f'{bags}/') for x in command[1:]]
        module = importlib.import_module(COMMANDS[command[0]][0])
        assert module.main(words) == 1, (name[:40], capsys.readouterr())
        told = capsys.readouterr()
        assert told.out == ''
        assert only_line(told.err).startswith(f'{command[0]}: ')
    assert list(tmp_path.iterdir()) == []


def test_hostile_name_through_a_process(tmp_path):
    """Bytes that are not text appear as escapes on stderr and on stdout."""
    code, out, error = ended('-m', 'hmt_ros', 'replay', b'/\xff\n\x1b[2J', '-o', tmp_path / 'out')
    assert (code, out) == (1, '')
    assert r'\udcff \x1b[2J' in only_line(error)


def test_killed_replay_is_named_and_tidied_up(tmp_path):
    out = tmp_path / 'out'
    words = ['-m', 'hmt_ros', 'replay', 'bags/reach', '-o', out, '--no-smoother']
    words += ['--subject', 'bags/reach/subject.yaml', '--background', 'bags/reach/background.png']
    command = [sys.executable, *words]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
        while not list(tmp_path.glob('.out.*.partial/out/out.mcap')):
            assert process.poll() is None
            threading.Event().wait(0.02)
        process.kill()
    (left,) = tmp_path.iterdir()
    code, text, told = ended(*words)
    assert code == 0
    assert text.startswith(f'{out}: ')
    (line,) = [x for x in told.splitlines() if 'a run that was killed' in x]
    assert line == f'{left}: removed; a run that was killed had left it'
    assert [x.name for x in tmp_path.iterdir()] == ['out']
