"""The command compile, and how functions that numba compiles are counted."""

from __future__ import annotations

import subprocess
import sys

import pytest
from numba import njit

from hmt_ros.app import main
from hmt_ros.compiled_code import CompiledFunctions, folder_in_use


def test_compiled_functions_are_counted():
    compiled = CompiledFunctions()

    @njit
    def twice(x):
        return 2 * x

    assert (compiled.count, compiled.busy) == (0, False)
    assert twice(2) == 4
    assert (compiled.count, compiled.busy) == (1, False)
    twice(3)
    assert compiled.count == 1
    twice(2.5)
    assert compiled.count == 2


def test_commands_without_kernels_do_not_load_numba_for_their_progress():
    code = (
        'import sys; from hmt_ros.app import progress\n'
        'progress.INTERVAL = 1e-3\n'
        "with progress.show_progress('out', 'messages') as bar: bar.update()\n"
        "sys.exit('numba' in sys.modules)"
    )
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0


def test_a_second_call_compiles_nothing(capsys):
    assert main(['compile', '--quiet']) == 0
    assert capsys.readouterr().out == ''
    assert main(['compile']) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith('0 functions compiled in ')
    assert line.endswith(f'kept in {folder_in_use()}')


@pytest.mark.parametrize('arguments', [['walk'], ['--fast']])
def test_arguments_that_are_refused(arguments, capsys):
    assert main(['compile', *arguments]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('compile: unrecognized arguments')
