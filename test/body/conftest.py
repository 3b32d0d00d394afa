"""Fixtures of the body tests: where the development data lie, and random poses."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.body import Body


@pytest.fixture(scope='session')
def mocap() -> Path:
    """Folder of the development motions; tests that want it are skipped where it is absent."""
    root = Path(__file__).resolve().parents[2]
    folder = Path(os.environ.get('HMT_SHARED', root / '..' / 'shared')) / 'mocap'
    if not (folder / 'index.csv').is_file():
        pytest.skip(f'no development motions in {folder} (set HMT_SHARED)')
    return folder


RandomPoses = Callable[[Body, int, int], np.ndarray]


@pytest.fixture(scope='session')
def random_poses() -> RandomPoses:
    """Function (body, n, seed) -> poses (n, d) inside the limits, root 2 to 5 m from the camera."""

    def draw(body: Body, n: int, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        lower = np.maximum(body.lower, -np.pi)
        upper = np.minimum(body.upper, np.pi)
        poses = rng.uniform(lower, upper, size=(n, body.dimension))
        shifts = np.flatnonzero(~body.skeleton.dof_is_rotation)
        poses[:, shifts] = rng.uniform(-0.5, 0.5, size=(n, len(shifts)))
        poses[:, shifts[-1]] += 3.5
        return poses

    return draw
