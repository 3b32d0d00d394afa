"""The pages of docs/ and the reference of the library build without a warning."""

import doctest
import importlib
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

EXAMPLES = sorted(
    path
    for package in ('hmt_ros', 'msg_tools')
    for path in (ROOT / package).rglob('*.py')
    if '>>> ' in path.read_text('utf-8')
)


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_examples_of_docstrings(path):
    module = importlib.import_module('.'.join(path.relative_to(ROOT).with_suffix('').parts))
    result = doctest.testmod(module)
    assert result.attempted > 0
    assert result.failed == 0


def test_pages_build_without_a_warning(tmp_path):
    pytest.importorskip('sphinx_rtd_theme', reason='no Sphinx: "make test" installs it')
    shutil.copytree(ROOT / 'docs', tmp_path / 'docs', ignore=shutil.ignore_patterns('api'))
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-q', '-b', 'html', tmp_path / 'docs', tmp_path / 'html'],
        env=os.environ | {'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, '')
    modules = {path.stem for path in (tmp_path / 'html' / 'api').glob('*.html')}
    assert {'hmt_ros.tracking.tracker', 'hmt_ros.smoothing', 'msg_tools.bags.bag_reader'} <= modules
    page = (tmp_path / 'html' / 'api' / 'hmt_ros.tracking.tracker.html').read_text('utf-8')
    assert 'id="hmt_ros.tracking.tracker.Tracker.step"' in page
    functions = runpy.run_path(str(ROOT / 'docs' / 'core_functions.py'))['core_functions']()
    core = (tmp_path / 'html' / 'api' / 'hmt_ros.core.html').read_text('utf-8')
    assert 'place_poses(tree,' in core
    assert core.count('<li><p>') == len(functions) > 60
