import os
import subprocess
import sys
from pathlib import Path

import pytest

import hmt_ros
from hmt_ros.app import COMMANDS, main

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize('option', ['-h', '--help'])
def test_help_names_all_commands(option, capsys):
    assert main([option]) == 0
    text = capsys.readouterr().out
    for name, (_, what) in COMMANDS.items():
        assert f'  {name}' in text
        assert what in text
    assert max(len(line) for line in text.splitlines()) <= 100


def test_version(capsys):
    assert main(['--version']) == 0
    assert capsys.readouterr().out == f'hmt_ros {hmt_ros.__version__}\n'


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [([], 'no command given'), (['replya'], "no command 'replya'"), (['--live'], "'--live'")],
)
def test_unknown_commands_are_one_line(arguments, message, capsys):
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert 'install-detector, report, export, evaluate' in line


@pytest.mark.parametrize(
    'command',
    [
        'track-video', 'import-video', 'lift', 'replay', 'report', 'export', 'evaluate',
    ],
)  # fmt: skip
def test_commands_explain_themselves(command, capsys):
    with pytest.raises(SystemExit) as caught:
        main([command, '--help'])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f'usage: {command} ')
    assert main([command]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'{command}: the following arguments are required')


def output_of_reader_that_leaves(lines, *command):
    """First lines of a program whose reader then leaves, its exit code and stderr."""
    with subprocess.Popen(
        [sys.executable, *command],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1' if lines else ''},
    ) as process:
        read = [process.stdout.readline() for _ in range(lines)]
        process.stdout.close()
        error = process.stderr.read()
    return read, process.returncode, error


MANY_LINES = """\
import sys
from hmt_ros.app.command_line import CommandParser, run_command
def work(options):
    for number in range(100_000):
        print(number)
    return 0
sys.exit(run_command(CommandParser(prog='count'), work, []))
"""


def test_commands_end_quietly_when_nobody_reads_on():
    found = output_of_reader_that_leaves(2, '-c', MANY_LINES)
    assert found == (['0\n', '1\n'], 141, '')


@pytest.mark.parametrize(
    'command',
    [('hmt_ros', '--help'), ('tools.demonstration.demo', '--help'), ('benchmarks', '--help')],
)
def test_help_ends_quietly_when_nobody_reads_it(command):
    """The output waits in a buffer until the command ends."""
    assert output_of_reader_that_leaves(0, '-m', *command) == ([], 141, '')
