"""The command compile, and how functions that numba compiles are counted."""

from __future__ import annotations

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


def test_a_second_call_compiles_nothing(capsys):
    assert main(['compile', '--quiet']) == 0
    assert capsys.readouterr().out == ''
    assert main(['compile']) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith('0 functions compiled in ')
    assert line.endswith(f'kept in {folder_in_use()}')
