"""On a processor without AVX2, the versions made for it give the same bytes."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

QEMU = shutil.which('qemu-x86_64-static') or shutil.which('qemu-x86_64')
PROGRAM = """
import hashlib, sys
import numpy as np
from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.core import elementary, matrices

rng = np.random.default_rng(0)
body = load_body('human32')
poses = rng.uniform(-1.0, 1.0, (20, body.dimension))
frames = forward(body.skeleton, poses).by_pose()
a = rng.uniform(-1.0, 1.0, (4, 24, 24))
spd = matrices.product(a, a.swapaxes(-1, -2)) + np.eye(24)
results = [*frames, elementary.exp(poses), elementary.sin(poses), matrices.cholesky(spd)]
digest = hashlib.sha256()
for x in results:
    digest.update(np.ascontiguousarray(x).tobytes())
print(digest.hexdigest())
"""


@pytest.mark.skipif(not QEMU, reason='needs qemu-user-static, which stands for the processor')
def test_a_processor_without_avx2_gives_the_same_bytes():
    def digest(*before):
        # Not the link in a virtual environment, which would run natively.
        python = str(Path(sys.executable).resolve())
        path = ':'.join(filter(None, sys.path))
        done = subprocess.run(
            [*before, python, '-c', PROGRAM],
            env={'PYTHONPATH': path, 'OPENBLAS_CORETYPE': 'Nehalem'},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout

    assert digest(str(QEMU), '-cpu', 'Nehalem') == digest()
