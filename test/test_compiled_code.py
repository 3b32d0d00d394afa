"""Where compiled kernels are kept."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hmt_ros
from hmt_ros.compiled_code import KEPT, VARIABLE, folder_of, keep_compiled_code_apart


@pytest.fixture
def package(tmp_path) -> Path:
    (tmp_path / 'package' / 'part').mkdir(parents=True)
    for name in ('__init__.py', 'part/kernel.py'):
        (tmp_path / 'package' / name).write_text('x = 1\n', 'utf-8')
    return tmp_path / 'package'


def test_a_change_of_any_source_is_another_state(package):
    before = folder_of(package)
    assert before == folder_of(package)
    (package / 'part' / 'kernel.py').write_text('x = 22\n', 'utf-8')
    changed = folder_of(package)
    (package / 'part' / 'other.py').write_text('', 'utf-8')
    assert len({before, changed, folder_of(package)}) == 3


def test_it_is_in_the_package_where_that_can_be_written(package, monkeypatch, tmp_path):
    assert folder_of(package).parent == package / '__pycache__'
    monkeypatch.setattr(os, 'access', lambda *_: False)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    assert folder_of(package).is_relative_to(tmp_path / 'cache' / 'hmt_ros')


def test_folders_of_other_states_go_after_a_day(package, monkeypatch):
    monkeypatch.delenv(VARIABLE)
    old, recent = (package / '__pycache__' / f'compiled-{x}' for x in ('old', 'recent'))
    for folder in (old, recent):
        folder.mkdir(parents=True)
    os.utime(old, (time.time() - KEPT - 60.0,) * 2)
    keep_compiled_code_apart(package)
    assert os.environ[VARIABLE] == str(folder_of(package))
    assert not old.exists()
    assert recent.exists()


@pytest.mark.parametrize('given', ['', '/somewhere/else'])
def test_numba_uses_it_unless_the_environment_names_another(given):
    code = 'import hmt_ros, numba; print(numba.config.CACHE_DIR)'
    environment = {**os.environ, VARIABLE: given}
    found = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()
    assert found == (given or str(folder_of(Path(hmt_ros.__file__).parent)))


def test_it_counts_where_numba_came_first():
    code = 'import numba, hmt_ros; print(numba.config.CACHE_DIR)'
    environment = {**os.environ, VARIABLE: ''}
    found = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()
    assert found == str(folder_of(Path(hmt_ros.__file__).parent))
