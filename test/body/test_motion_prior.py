"""The motion prior of a body: the packaged file, damaged files, bodies without a prior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.body.learned_file import write_model
from hmt_ros.body.mirror import mirror
from hmt_ros.body.motion_prior import (
    LearnedMotion,
    motion_prior,
    read_motion_prior,
    shipped_motion,
)
from test.forged_models import write_forged

SMALL = LearnedMotion(
    'stick', ('a', 'b'), np.array([1.0, 4.0]), np.array([[2.0, 0.5], [0.5, 1.0]]),
    np.array([1e-3, 2e-3]), {'source': 'two motions'},
)  # fmt: skip


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / 'stick_motion.npz'


def written(path) -> Path:
    return write_model(path, SMALL, LearnedMotion.from_arrays, SMALL.card, np.zeros(4))


def test_what_was_written_is_read(path):
    found = read_motion_prior(written(path))
    assert (found.body, found.dof_names) == ('stick', ('a', 'b'))
    assert found.card == {'source': 'two motions', 'numbers': 12}
    np.testing.assert_allclose(found.damping, SMALL.damping)
    np.testing.assert_allclose(found.diffusion, SMALL.diffusion)
    np.testing.assert_allclose(found.white, SMALL.white, rtol=1e-6)
    assert found.dynamics.dimension == 2


def test_the_shipped_file_moves_left_and_right_alike_wherever_the_camera_stands(human37):
    dynamics = motion_prior(human37)
    d = human37.dimension
    assert dynamics.dimension == d
    assert dynamics.state_dimension == 2 * d
    assert motion_prior(human37) is dynamics
    diffusion = dynamics.diffusion[d:, d:]
    mirrored = mirror(human37, np.eye(d))
    np.testing.assert_allclose(mirrored @ diffusion @ mirrored.T, diffusion, atol=1e-4)
    root = human37.skeleton.dof_index(('root_tx', 'root_ty', 'root_tz'))
    assert len({float(diffusion[i, i]) for i in root}) == 1
    alone = diffusion[root].copy()
    alone[[0, 1, 2], root] = 0.0
    assert not alone.any()


def test_bodies_without_a_file_walk_randomly(human32, human37):
    walk = motion_prior(human32)
    assert walk.state_dimension == human32.dimension
    np.testing.assert_array_equal(np.diagonal(walk.diffusion), human32.rates)
    # So does a body with the name of another one but different degrees of freedom.
    other = replace(human32, skeleton=replace(human32.skeleton, name='human37'))
    assert motion_prior(other).state_dimension == human32.dimension
    assert shipped_motion('../models/human37') is None


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'format': np.array('secret')}, 'it is none of hmt_ros'),
        ({'version': np.array(1)}, 'it is of another version'),
        ({'damping': np.array([1.0, np.nan], 'f')}, 'values that are not finite'),
        ({'damping': np.array([1.0, -1.0], 'f')}, 'must be positive'),
        ({'damping': np.array(['secret', 'b'])}, 'another type'),
        ({'diffusion': np.eye(3, dtype='f')}, 'do not fit'),
        ({'diffusion': np.array([[1.0, 2.0], [2.0, 1.0]], 'f')}, 'not positive definite'),
        (
            {'parameters': np.array('{"body": "secret", "dof_names": ["a"]}')},
            r'1 degrees of freedom are named, and 2 move',
        ),
    ],
)
def test_wrong_files_are_refused_in_one_line(path, changes, message):
    write_forged(path, written(path), changes)
    with pytest.raises(ValueError, match=message) as caught:
        read_motion_prior(path)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)
    assert 'secret' not in str(caught.value)
