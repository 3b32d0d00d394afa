"""The benchmark of the tracker: scores of records with known answers, runs that are kept."""

import json
import multiprocessing
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import (
    runs,
    tracking,
    tracking_budgets,
    tracking_oracle,
    tracking_rules,
    tracking_speed,
)
from benchmarks.clips import LANDMARK_NAMES, at_rate, read_clip, resized, rounded, rows_at_rate
from benchmarks.runs import (
    BOTH,
    GIVEN,
    IMAGES,
    INPUTS,
    JOINTS,
    KEYPOINTS,
    UNKNOWN,
    Record,
    Run,
    follow,
    in_processes,
    keypoints_only,
    name_of,
    new_tracker,
    read_record,
    recorded,
    records_of,
    run_all,
    subject_of,
)
from benchmarks.runs import run as run_one
from benchmarks.stages import STAGES
from benchmarks.tracker_changes import changed
from benchmarks.tracking_means import entry_of, grouped, paired
from benchmarks.tracking_scores import (
    SCORES,
    acceleration_ratio,
    detector_scores,
    facing_scores,
    interval,
    interval_over_seeds,
    procrustes_aligned,
    scores_of,
    standing_speed,
    trunk_offsets,
)
from hmt_ros.body import load_body
from hmt_ros.body.ground_terms import GroundSettings
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.existence import Status

ROOT = Path(__file__).resolve().parents[1]
REACH = ROOT / 'bags' / 'reach'
SMALL = TrackerSettings(max_hypotheses=4, candidates=6, combinations=24)
STEP = 100_000_000  # ns between two images
MM = 1e-3


@pytest.fixture(scope='module')
def clip():
    return read_clip(REACH, 4)


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def timed(clip):
    """Times of a short run, and the parts of the tracker before and after."""
    before = [getattr(owner, name) for owner, name, _ in STAGES]
    found = tracking_speed.speed(clip)
    return found, before, [getattr(owner, name) for owner, name, _ in STAGES]


@pytest.fixture(scope='module')
def followed(body):
    """Function (folder, changes) -> the record of two images by a small tracker, made once."""

    @cache
    def record(folder, changes):
        short = read_clip(folder, 2)
        return follow(short, new_tracker(short, body, replace(SMALL, **dict(changes)), 0), 0)

    return record


@pytest.fixture
def quick_runs(monkeypatch, followed):
    """The benchmark with runs of two images, by small trackers, in this process; the runs done."""
    done = []

    def run_here(runs, _processes=0):
        done.extend(runs)
        return [followed(one.folder, one.changes) for one in runs]

    for module in (tracking, tracking_budgets, tracking_rules):
        monkeypatch.setattr(module, 'run_all', run_here)
    return done


def made_record(images=6, seed=0):
    """A record whose truth is random and whose three modes, weighted 0.5, 0.3, 0.2, err by known
    distances: by 100, 40 and 200 mm in every joint; the point estimate errs by 70 mm."""
    rng = np.random.default_rng(seed)
    n = len(JOINTS)
    true = rng.normal(size=(images, n, 3)) + np.array([0.0, 0.0, 4.0])
    true[:, 0] = [0.0, 0.0, 4.0]

    def moved(distance, axis=0):
        result = true.copy()
        result[:, 1:, axis] += distance
        return result

    joints = np.stack([moved(0.1), moved(0.04), moved(-0.2)], axis=1)
    return Record(
        stamps=STEP * np.arange(images),
        joints=joints,
        weights=np.tile([0.5, 0.3, 0.2], (images, 1)),
        point=moved(0.07, axis=1),
        blind=np.full(images, 0.09),
        levels=np.linspace(0.0, 1.0, images),
        joint_levels=np.full((images, n - 1), 0.7),
        log_densities=np.full(images, 3.0),
        evaluations=np.full(images, 200.0),
        seconds=np.full(images, 0.1),
        images=np.array([images]),
        true=true,
        contact=np.zeros((0, 2), dtype=bool),
        views=np.tile(np.eye(3, 4), (images, 1, 1)),
    )


def test_errors_of_a_record():
    found = scores_of(made_record())
    assert found['heaviest_mm'] == pytest.approx(100.0)
    assert found['best_mm'] == pytest.approx(40.0)
    assert found['point_mm'] == pytest.approx(70.0)
    # The modes lie on one line: 0.5 * 100 + 0.3 * 40 - 0.2 * 200.
    assert found['expected_mm'] == pytest.approx(22.0)
    assert found['blind_mm'] == pytest.approx(90.0)
    # All joints err alike, which the alignment takes away.
    assert found['aligned_mm'] == pytest.approx(0.0, abs=1e-6)
    assert found['kept'] == 1.0
    assert found['root_percent'] == found['depth_percent'] == 0.0
    assert found['acceleration'] == pytest.approx(1.0)
    assert (found['evaluations'], found['ms']) == (200.0, pytest.approx(100.0))


def test_the_error_of_the_mode_that_later_images_prefer():
    record = made_record()
    assert np.isnan(scores_of(record)['lagged_mm'])
    lagged = record.weights.copy()
    lagged[1:] = [0.2, 0.7, 0.1]
    found = scores_of(replace(record, lagged=lagged))
    images = len(lagged)
    assert found['lagged_mm'] == pytest.approx((100.0 + 40.0 * (images - 1)) / images)
    assert found['heaviest_mm'] == pytest.approx(100.0)


def standing_person(images=4):
    """Positions (T, J, 3) of a person who faces the camera, arms out, forearms towards it."""
    places = {
        'pelvis': (0.0, 0.0, 4.0), 'neck': (0.0, -0.5, 4.0),
        'left_shoulder': (0.2, -0.5, 4.0), 'right_shoulder': (-0.2, -0.5, 4.0),
        'left_elbow': (0.5, -0.5, 4.0), 'right_elbow': (-0.5, -0.5, 4.0),
        'left_wrist': (0.6, -0.5, 3.8), 'right_wrist': (-0.6, -0.5, 3.8),
        'left_hip': (0.1, 0.0, 4.0), 'right_hip': (-0.1, 0.0, 4.0),
        'left_knee': (0.1, 0.4, 3.9), 'right_knee': (-0.1, 0.4, 4.0),
        'left_ankle': (0.1, 0.8, 4.0), 'right_ankle': (-0.1, 0.8, 4.0),
    }  # fmt: skip
    return np.tile(np.array([places[name] for name in JOINTS]), (images, 1, 1))


def person_record(heaviest):
    """A record of four images of `standing_person`, whose second mode is right."""
    record, true = made_record(4), standing_person()
    joints = np.stack([heaviest, true, true], axis=1)
    return replace(record, true=true, joints=joints, point=heaviest)


def turned(joints, degrees):
    """The same about the vertical through the pelvis."""
    turn = Rotation.from_euler('y', degrees, degrees=True).as_matrix()
    return (joints - joints[:, :1]) @ turn.T + joints[:, :1]


def test_a_person_who_faces_the_wrong_way_is_counted():
    true = standing_person()
    for degrees, wrong in ((0, 0), (80, 0), (100, 4), (180, 4), (-100, 4)):
        found = scores_of(person_record(turned(true, degrees)))
        assert (found['wrong_way'], found['wrong_way_images']) == (wrong / 4, wrong), degrees
    heaviest = true.copy()
    heaviest[1] = turned(true, 170)[1]
    found = scores_of(person_record(heaviest))
    assert (found['wrong_way'], found['wrong_way_images']) == (0.25, 1)
    # Sides that are exchanged face the other way, too.
    sides = [JOINTS.index(x.replace('left', 'R').replace('right', 'left').replace('R', 'right'))
             for x in JOINTS]  # fmt: skip
    assert scores_of(person_record(true[:, sides]))['wrong_way'] == 1.0
    # One image lacks the truth of a hip: it does not count.
    record = person_record(heaviest)
    lacking = record.true.copy()
    lacking[1, JOINTS.index('left_hip')] = np.nan
    assert facing_scores(replace(record, true=lacking))['wrong_way'] == 0.0


def test_signs_of_slanted_limbs():
    true = standing_person()
    # Slanted are both forearms; a thigh and a shin lean by 14 degrees.
    assert scores_of(person_record(true))['wrong_sign'] == 0.0
    heaviest = true.copy()
    heaviest[:2, JOINTS.index('left_wrist'), 2] = 4.2
    heaviest[:, JOINTS.index('left_knee'), 2] = 4.1
    assert scores_of(person_record(heaviest))['wrong_sign'] == 0.25
    flat = true.copy()
    flat[:, :, 2] = 4.0
    assert np.isnan(scores_of(replace(person_record(true), true=flat))['wrong_sign'])


def test_errors_relative_to_the_hips():
    true = standing_person()
    heaviest = true + np.array([0.3, 0.0, 0.1])
    heaviest[:, 0] = true[:, 0]
    found = scores_of(person_record(heaviest))
    assert found['hips_mm'] == pytest.approx(0.0, abs=1e-9)
    assert found['heaviest_mm'] == pytest.approx(1e3 * np.hypot(0.3, 0.1))


def test_joints_that_the_model_has_elsewhere_in_the_trunk_are_told():
    record = made_record()
    # Somebody who faces the camera (y down, z away), and the same turned and leaning as a whole.
    stand = {name: [0.0, 0.0, 3.0] for name in JOINTS}
    for side, x in (('left', 0.2), ('right', -0.2)):
        stand |= {f'{side}_shoulder': [x, -0.5, 3.0], f'{side}_hip': [x, 0.1, 2.98]}
    stand['neck'] = [0.0, -0.5, 2.98]
    true = np.array([stand[name] for name in JOINTS])
    moved = true.copy()
    hips = [JOINTS.index('left_hip'), JOINTS.index('right_hip')]
    moved[[*hips, JOINTS.index('neck')], 2] -= 0.01
    turn = Rotation.from_rotvec([0.3, 0.8, -0.2]).as_matrix()
    joints = np.repeat((moved @ turn.T)[None, None], len(record.stamps), axis=0)
    joints = np.repeat(joints, record.joints.shape[1], axis=1)
    trues = np.repeat(true[None], len(record.stamps), axis=0)
    found = trunk_offsets(replace(record, joints=joints, true=trues), np.ones(6, dtype=bool))
    assert found['hips_ahead_mm'] == pytest.approx(10.0)
    assert found['neck_ahead_mm'] == pytest.approx(10.0)
    assert found['shoulders_ahead_mm'] == pytest.approx(0.0, abs=1e-9)
    assert found['hips_up_mm'] == pytest.approx(0.0, abs=1e-9)
    nobody = trunk_offsets(replace(record, joints=joints, true=trues), np.zeros(6, dtype=bool))
    assert np.isnan(list(nobody.values())).all()


def test_tracks_that_end_too_early_are_counted():
    record = made_record()
    assert np.isnan(scores_of(record)['nobody'])
    assert np.isnan(scores_of(record)['cpu_ms'])
    statuses = np.array(
        ['waiting', 'tracking', 'nobody', 'nobody', 'waiting', 'lost', 'tracking', 'tracking']
    )
    # An image before the track began is nobody's fault.
    found = scores_of(replace(record, statuses=statuses, cpu_seconds=np.full(6, 0.2)))
    assert found['nobody'] == pytest.approx(3 / 8)
    assert found['cpu_ms'] == pytest.approx(200.0)
    assert np.isnan(scores_of(replace(record, statuses=statuses[:1]))['nobody'])
    costs = scores_of(replace(record, evaluations=np.array([1.0, 2.0, 3.0, 4.0, 5.0, 100.0])))
    assert costs['evaluations_99'] == pytest.approx(95.25)


def test_a_run_that_found_nobody_has_scores(clip):
    record = recorded(clip, [], [], [], [], [], [], 0)
    found = scores_of(record)
    assert found.pop('kept') == 0.0
    assert all(np.isnan(np.asarray(value)).all() for value in found.values())
    assert {*scores_of(made_record())} == {*found, 'kept'} == {*SCORES, 'by_joint_90'}


@pytest.mark.parametrize(
    ('rate', 'every'), [(0.0, 1), (30.0, 1), (60.0, 1), (15.0, 2), (8.0, 4), (3.0, 10), (1e-9, 40)]
)
def test_images_are_left_out_by_their_stamps(rate, every):
    stamps = [7 + round(i * 1e9 / 30) for i in range(40)]
    assert rows_at_rate(stamps, rate) == list(range(0, 40, every))


def test_rates_do_not_assume_thirty_images_a_second():
    # 10 images a second; three are lost after the fifth.
    stamps = [STEP * i for i in range(20) if i not in (5, 6, 7)]
    kept = [stamps[i] // STEP for i in rows_at_rate(stamps, 3.0)]
    assert kept == [0, 3, 8, 11, 14, 17]
    assert rows_at_rate([], 3.0) == []
    assert rows_at_rate([5], 3.0) == [0]


def test_a_clip_at_a_lower_rate(clip):
    step = clip.stamps[1] - clip.stamps[0]
    half = at_rate(clip, 0.5e9 / step)
    assert half.stamps == clip.stamps[::2]
    assert [x is y for x, y in zip(half.images, clip.images[::2], strict=True)] == [True, True]
    run = Run(REACH, IMAGES, 0, limit=2)
    assert name_of(run) != name_of(replace(run, rate=3.0))


def test_a_run_at_a_lower_rate(clip):
    small = tuple((name, getattr(SMALL, name)) for name in ('max_hypotheses', 'candidates'))
    rate = 0.5e9 / (clip.stamps[1] - clip.stamps[0])
    record = run_one(Run(REACH, IMAGES, 0, small, limit=4, rate=rate))
    assert record.stamps.tolist() == clip.stamps[:4:2]
    assert (record.images.tolist(), record.statuses.tolist()) == ([2], ['tracking'] * 2)
    assert (record.cpu_seconds > 0).all()
    # Later images move weights between the modes of an image, but not of the last one.
    assert record.lagged.shape == record.weights.shape
    assert record.lagged.sum(1) == pytest.approx(1.0)
    assert np.array_equal(record.lagged[-1], record.weights[-1])


def test_gravity_is_given_with_each_image(clip):
    told = []

    class Listener:
        estimate = SimpleNamespace(status=Status.WAITING)

        def set_gravity(self, up):
            told.append(up)

        def step(self, image, stamp, keypoints, prediction):
            return None, None

    ups = {stamp: np.array([0.0, -1.0, 0.1 * i]) for i, stamp in enumerate(clip.stamps)}
    follow(replace(clip, ups=ups), Listener(), 0, gravity=GIVEN)
    assert np.array_equal(told, [ups[stamp] for stamp in clip.stamps])
    follow(replace(clip, ups=ups), Listener(), 0)
    assert len(told) == len(clip.stamps)
    with pytest.raises(ValueError, match='neither gravity nor up'):
        follow(replace(clip, ups={}), Listener(), 0, gravity=GIVEN)


def test_a_clip_tells_gravity_or_a_vertical_that_does_not_move(tmp_path):
    for path in REACH.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / 'truth.npz').unlink()
    with np.load(REACH / 'truth.npz') as content:
        known = {name: content[name] for name in content if name not in ('gravity', 'up')}
    count = len(known['stamps'])
    down = np.tile([0.0, 4.0, 3.0], (count, 1))
    for more, expected in (
        ({'gravity': 2.0 * down}, [0.0, -0.8, -0.6]),
        ({'up': np.array([0.6, -0.8, 0.0])}, [0.6, -0.8, 0.0]),
    ):
        np.savez(tmp_path / 'truth.npz', **known, **more)
        ups = read_clip(tmp_path, 1).ups
        assert list(ups) == [int(stamp) for stamp in known['stamps']]
        assert np.allclose(np.array(list(ups.values())), expected)
    np.savez(tmp_path / 'truth.npz', **{k: v for k, v in known.items() if k != 'camera_height'})
    assert read_clip(tmp_path, 1).ups == {}
    assert np.allclose(next(iter(read_clip(REACH, 1).ups.values())), [0.0, -1.0, 0.0])


def test_a_foot_stands_if_it_does_in_images_that_are_left_out(clip, tmp_path):
    rows = np.arange(4)
    contact = np.array([[True, True], [True, False], [True, True], [True, True]])
    with np.load(REACH / 'truth.npz') as content:
        np.savez(tmp_path / 'truth.npz', contact=contact, stamps=content['stamps'][rows])
    here = replace(clip, folder=tmp_path)
    assert runs.feet_and_views(here, clip.stamps)[0].tolist() == [
        [True, True], [True, False], [True, False], [True, True],
    ]  # fmt: skip
    assert runs.feet_and_views(here, clip.stamps[::2])[0].tolist() == [[True, True], [True, False]]


def test_modes_that_are_absent_do_not_count():
    record = made_record()
    joints, weights = record.joints.copy(), record.weights.copy()
    joints[2, 1:] = np.nan
    weights[2] = [1.0, 0.0, 0.0]
    found = scores_of(replace(record, joints=joints, weights=weights))
    assert found['best_mm'] == pytest.approx((5 * 40.0 + 100.0) / 6)
    assert found['expected_mm'] == pytest.approx((5 * 22.0 + 100.0) / 6)
    assert found['weights'] == pytest.approx(5 * np.log(3 * 0.3) / 6)


def test_images_that_are_lost_are_not_kept():
    record = made_record()
    assert scores_of(replace(record, images=np.array([8])))['kept'] == 0.75
    far = record.joints.copy()
    far[:2, 0] += np.where(np.arange(len(JOINTS))[:, None] > 0, [0.06, 0.0, 0.0], 0.0)
    assert scores_of(replace(record, joints=far))['kept'] == pytest.approx(4 / 6)


def test_the_root_is_told_in_percent_of_its_distance():
    record = made_record()
    point = record.point + np.array([0.03, 0.0, -0.04])
    found = scores_of(replace(record, point=point))
    assert found['root_percent'] == pytest.approx(100 * 0.05 / 4.0)
    assert found['depth_percent'] == pytest.approx(-1.0)
    assert found['point_mm'] == pytest.approx(70.0)


def test_calibration_of_a_record():
    record = made_record()
    found = scores_of(record)
    # Levels 0, 0.2, ... 1.
    assert found['coverage_50'] == pytest.approx(3 / 6)
    assert found['coverage_90'] == pytest.approx(5 / 6)
    assert (found['joint_coverage_50'], found['joint_coverage_90']) == (0.0, 1.0)
    assert found['negative_log_likelihood'] == -3.0
    levels = record.joint_levels.copy()
    levels[:3, JOINTS.index('left_wrist') - 1] = 0.95
    shares = scores_of(replace(record, joint_levels=levels))['by_joint_90']
    assert shares[EVALUATED_JOINTS.index('left_wrist')] == 0.5
    assert np.sort(shares)[1] == 1.0


def test_weights_are_scored_against_uniform_ones():
    record = made_record()
    assert scores_of(record)['weights'] == pytest.approx(np.log(0.3 * 3))
    uniform = np.full_like(record.weights, 1 / 3)
    assert scores_of(replace(record, weights=uniform))['weights'] == pytest.approx(0.0)
    good = np.tile([0.1, 0.8, 0.1], (6, 1))
    assert scores_of(replace(record, weights=good))['weights'] == pytest.approx(np.log(2.4))


def test_joints_without_truth_do_not_count():
    record = made_record()
    neck = JOINTS.index('neck')
    true, point = record.true.copy(), record.point.copy()
    true[:, neck] = np.nan
    point[:, neck] += 5.0
    found = scores_of(
        replace(record, true=true, point=point, joint_levels=record.joint_levels[:, 1:])
    )
    assert found['point_mm'] == pytest.approx(70.0)
    assert np.isnan(found['by_joint_90'][EVALUATED_JOINTS.index('neck')])
    assert np.isfinite(found['by_joint_90']).sum() == len(EVALUATED_JOINTS) - 1


def test_procrustes_finds_a_similarity():
    rng = np.random.default_rng(0)
    targets = rng.normal(size=(20, 13, 3))
    turned = targets @ Rotation.random(20, random_state=1).as_matrix()
    scales, moves = rng.uniform(0.3, 3.0, (20, 1, 1)), rng.normal(size=(20, 1, 3))
    assert np.allclose(procrustes_aligned(scales * turned + moves, targets), targets)
    # A mirror image is no similarity without reflection.
    mirrored = targets * [-1.0, 1.0, 1.0]
    assert np.linalg.norm(procrustes_aligned(mirrored, targets) - targets, axis=2).mean() > 0.3
    # With noise no other rotation, scale or position is better.
    noisy = turned + 0.2 * rng.normal(size=targets.shape)
    fitted = procrustes_aligned(noisy, targets)
    least = ((fitted - targets) ** 2).sum()
    middle = fitted.mean(1, keepdims=True)
    for turn in Rotation.random(5, random_state=2).as_matrix():
        small = Rotation.from_matrix(turn).as_rotvec() * 0.02
        other = (fitted - middle) @ Rotation.from_rotvec(small).as_matrix() + middle
        assert ((other - targets) ** 2).sum() > least
    for scale in (0.98, 1.02):
        assert ((scale * (fitted - middle) + middle - targets) ** 2).sum() > least
    assert np.allclose(middle, targets.mean(1, keepdims=True))


def test_acceleration_is_that_of_consecutive_images():
    stamps = STEP * np.arange(10)
    t = np.arange(10.0)[:, None, None]
    true = np.tile(t**2, (1, 13, 3))
    assert acceleration_ratio(stamps, 3.0 * true + t, true) == pytest.approx(3.0)
    jump = true.copy()
    jump[6:] += 100.0
    assert acceleration_ratio(stamps, jump, true) > 10.0
    # A jump over images that are missing is none of the motion.
    gap = np.delete(np.arange(10), [4, 5])
    assert acceleration_ratio(stamps[gap], jump[gap], true[gap]) == pytest.approx(1.0)
    assert np.isnan(acceleration_ratio(stamps, true, 0.0 * true))
    assert np.isnan(acceleration_ratio(stamps[:2], true[:2], true[:2]))


def test_standing_feet_are_followed_in_the_world():
    record = made_record()
    assert np.isnan(standing_speed(record))
    left, right = (JOINTS.index(f'{side}_ankle') for side in ('left', 'right'))
    point = record.point.copy()
    point[:, left] = [0.1, 1.0, 4.0]
    point[:, left, 0] += 0.02 * np.arange(6)  # 0.2 m/s
    point[:, right, 1] = 10.0 * np.arange(6)
    contact = np.array([[True, False]] * 6)
    contact[0, 1] = True  # of the first image nothing is said of the one before
    standing = replace(record, point=point, contact=contact)
    assert standing_speed(standing) == pytest.approx(0.2)
    # A camera that moves and turns as the ankle does sees it at rest; in the world it moves.
    world = point[:, left]
    views = np.concatenate(
        [
            Rotation.from_rotvec([[0.0, 0.1 * i, 0.0] for i in range(6)]).as_matrix(),
            np.tile([[0.3], [0.1], [0.0]], (6, 1, 1)) + 0.05 * np.arange(6)[:, None, None],
        ],
        axis=2,
    )
    seen = point.copy()
    offset = world - views[:, :, 3]
    seen[:, left] = np.einsum('tij,ti->tj', views[:, :, :3], offset)
    assert standing_speed(replace(standing, point=seen, views=views)) == pytest.approx(0.2)
    assert np.isnan(standing_speed(replace(standing, contact=np.zeros((6, 2), dtype=bool))))


def test_bootstrap_interval():
    rng = np.random.default_rng(0)
    assert interval(np.full((5, 3), 7.0)) == (7.0, 7.0, 7.0)
    values = rng.normal(size=(12, 3))
    mean, low, high = interval(values)
    assert mean == pytest.approx(values.mean())
    assert low < mean < high
    assert interval(values) == (mean, low, high)
    assert interval(3.0 * values + 1.0) == pytest.approx((3 * mean + 1, 3 * low + 1, 3 * high + 1))
    # Clips alone: four times as many, half as wide.
    few, many = (interval(rng.normal(size=(n, 1))) for n in (50, 200))
    assert (few[2] - few[1]) / (many[2] - many[1]) == pytest.approx(2.0, rel=0.25)
    # A clip whose seeds differ widens the interval, though its mean is that of the others.
    still, shaken = np.zeros((4, 3)), np.zeros((4, 3))
    shaken[0] = [-1.0, 0.0, 1.0]
    assert interval(still)[1:] == (0.0, 0.0)
    assert interval(shaken)[1] < 0 < interval(shaken)[2]
    assert interval(values[:1]) == (pytest.approx(values[0].mean()), None, None)
    unknown = np.concatenate([values, np.full((1, 3), np.nan)])
    assert interval(unknown) == (mean, low, high)
    assert interval(unknown[-1:]) == (None, None, None)


def test_bootstrap_intervals_hold_the_mean_as_often_as_they_say():
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(200):
        clips = rng.normal(size=(20, 1)) + 0.3 * rng.normal(size=(20, 3))
        _, low, high = interval(clips, draws=400)
        held += low < 0.0 < high
    assert 0.88 < held / 200 < 0.99


def test_the_detectors_own_poses(tmp_path):
    """Poses that are the truth, seen from the hips, scaled; once the two sides are exchanged."""
    with np.load(REACH / 'truth.npz') as content:
        stamps, names = content['stamps'][:6], [str(x) for x in content['joint_names']]
        joints = content['joints'][:6]
        np.savez(tmp_path / 'truth.npz', stamps=stamps, joint_names=names, joints=joints)
    world = np.zeros((6, 33, 3))
    middle = joints[:, [names.index('left_hip'), names.index('right_hip')]].mean(1)
    for i, name in enumerate(LANDMARK_NAMES):
        name = name.replace('foot_index', 'toe')
        if name in names:
            world[:, i] = 1.1 * (joints[:, names.index(name)] - middle)
    content = {
        'stamps': stamps,
        'pixels': np.zeros((6, 33, 2)),
        'visibility': np.ones((6, 33)),
        'world': world,
        'detected': np.array([True, True, True, True, True, False]),
    }
    np.savez(tmp_path / 'keypoints_mediapipe.npz', **content)
    found = detector_scores(tmp_path)
    shared = [n for n in LANDMARK_NAMES if n in EVALUATED_JOINTS]
    assert len(shared) == 12
    apart = joints[:5, [names.index(n) for n in shared]] - middle[:5, None]
    assert found['point_mm'] == pytest.approx(0.1 * 1e3 * np.linalg.norm(apart, axis=2).mean())
    assert found['aligned_mm'] == pytest.approx(0.0, abs=1e-6)
    assert found['acceleration'] == pytest.approx(1.1)
    assert found['kept'] == pytest.approx(5 / 6)
    # Their names may be told, in another order.
    turn = np.random.default_rng(0).permutation(33)
    shuffled = {
        **content,
        'world': world[:, turn],
        'landmark_names': np.array(LANDMARK_NAMES)[turn],
    }
    np.savez(tmp_path / 'keypoints_mediapipe.npz', **shuffled)
    assert detector_scores(tmp_path) == pytest.approx(found)
    assert detector_scores(tmp_path, 5)['kept'] == 1.0
    with pytest.raises(ValueError, match='no keypoints_mediapipe'):
        detector_scores(REACH)


def test_without_the_image_terms_another_image_changes_nothing(clip, body):
    short = replace(clip, images=clip.images[:2], stamps=clip.stamps[:2])
    seen = {stamp: tracking_oracle.true_keypoints(clip, stamp, body) for stamp in short.stamps}
    # Lines of the scene refine the gravity that is given.
    settings = replace(keypoints_only(SMALL), ground=GroundSettings(0.0, 0.0))
    record = follow(short, new_tracker(short, body, settings, 0), 0, seen, gravity=GIVEN)
    grey = replace(short, images=[np.full_like(image, 128) for image in short.images])
    blind = follow(grey, new_tracker(grey, body, settings, 0), 0, seen, gravity=GIVEN)
    assert np.array_equal(record.joints, blind.joints, equal_nan=True)
    assert scores_of(record)['best_mm'] < 150


def test_runs_go_on_where_they_were(tmp_path, monkeypatch):
    """Of runs that were broken off only what is missing or damaged is done again.

    The first is done in a process of its own, the others in this one.
    """
    runs = [Run(REACH, IMAGES, seed, limit=2) for seed in (0, 1)]
    (first,) = run_all(runs[:1], 1, tmp_path)
    monkeypatch.setattr(
        'benchmarks.runs.in_processes', lambda work, items, *_: [work(item) for item in items]
    )
    paths = [tmp_path / f'{name_of(one)}.npz' for one in runs]
    (tmp_path / f'{name_of(runs[1])}.1.tmp.npz').write_bytes(b'half')
    written = paths[0].stat().st_mtime_ns
    both = run_all(runs, 1, tmp_path)
    assert paths[0].stat().st_mtime_ns == written
    assert np.array_equal(both[0].joints, first.joints, equal_nan=True)
    assert both[1].blind.shape == (2,)
    whole = paths[0].read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 255
    for damaged in (b'', b'no archive', whole[: len(whole) // 2], bytes(flipped)):
        paths[0].write_bytes(damaged)
        assert read_record(paths[0]) is None
    again = run_all(runs, 1, tmp_path)
    assert np.array_equal(again[0].joints, first.joints, equal_nan=True)
    assert np.array_equal(again[0].levels, first.levels)
    assert name_of(runs[0]) != name_of(replace(runs[0], changes=(('rounds', 2),)))
    assert (tmp_path / f'{name_of(runs[0])}.json').is_file()


def keep(folder, name, one, record):
    """A record as another checkout would have kept it, whose names are others."""
    (folder / f'{name}.json').write_text(json.dumps(one.identity))
    np.savez(folder / f'{name}.npz', **vars(record))


def test_records_of_another_checkout_are_found(tmp_path):
    changes = (('rounds', 2), ('likelihood.edges.weight', 0.0))
    one = Run(Path('here') / 'walk', BOTH, 1, changes, 5, rate=8.0)
    same = replace(one, folder=Path('elsewhere') / 'walk', changes=changes[::-1])
    first, second = made_record(seed=1), made_record(seed=2)
    keep(tmp_path, 'old', one, first)
    os.utime(tmp_path / 'old.json', (1, 1))
    assert np.array_equal(records_of([same], tmp_path)[0].true, first.true)
    keep(tmp_path, 'new', one, second)
    (found,) = records_of([same], tmp_path)
    assert np.array_equal(found.true, second.true)
    others = [
        replace(one, folder=Path('here') / 'kick'), replace(one, inputs=IMAGES),
        replace(one, seed=2), replace(one, changes=changes[:1]), replace(one, limit=None),
        replace(one, rate=3.0), replace(one, start=KEYPOINTS), replace(one, size=0.5),
        replace(one, gravity=GIVEN),
    ]  # fmt: skip
    assert records_of(others, tmp_path) == [None] * len(others)
    # A damaged record leaves the one before it; a file of another kind is none.
    (tmp_path / 'new.npz').write_bytes(b'half')
    (tmp_path / 'other.json').write_text('[1]')
    (tmp_path / 'broken.json').write_text('{')
    assert np.array_equal(records_of([one], tmp_path)[0].true, first.true)
    # What older records do not tell is unknown, or usual.
    content = {
        name: x
        for name, x in vars(first).items()
        if name not in ('statuses', 'cpu_seconds', 'lagged')
    }
    np.savez(tmp_path / 'old.npz', **content)
    told = {name: x for name, x in replace(one, rate=0.0).identity.items() if name != 'rate'}
    (tmp_path / 'old.json').write_text(json.dumps(told))
    (found,) = records_of([replace(one, rate=0.0)], tmp_path)
    assert np.isnan([scores_of(found)[name] for name in ('nobody', 'lagged_mm')]).all()
    (tmp_path / 'empty').mkdir()
    with pytest.raises(ValueError, match='no records'):
        records_of([one], tmp_path / 'empty')


def test_the_first_error_ends_the_work():
    with pytest.raises(ValueError, match='invalid literal'):
        in_processes(int, ['1', 'one', *'23456789'], 1, 'numbers')
    assert in_processes(int, ['3', '1', '2'], 2, 'numbers') == [3, 1, 2]
    assert in_processes(int, [], 1, 'numbers') == []
    assert not multiprocessing.active_children()


def test_accuracy_over_the_bags(quick_runs, monkeypatch):
    monkeypatch.setenv('HMT_SHARED', 'nowhere')
    result = tracking.measure(only=['reach'], seeds=(0, 1), parts=('accuracy',))
    assert [(one.inputs, one.seed) for one in quick_runs] == [(IMAGES, 0), (IMAGES, 1)]
    assert result['without_keypoints'] == ['reach']
    (group,) = result['accuracy']
    (entry,) = group['clips']
    assert entry['heaviest_mm'] == pytest.approx(np.mean(entry['by_seed']['heaviest_mm']))
    assert 0 < entry['best_mm'] <= entry['heaviest_mm']
    assert entry['feet'] is None
    mean, low, high = group['means'][0]['point_mm']
    assert mean == pytest.approx(entry['point_mm'])
    assert low is None
    assert high is None
    text = tracking.as_text(result, markdown=True)
    assert 'Without keypoints of a detector, images alone: reach.' in text
    assert 'Other clips: errors in mm' in text
    assert 'settings were chosen on' not in text
    assert len([line for line in text.splitlines() if line.startswith('| clip')]) == 4
    assert (entry['nobody'], entry['rate']) == (0.0, 0.0)
    assert 0 < entry['cpu_ms'] < 1e5
    assert entry['evaluations'] <= entry['evaluations_99']
    assert group['medians'][0]['point_mm'] == pytest.approx(entry['point_mm'])
    assert json.loads(json.dumps(rounded(result), allow_nan=False))['accuracy']
    with pytest.raises(ValueError, match='none of the clips'):
        tracking.measure(only=['nobody'])


def test_clips_that_settings_were_chosen_on_are_apart():
    entries = [
        entry_of((clip, given, 0.0, UNKNOWN), [{'kept': share, 'feet': np.nan}])
        for clip, given, share in (
            ('turns', BOTH, 0.1), ('walk', KEYPOINTS, 0.2), ('walk', IMAGES, 0.3),
            ('kick', IMAGES, 0.5),
        )
    ]  # fmt: skip
    chosen, others = grouped(entries)
    assert [(x['clip'], x['inputs']) for x in chosen['clips']] == [
        ('kick', IMAGES), ('walk', IMAGES), ('walk', KEYPOINTS),
    ]  # fmt: skip
    assert [(x['inputs'], x['kept'][0]) for x in chosen['means']] == [
        (IMAGES, pytest.approx(0.4)), (KEYPOINTS, 0.2),
    ]  # fmt: skip
    assert chosen['means'][0]['feet'] == (None, None, None)
    assert [x['clip'] for x in others['clips']] == ['turns']


def test_means_and_medians_leave_out_clips_that_are_apart():
    entries = [
        entry_of((clip, given, rate, UNKNOWN), [{'kept': share}])
        for clip, given, rate, share in (
            ('exercise', IMAGES, 0.0, 0.0), ('walk', IMAGES, 3.0, 0.2), ('walk', IMAGES, 0.0, 0.3),
            ('kick', IMAGES, 0.0, 0.4), ('shoot', IMAGES, 0.0, 0.8),
        )
    ]  # fmt: skip
    chosen, apart = grouped(entries)
    assert [(x['inputs'], x['rate']) for x in chosen['means']] == [(IMAGES, 0.0), (IMAGES, 3.0)]
    assert chosen['means'][0]['kept'][0] == pytest.approx(0.5)
    assert [x['kept'] for x in chosen['medians']] == [0.4, 0.2]
    assert [x['clip'] for x in apart['clips']] == ['exercise']
    assert apart['means'] == apart['medians'] == []
    text = tracking.as_text(
        {'clips': 'here', 'seeds': [0], 'without_keypoints': [], 'accuracy': [chosen, apart]}
    )
    assert 'Clips that are in no mean: errors' in text
    lines = [line.split()[:3] for line in text.splitlines() if line.startswith('walk')]
    assert lines[:2] == [['walk', IMAGES, 'all'], ['walk', IMAGES, '3']]


def test_paired_differences():
    entries = [
        entry_of((clip, IMAGES, 0.0, UNKNOWN), [{'heaviest_mm': value} for value in values])
        for clip, values in (
            ('walk', (4.0, 5.0, 6.0)), ('kick', (-5.0, 0.0, 6.0)), ('shoot', (-2.0, -2.1, -2.2)),
            ('turns', (np.nan, 1.0, 1.0)), ('exercise', (1.0, 1.1, 1.2)),
        )
    ]  # fmt: skip
    chosen, others, apart = paired(entries, 'heaviest_mm')
    assert (chosen['clips'], chosen['above'], chosen['below']) == (3, ['walk'], ['shoot'])
    assert chosen['difference'][0] == pytest.approx(np.mean([5.0, 1 / 3, -2.1]))
    assert (others['above'], others['below'], others['difference'][0]) == ([], [], None)
    assert (apart['above'], apart['difference'][0]) == (['exercise'], None)


def test_intervals_over_few_seeds_hold_the_mean_as_often_as_they_say():
    rng = np.random.default_rng(0)
    ends = [interval_over_seeds(rng.normal(size=5)) for _ in range(2000)]
    assert np.mean([low < 0.0 < high for low, high in ends]) == pytest.approx(0.95, abs=0.015)
    assert interval_over_seeds(np.array([1.0])) is None
    assert interval_over_seeds(np.array([1.0, np.nan])) is None


def test_settings_are_compared_on_the_same_runs(quick_runs, monkeypatch):
    monkeypatch.setenv('HMT_SHARED', 'nowhere')
    changes = (('max_hypotheses', 2), ('iterations', 5))
    asked = {'only': ['reach'], 'inputs': [IMAGES], 'seeds': (0,), 'parts': ()}
    result = tracking.measure(**asked, against=changes)
    assert [one.changes for one in quick_runs] == [(), changes]
    found = result['against']
    (entry,) = found['groups'][0]['clips']
    ours, theirs = (scores_of(record) for record in tracking.run_all(quick_runs[:2]))
    for column in tracking.COMPARED:
        if column.key == 'cpu_ms':
            continue
        difference = theirs[column.key] - ours[column.key]
        assert entry[column.key] == pytest.approx(difference)
        assert found['means'][0][column.key][0] == pytest.approx(difference)
    assert entry['best_mm'] != 0.0
    text = tracking.as_text(result)
    assert 'max_hypotheses=2, iterations=5 minus the usual settings' in text
    assert f'{entry["best_mm"]:+.1f}' in text
    same = tracking.measure(**asked, against=(('max_hypotheses', 4),))
    assert same['against']['means'][0]['heaviest_mm'][0] == 0.0


def test_a_checkout_is_compared_with_the_one_before(quick_runs, monkeypatch, tmp_path):
    monkeypatch.setenv('HMT_SHARED', 'nowhere')
    given = {'only': ['reach'], 'inputs': [IMAGES], 'parts': (), 'rates': (30.0, 3.0)}
    tracking.measure(**given, seeds=(0,), baseline=None)
    seen = [Run(REACH, IMAGES, 0), Run(REACH, IMAGES, 0, rate=3.0)]
    (mine,) = tracking.run_all(seen[:1])
    keep(tmp_path, 'before', seen[0], replace(mine, joints=mine.joints + 0.0, point=mine.point))
    found = tracking.measure(**given, seeds=(0,), baseline=tmp_path)['baseline']
    assert found['lacking'] == [['reach', IMAGES, 3.0, UNKNOWN]]
    (entry,) = found['groups'][0]['clips']
    assert entry['heaviest_mm'] == entry['best_mm'] == 0.0
    (pair,) = found['paired']
    assert (pair['clips'], pair['difference'][0], pair['above']) == (1, 0.0, [])
    text = tracking.as_text(
        {'clips': 'here', 'seeds': [0], 'without_keypoints': [], 'baseline': found}, markdown=True
    )
    assert f'reach, images, rate 3, gravity unknown: not in {tmp_path}.' in text
    assert '| Other clips | images | all  | unknown |     1 |' in text
    assert quick_runs[-1] == seen[0]
    with pytest.raises(ValueError, match='lacks seeds'):
        tracking.measure(**given, seeds=(1,), baseline=tmp_path)


def test_rules_fit_the_settings(capsys):
    names = [rule.name for rule in tracking_rules.RULES]
    assert len({*names}) == len(names)
    assert not {*names} & {*tracking_rules.GROUPS_OF_RULES}
    for rule in tracking_rules.RULES:
        assert rule.group in tracking_rules.GROUPS_OF_RULES
        assert {*rule.inputs} <= {*INPUTS}
        assert changed(rule.changes) != TrackerSettings(), rule.name
    some = tracking_rules.rules_named(['limb_search', tracking_rules.WEIGHTS])
    assert {rule.group for rule in some} == {tracking_rules.WEIGHTS, tracking_rules.PROPOSALS}
    assert tracking.main(['--rules', 'nothing']) == 1
    assert 'no rule or group of rules nothing' in capsys.readouterr().err


def test_the_tracker_without_rules(quick_runs, monkeypatch, capsys):
    monkeypatch.setenv('HMT_SHARED', 'nowhere')
    usual = TrackerSettings().iterations
    rules = (
        tracking_rules.Rule('combined', 'proposals', (('combinations', 8),)),
        tracking_rules.Rule('removed', 'weights', (('no_such_setting', 0.0),)),
        tracking_rules.Rule('off', 'weights', (('iterations', usual),)),
        tracking_rules.Rule('detector', 'cues', (('iterations', 2),), (KEYPOINTS,)),
    )
    monkeypatch.setattr(tracking_rules, 'RULES', rules)
    result = tracking.measure(
        only=['reach'], inputs=[IMAGES], parts=('rules',),
        plan=tracking_rules.Plan((0, 1), (30.0, 3.0)),
    )  # fmt: skip
    found = result['rules']
    assert [*found['skipped']] == ['removed', 'off']
    assert 'no_such_setting' in capsys.readouterr().err
    assert [one.changes for one in quick_runs] == [()] * 4 + [rules[0].changes] * 4
    assert [one.rate for one in quick_runs[:4]] == [0.0, 0.0, 3.0, 3.0]
    (effect,) = found['rules']
    ours, theirs = (scores_of(tracking.run_all([quick_runs[i]])[0]) for i in (0, 4))
    means = effect['groups'][0]['means'][0]
    assert means['best_mm'][0] == pytest.approx(theirs['best_mm'] - ours['best_mm'])
    text = tracking.as_text(result, markdown=True)
    assert 'Skipped: off: the tracker does without it.' in text
    (line,) = [x for x in text.splitlines() if x.startswith('| proposals | combined | images |')][
        :1
    ]
    assert f'{round(means["heaviest_mm"][0], 1) + 0.0:+.1f}' in line
    assert json.loads(json.dumps(rounded(result), allow_nan=False))['rules']


def test_settings_that_do_not_exist_are_told(capsys):
    assert tracking.main(['--against', 'max_hypothesis=4']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'max_hypothesis' in line


def test_ablations_share_the_usual_runs(quick_runs, monkeypatch):
    monkeypatch.setattr(tracking, 'ABLATIONS', (('max_hypotheses', 2), ('max_hypotheses', 8)))
    found = tracking.ablations([REACH], 2)
    assert [one.changes for one in quick_runs] == [(('max_hypotheses', 2),), ()]
    assert found['clips'] == ['reach']
    assert [row['value'] for row in found['rows']] == [2, 8]
    text = tracking.as_text(
        {'clips': 'here', 'seeds': [0], 'without_keypoints': [], 'ablations': found}, markdown=True
    )
    assert sum(line.startswith('| max_hypotheses |') for line in text.splitlines()) == 2


def test_smaller_images_are_those_of_a_camera_with_fewer_pixels(clip, body):
    small = resized(clip, 0.5)
    assert small.camera.width == clip.camera.width // 2
    assert small.images[0].shape == (small.camera.height, small.camera.width, 3)
    assert small.background.shape == small.images[0].shape
    stamp = clip.stamps[0]
    points = clip.truth.joints[stamp]
    before, after = (x.camera.project(points) - x.pixels[stamp] for x in (clip, small))
    assert np.allclose(after, 0.5 * before, atol=1e-9)
    whole, half = (subject_of(x, body).keypoints for x in (clip, small))
    assert np.allclose(half.pixels + 0.5, 0.5 * (whole.pixels + 0.5))
    assert np.allclose(half.covariances, 0.25 * whole.covariances)
    run = Run(REACH, IMAGES, 0, limit=2)
    assert name_of(run) != name_of(replace(run, size=0.5))
    with pytest.raises(ValueError, match=r'size 1, saw 0\.5'):
        run_one(replace(run, inputs=KEYPOINTS, size=0.5))


def test_errors_by_size(monkeypatch):
    errors = {0.25: (150.0, 130.0), 0.5: (90.0, 110.0), 1.0: (100.0, 100.0)}
    monkeypatch.setattr(tracking, 'run_all', lambda runs, _processes=0: runs)
    monkeypatch.setattr(
        tracking, 'scores_of', lambda one: {'heaviest_mm': errors[one.size][one.seed]}
    )
    found = tracking.errors_by_size(REACH, (0, 1), 2)
    assert [row['heaviest_mm'] for row in found['rows']] == [140.0, 100.0, 100.0]
    assert found['largest_difference'] == pytest.approx(0.4)
    text = tracking.as_text(
        {'clips': 'here', 'seeds': [0, 1], 'without_keypoints': [], 'sizes': found}
    )
    assert 'reach with smaller images' in text
    assert '40 % at most' in text


def test_the_oracle_starts_at_the_truth():
    cases = tracking_oracle.of_clip(REACH, 1)
    of = {(case['lengths'], case['silhouette'], case['terms']): case for case in cases}
    assert len(of) == len(cases) == 2 * (2 + 2 * 3)
    # The truth of this clip is of the same body, with lengths that were measured to 5 mm.
    assert 0 < of[tracking_oracle.OF_SUBJECT, '-', tracking_oracle.BEST_POSE]['error_mm'] < 5
    exact = of[tracking_oracle.TRUE, '-', tracking_oracle.BEST_POSE]
    assert exact['error_mm'] < 0.5
    assert exact['absolute_depth_percent'] < 0.01
    assert all(0 < case['error_mm'] < 300 for case in cases)
    found = {'every': 10, 'clips': {'reach': cases}, 'mean_of': ['reach']}
    found['means'] = tracking_oracle.means_of(found['clips'])
    text = tracking_oracle.as_text(found, markdown=True)
    assert sum(line.startswith('| true') for line in text.splitlines()) == 8


def test_lengths_of_the_truth(clip, body):
    with np.load(REACH / 'truth.npz') as content:
        true = content['joints']
    found = tracking_oracle.with_true_lengths(body.with_stature(1.5), clip).segment_lengths
    # The clip was rendered with this body.
    for name, length in body.segment_lengths.items():
        assert found[name] == pytest.approx(length, abs=6e-3), name
    few = replace(clip.truth, joint_names=EVALUATED_JOINTS, joints={0: true[0, :13]})
    kept = tracking_oracle.with_true_lengths(body, replace(clip, truth=few)).segment_lengths
    assert kept['foot'] == body.segment_lengths['foot']


def test_an_optimum_at_the_truth_stays_there(clip, body):
    """Keypoints alone, without prior, seen from the best pose."""
    stamps = clip.stamps[:1]
    true_body = tracking_oracle.with_true_lengths(body, clip)
    start = tracking_oracle.best_poses(true_body, clip, stamps, body.prior_mean[None])
    seen = [
        tracking_oracle.Observation(keypoints=tracking_oracle.true_keypoints(clip, stamps[0], body))
    ]
    settings = replace(
        tracking_oracle.LikelihoodSettings.of_terms(
            keypoints=tracking_oracle.LikelihoodSettings().keypoints
        ),
        prior_weight=0.0,
        self_intersection_sigma=np.inf,
    )
    found = tracking_oracle.optima(true_body, clip, settings, seen, start)
    assert tracking_oracle.errors_of(true_body, clip, stamps, found)['error_mm'] < 5


def test_stages_add_up_to_the_step(timed):
    found, before, after = timed
    assert before == after
    stages = found['stages_ms']
    assert sum(stages.values()) == pytest.approx(found['step_ms'])
    assert {'background', 'observation', 'predictions', 'candidates', 'keeping'} <= set(stages)
    assert stages['other'] < 0.2 * found['step_ms']
    assert found['ratio'] == pytest.approx(found['step_ms'] / found['opencv_ms'])
    assert found['images'] == 3


def test_memory_is_followed(clip):
    found = tracking_speed.memory(clip, 6)
    assert found['images'] == 6
    assert len(found['resident_mb']) == 6
    assert all(size > 10 for _, size in found['resident_mb'])
    assert 'after 6; ' in tracking_speed.memory_as_text(found)


def test_costs_are_told_in_floors():
    rows = tracking_speed.costs(REACH, 20)
    assert [(row['inputs'], row['rate']) for row in rows] == [(IMAGES, 0.0), (IMAGES, 3.0)]
    whole, slow = rows
    assert whole['images'] > slow['images'] > 0
    assert len(tracking_speed.costs(REACH, 8)) == 1  # too few at the lower rate
    assert whole['mean'] == pytest.approx(whole['cpu_ms'] / whole['floor_ms'])
    assert 1.0 < whole['median'] <= whole['most']
    lines = tracking_speed.costs_as_text(rows[:1], markdown=True).splitlines()
    assert lines[0].startswith('| clip')
    assert [x.strip() for x in lines[-1].split('|')[1:4]] == ['mean', 'images', 'all']


def test_speed_is_told(timed):
    text = tracking_speed.speed_as_text(timed[0], 2, markdown=True)
    assert text.startswith('reach 480x360, 3 images, 2 cores: ')
    assert '| candidates' in text


# Budgets.


def test_budgets_are_compared_on_the_same_images(quick_runs):
    some = [
        Run(REACH, given, seed, rate=rate)
        for given in (IMAGES, KEYPOINTS) for rate in (0.0, 3.0) for seed in (0, 1)
    ]  # fmt: skip
    rows = tracking_budgets.budgets(some)
    # Not one of the clips that settings were chosen on, so no smaller budgets.
    budgets = tracking_budgets.PROFILES.values()
    assert [(row['rate'], row['budget']) for row in rows] == [
        (rate, budget) for rate in (0.0, 3.0) for budget in budgets
    ]
    # Nothing is drawn where there are keypoints alone: one seed says all.
    assert len(quick_runs) == 2 * (4 + 2)
    assert {one.seed for one in quick_runs if one.inputs == KEYPOINTS} == {0}
    assert {dict(one.changes).get('evaluation_budget') for one in quick_runs} == {None, 300}
    text = tracking_budgets.budgets_as_text(rows)
    assert 'Other clips' in text
    assert '300, live' in text
    assert 'nan' not in text
