"""How setup.py compiles the core: with stub compilers, in a copy with small files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# As a preprocessor it finds all headers; it compiles once all compilations have begun.
COMPILER = r"""#!/bin/bash
case " $* " in
*" -E "*) echo found 0 found 1 found 2; exit ;;
*" -c "*) ;;
*) touch "${@: -1}"; exit ;;
esac
while [ "$1" != -c ]; do shift; done
echo "$2" >>compiled
for turn in {1..600}; do
  [ "$(wc -l <compiled)" -ge "$WANTED" ] && break
  sleep 0.1
done
[ "$turn" -lt 600 ] && touch "$4"
"""


@pytest.fixture
def sources(tmp_path):
    """A package whose core is two files and a header."""
    for name in ('setup.py', 'LICENSE'):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / 'LICENSES', tmp_path / 'LICENSES')
    for name in ('__init__.py', 'app/__init__.py', 'core/a.cpp', 'core/sub/b.cpp', 'core/sub/c.h'):
        path = tmp_path / 'hmt_ros' / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    shutil.copy(ROOT / 'hmt_ros' / 'app' / '__init__.py', tmp_path / 'hmt_ros' / 'app')
    return tmp_path


def build(sources, compiler, *options, **variables):
    path = sources / 'compiler'
    path.write_text(compiler, 'utf-8')
    path.chmod(0o755)
    environment = {**os.environ, 'CC': str(path), 'CXX': str(path), **variables}
    command = [sys.executable, 'setup.py', '-q', 'build_ext', '--inplace', *options]
    return subprocess.run(
        command, cwd=sources, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ('answer', 'missing', 'package'),
    [
        ('exit 1', 'C++20', 'g++'),
        ('echo found 1', 'C++20', 'g++'),
        ('echo found 0', 'Python.h', 'python3-dev'),
        ('echo found 0 found 1', 'pybind11', 'pybind11-dev'),
    ],
)
def test_one_line_says_what_is_missing(sources, answer, missing, package):
    done = build(sources, f'#!/bin/sh\n{answer}\n')
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert line.startswith('hmt_ros: no ')
    assert missing in line
    assert line.endswith(f'Try: sudo apt install {package}')


def test_one_line_says_that_there_is_no_compiler(sources):
    done = build(sources, '', CC='/nowhere', CXX='/nowhere')
    (line,) = done.stderr.splitlines()
    assert 'C++20' in line
    assert '/nowhere' in line


def test_files_are_compiled_at_the_same_time_and_only_if_changed(sources):
    def compiled(count):
        (sources / 'compiled').write_text('', 'utf-8')
        done = build(sources, COMPILER, WANTED=str(count), MAKEFLAGS=' -j2')
        assert done.returncode == 0, done.stderr
        return sorted((sources / 'compiled').read_text('utf-8').split())

    def edit(name):
        newest = max(x.stat().st_mtime for x in sources.rglob('*'))
        os.utime(sources / name, (newest + 1.0, newest + 1.0))

    core = ['hmt_ros/core/a.cpp', 'hmt_ros/core/sub/b.cpp']
    assert compiled(2) == core
    assert compiled(0) == []
    edit(core[1])
    assert compiled(1) == core[1:]


def test_the_installed_core_says_how_it_is_built(tmp_path):
    """The message where the core is missing, in a copy of the package."""
    package = tmp_path / 'hmt_ros'
    for name in ('__init__.py', 'core/__init__.py'):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / 'hmt_ros' / name, package / name)
    (package / '__init__.py').write_text('', 'utf-8')
    done = subprocess.run(
        [sys.executable, '-c', 'import hmt_ros.core'],
        cwd=tmp_path,
        env={**os.environ, 'PYTHONPATH': str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert 'make core' in done.stderr.splitlines()[-1]
