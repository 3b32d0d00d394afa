from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hmt_learning.training.training_set import (
    SIDE,
    PoseSequence,
    TrainingSettings,
    activity_of,
    motion_files,
    procedural_sequence,
    seen_from,
    training_set,
    typical_body,
)
from hmt_ros.body import Body, load_body
from hmt_ros.body.mirror import mirror, root_rotations
from hmt_ros.experts.pose_encoding import PoseEncoding


@pytest.fixture(scope='module')
def body() -> Body:
    return load_body('human37')


@pytest.fixture(scope='module')
def sequences(body: Body) -> list[PoseSequence]:
    return [procedural_sequence(name, body, 3.0, 1) for name in ('walk', 'dance')]


def test_the_mirror_image_of_a_pose(body: Body, sequences: list[PoseSequence]) -> None:
    poses = sequences[1].poses
    names = body.joint_names
    swapped = [
        names.index(n.replace('left_', '#').replace('right_', 'left_').replace('#', 'right_'))
        for n in names
    ]
    joints = body.joint_positions(poses)[:, swapped] * [-1, 1, 1]
    np.testing.assert_allclose(body.joint_positions(mirror(body, poses)), joints, atol=1e-12)
    np.testing.assert_array_equal(mirror(body, mirror(body, poses)), poses)


def test_pairs_are_seen_whole_from_all_around(body: Body, sequences: list[PoseSequence]) -> None:
    pairs = training_set(body, sequences, TrainingSettings(samples=96, seed=2))
    assert len(pairs) == 96
    for mask in pairs.masks():
        rows, columns = np.nonzero(mask)
        assert rows.min() > 0
        assert columns.min() > 0
        assert rows.max() < SIDE - 1
        assert columns.max() < SIDE - 1
        assert 0.3 * SIDE < max(np.ptp(rows), np.ptp(columns)) + 1 < SIDE
    front = PoseEncoding(body).encode(pairs.poses)[:, :3]
    quadrants = 2 * (front[:, 0] > 0) + (front[:, 2] > 0)
    assert np.bincount(quadrants, minlength=4).min() > 96 // 10
    assert set(pairs.activities) == {'walk', 'dance'}


def test_the_pose_before_is_a_step_before(body: Body, sequences: list[PoseSequence]) -> None:
    pairs = training_set(body, sequences, TrainingSettings(samples=64, mixed=0.0))
    joints, before = (body.joint_positions(x) for x in (pairs.poses, pairs.previous))
    away = np.linalg.norm(joints - before, axis=2)
    moving = pairs.frames > 0
    assert away[moving].mean() > 0.002
    assert away.max() < 0.35  # 10 m/s at 30 Hz
    original = np.array(
        [
            np.linalg.norm(np.diff(body.joint_positions(sequences[s].poses[f - 1 : f + 1]), axis=0))
            for s, f in zip(pairs.sequences[moving], pairs.frames[moving])
        ]
    )
    found = np.sqrt((away[moving] ** 2).sum(1))
    np.testing.assert_allclose(found, original, rtol=1e-6)


def test_the_same_seed_gives_the_same_set(body: Body, sequences: list[PoseSequence]) -> None:
    first, second, other = (
        training_set(body, sequences, TrainingSettings(samples=32, seed=s)) for s in (3, 3, 4)
    )
    np.testing.assert_array_equal(first.packed, second.packed)
    np.testing.assert_array_equal(first.poses, second.poses)
    assert (first.packed != other.packed).any()


def test_mixed_poses_take_only_the_upper_body(body: Body, sequences: list[PoseSequence]) -> None:
    settings = TrainingSettings(samples=40, mirrored=0.0)
    plain = training_set(body, sequences, settings)
    mixed = training_set(body, sequences, replace(settings, mixed=1.0))
    legs = [i for i, n in enumerate(body.dof_names) if 'knee' in n or 'hip' in n]
    arms = [i for i, n in enumerate(body.dof_names) if 'elbow' in n]
    np.testing.assert_array_equal(mixed.poses[:, legs], plain.poses[:, legs])
    assert (mixed.poses[:, arms] != plain.poses[:, arms]).mean() > 0.8


def test_typical_lengths_are_medians(body: Body) -> None:
    lengths = [body.segment_lengths | {'thigh': x} for x in (0.3, 0.4, 0.7)]
    sequences = [PoseSequence('m', 'm', np.zeros((1, 37)), x) for x in lengths]
    assert typical_body(body, sequences).segment_lengths['thigh'] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ('heading', 'wanted'), [(0.0, (0, -1)), (90.0, (1, 0)), (180.0, (0, 1)), (-90.0, (-1, 0))]
)
def test_a_motion_seen_from_a_heading(
    body: Body, sequences: list[PoseSequence], heading: float, wanted: tuple[int, int]
) -> None:
    poses, masks = seen_from(body, sequences[1], heading, frames=slice(10, 30, 2))
    assert masks.shape == (10, SIDE, SIDE)
    front = root_rotations(body, poses)[:, :, 1].mean(0)
    across, _, away = front
    np.testing.assert_allclose(np.array([across, away]) / np.hypot(across, away), wanted, atol=1e-9)
    # The posture is that of the motion.
    np.testing.assert_array_equal(poses[:, 6:], sequences[1].poses[10:30:2, 6:])


def test_a_motion_seen_from_above(body: Body, sequences: list[PoseSequence]) -> None:
    level, above = (
        root_rotations(body, seen_from(body, sequences[0], 30.0, e, frames=slice(4))[0])
        for e in (0.0, 25.0)
    )
    # From above, what is up comes nearer to the camera.
    tilt = np.degrees(np.arctan2(-above[:, 2, 2], -above[:, 1, 2]))
    tilt -= np.degrees(np.arctan2(-level[:, 2, 2], -level[:, 1, 2]))
    np.testing.assert_allclose(tilt, 25.0, atol=1e-6)
    with pytest.raises(ValueError, match='no frames'):
        seen_from(body, sequences[0], 0.0, frames=slice(5, 5))


def test_the_outline_of_a_seen_motion_is_uneven(body: Body, sequences: list[PoseSequence]) -> None:
    def masks(noise: float, seed: int) -> np.ndarray:
        return seen_from(body, sequences[0], 0.0, frames=slice(3), boundary_noise=noise, seed=seed)[
            1
        ]

    clean, noisy = masks(0.0, 0), masks(1.0, 1)
    np.testing.assert_array_equal(noisy, masks(1.0, 1))
    assert 0.005 < (clean != noisy).sum() / clean.sum() < 0.12


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
def test_activities_from_names(stem: str, wanted: str) -> None:
    assert activity_of(stem) == wanted


def test_poses_that_are_not_finite_are_refused(body: Body) -> None:
    poses = np.zeros((5, 37))
    poses[3, 7] = np.nan
    with pytest.raises(ValueError, match='1 of 5 poses are not finite, the first in frame 3'):
        PoseSequence('broken', 'walk', poses, body.segment_lengths)


def test_nothing_to_learn_from(body: Body, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match='no motions'):
        training_set(body, [])
    with pytest.raises(ValueError, match='has no motion'):
        motion_files(tmp_path)
    with pytest.raises(ValueError, match='no folder'):
        motion_files(tmp_path / 'absent')
    with pytest.raises(ValueError, match='share'):
        TrainingSettings(mirrored=1.5)
    with pytest.raises(ValueError, match='at least 1'):
        TrainingSettings(samples=0)
