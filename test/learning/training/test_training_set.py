import numpy as np
import pytest

from hmt_learning.training.training_set import (
    SIDE,
    TrainingSettings,
    activity_of,
    procedural_sequence,
    seen_from,
    training_set,
)
from hmt_ros.body import load_body
from hmt_ros.body.mirror import mirror, root_rotations
from hmt_ros.experts.pose_encoding import PoseEncoding


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def sequences(body):
    return [procedural_sequence(name, body, 3.0, 1) for name in ('walk', 'dance')]


def test_the_mirror_image_of_a_pose(body, sequences):
    poses = sequences[1].poses
    names = body.joint_names
    swapped = [
        names.index(n.replace('left_', '#').replace('right_', 'left_').replace('#', 'right_'))
        for n in names
    ]
    joints = body.joint_positions(poses)[:, swapped] * [-1, 1, 1]
    np.testing.assert_allclose(body.joint_positions(mirror(body, poses)), joints, atol=1e-12)
    np.testing.assert_array_equal(mirror(body, mirror(body, poses)), poses)


def test_pairs_are_seen_whole_from_all_around(body, sequences):
    pairs = training_set(body, sequences, TrainingSettings(samples=96, cut=0.0, seed=2))
    assert len(pairs) == 96
    for i in range(96):
        rows, columns = np.nonzero(pairs.mask(i))
        assert rows.min() > 0
        assert columns.min() > 0
        assert rows.max() < SIDE - 1
        assert columns.max() < SIDE - 1
        assert 0.3 * SIDE < max(np.ptp(rows), np.ptp(columns)) + 1 < SIDE
    front = PoseEncoding(body).encode(pairs.poses)[:, :3]
    quadrants = 2 * (front[:, 0] > 0) + (front[:, 2] > 0)
    assert np.bincount(quadrants, minlength=4).min() > 96 // 10
    assert set(pairs.activities) == {'walk', 'dance'}


def test_the_same_seed_gives_the_same_set(body, sequences):
    first, second, other = (
        training_set(body, sequences, TrainingSettings(samples=32, seed=s)) for s in (3, 3, 4)
    )
    np.testing.assert_array_equal(first.packed, second.packed)
    np.testing.assert_array_equal(first.poses, second.poses)
    assert (first.packed != other.packed).any()


def test_some_are_cut_at_the_waist_and_some_are_not_dressed(body, sequences):
    whole, cut = (
        training_set(body, sequences, TrainingSettings(samples=64, cut=x, dressed=0.5, seed=3))
        for x in (0.0, 1.0)
    )
    for pairs in (whole, cut):
        known = np.isfinite(pairs.edges)
        assert (known.all(1) | ~known.any(1)).all()
        assert 0 < known.all(1).sum() < 64
    np.testing.assert_array_equal(whole.poses, cut.poses)

    def middle(pairs):
        return np.array([np.nonzero(pairs.mask(i))[0].mean() for i in range(64)])

    assert np.median(middle(whole) - middle(cut)) > 0.1 * SIDE
    parts = whole.parts(0, 60)
    assert parts.contexts.shape == (60, 60)
    np.testing.assert_array_equal(parts.edges, whole.edges[0])


@pytest.mark.parametrize(
    ('heading', 'wanted'), [(0.0, (0, -1)), (90.0, (1, 0)), (180.0, (0, 1)), (-90.0, (-1, 0))]
)
def test_a_motion_seen_from_a_heading(body, sequences, heading, wanted):
    poses, masks = seen_from(body, sequences[1], heading, frames=slice(10, 30, 2))
    assert masks.shape == (10, SIDE, SIDE)
    front = root_rotations(body, poses)[:, :, 1].mean(0)
    across, _, away = front
    np.testing.assert_allclose(np.array([across, away]) / np.hypot(across, away), wanted, atol=1e-9)
    # The posture is the same as in the motion.
    np.testing.assert_array_equal(poses[:, 6:], sequences[1].poses[10:30:2, 6:])


@pytest.mark.parametrize(
    ('stem', 'wanted'),
    [
        ('cmu_07_05_slowwalk', 'slowwalk'),
        ('cmu_signals_a1', 'signals'),
        ('fair_dab', 'dab'),
        ('cmu_12_0x_walk', 'walk'),
        ('08', '08'),
        ('Jump-3', 'jump'),
    ],
)
def test_activities_from_names(stem, wanted):
    assert activity_of(stem) == wanted
