"""What all sessions have in common."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.sessions.session import entropy

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize('name', ['bme', 'filter', 'smoother'])
def test_runs_without_ros(name):
    program = (
        'import sys\n'
        'sys.modules["rclpy"] = sys.modules["hmt_msgs"] = None\n'
        f'import hmt_ros.sessions.{name}_session as session, hmt_ros.sessions.{name}_parameters\n'
        'print(session.__name__, sys.modules["rclpy"], sys.modules["hmt_msgs"])\n'
    )
    result = subprocess.run(
        [sys.executable, '-c', program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (result.stdout, result.stderr, result.returncode) == (
        f'hmt_ros.sessions.{name}_session None None\n', '', 0
    )  # fmt: skip


@pytest.mark.parametrize(
    ('weights', 'nats'),
    [([1.0], 0.0), ([0.25] * 4, math.log(4)), ([0.5, 0.5, 0.0], math.log(2)), ([], math.nan)],
)
def test_entropy_of_weights(weights, nats):
    assert np.isclose(entropy(np.array(weights)), nats, rtol=1e-15, atol=0, equal_nan=True)
