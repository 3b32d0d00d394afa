"""Where compiled kernels are kept."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

import hmt_ros
from hmt_ros.compiled_code import (
    FOLDERS,
    VARIABLE,
    folder_of,
    keep_compiled_code_apart,
    prepare,
)


@pytest.fixture
def package(tmp_path) -> Path:
    (tmp_path / 'package' / 'body').mkdir(parents=True)
    for name in ('__init__.py', 'body/kernel.py'):
        (tmp_path / 'package' / name).write_text('x = 1\n', 'utf-8')
    return tmp_path / 'package'


def test_a_change_of_a_source_of_kernels_is_another_state(package):
    before = folder_of(package)
    assert before == folder_of(package)
    (package / 'body' / 'kernel.py').write_text('x = 22\n', 'utf-8')
    changed = folder_of(package)
    (package / 'body' / 'other.py').write_text('', 'utf-8')
    assert len({before, changed, folder_of(package)}) == 3
    unchanged = folder_of(package)
    (package / 'sessions').mkdir()
    (package / 'sessions' / 'session.py').write_text('', 'utf-8')
    assert folder_of(package) == unchanged


def test_kernels_and_what_they_import_lie_in_the_folders():
    root = Path(hmt_ros.__file__).parent
    left = {
        x for x in root.rglob('*.py') if re.search(r'^\s*@njit|^from numba', x.read_text(), re.M)
    }
    assert len(left) > 20
    seen: set[Path] = set()
    while left:
        path = left.pop()
        seen.add(path)
        found = re.findall(r'^from (hmt_ros[\w.]*) import', path.read_text(), re.M)
        for name in found:
            of = root.joinpath(*name.split('.')[1:])
            module = (
                of.with_suffix('.py') if of.with_suffix('.py').is_file() else of / '__init__.py'
            )
            if module not in seen:
                left.add(module)
    outside = {
        str(x.relative_to(root)) for x in seen if x.relative_to(root).parts[0] not in FOLDERS
    }
    assert outside <= {'__init__.py', 'compiled_code.py'}


@pytest.mark.parametrize(
    ('imports', 'given'),
    [('hmt_ros, numba', ''), ('numba, hmt_ros', ''), ('hmt_ros, numba', '/somewhere/else')],
)
def test_numba_uses_it_unless_the_environment_names_another(imports, given):
    code = f'import {imports}; print(numba.config.CACHE_DIR)'
    environment = {**os.environ, VARIABLE: given}
    found = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()
    assert found == (given or str(folder_of(Path(hmt_ros.__file__).parent)))


def test_what_was_compiled_at_install_serves_who_can_not_write_there(
    package, monkeypatch, tmp_path
):
    monkeypatch.delenv(VARIABLE)
    installed = folder_of(package)
    (installed / 'body').mkdir(parents=True)
    (installed / 'body' / 'kernel.nbi').write_text('index', 'utf-8')
    (installed / 'body').chmod(0o555)
    monkeypatch.setattr(os, 'access', lambda *_: False)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    keep_compiled_code_apart(package)
    folder = folder_of(package)
    assert os.environ[VARIABLE] == str(folder) != str(installed)
    assert (folder / 'body' / 'kernel.nbi').read_text('utf-8') == 'index'
    assert (folder / 'body').stat().st_mode & 0o200
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    # It is copied once: what is compiled since then stays.
    (folder / 'body' / 'kernel.nbi').write_text('newer', 'utf-8')
    keep_compiled_code_apart(package)
    monkeypatch.delenv(VARIABLE)
    keep_compiled_code_apart(package)
    assert (folder / 'body' / 'kernel.nbi').read_text('utf-8') == 'newer'


def test_loading_or_compiling_is_told(monkeypatch):
    monkeypatch.setattr('hmt_ros.compiled_code.INTERVAL', 0.01)

    @njit
    def thrice(x):
        return 3 * x + np.arange(5).sum()

    lines = []
    prepare(lambda: thrice(2), lines.append)
    assert lines[0].startswith('compiling kernels, once after an update')
    assert all(line.startswith('compiling kernels: ') for line in lines[1:-1])
    assert re.fullmatch(r'\d+ functions compiled in \d+\.\d s, kept in .*', lines[-1])
    lines.clear()
    prepare(lambda: thrice(2), lines.append)
    (line,) = lines
    assert line.startswith('kernels loaded in ')
