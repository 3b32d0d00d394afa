"""Randomly spoilt arguments give a result or an error that names one; see tools/fuzz_core.py."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_no_arguments_crash_the_core():
    """A separate process with the same core first records the calls of the other tests."""
    command = [sys.executable, str(ROOT / 'tools' / 'fuzz_core.py'), '3000', '0']
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {'PYTHONPATH': os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert done.stdout.splitlines()[-1] == '3000 calls'
