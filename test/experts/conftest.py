"""Data shared by the tests of the experts."""

import numpy as np
import pytest

from test.oracles.branching import toy


def branches(count, seed, inputs=6, outputs=3):
    """Targets on one of two branches, which the inputs do not tell apart on half the circle."""
    shape = np.random.default_rng(7)
    mix_in, mix_out = shape.normal(size=(3, inputs)), shape.normal(size=(4, outputs))
    rng = np.random.default_rng(seed)
    angle, side = rng.uniform(0.0, 2.0 * np.pi, count), rng.integers(0, 2, count)
    seen = np.c_[np.cos(angle), np.sin(angle), side * (np.cos(angle) > 0)]
    made = np.c_[np.cos(angle), np.sin(2.0 * angle), 2.0 * side, side * np.sin(angle)]
    noise_in, noise_out = rng.normal(size=(count, inputs)), rng.normal(size=(count, outputs))
    return seen @ mix_in + 0.05 * noise_in, made @ mix_out + 0.1 * noise_out


@pytest.fixture(scope='session')
def toy_pairs():
    return toy(250, 0)


@pytest.fixture(scope='session')
def toy_test():
    return toy(5000, 1000)


@pytest.fixture(scope='session')
def make_branches():
    return branches


@pytest.fixture(scope='session')
def branch_pairs():
    return branches(300, 1)
