"""The benchmark of the tracker: scores of records with known answers, runs that are kept."""

import json
import multiprocessing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import tracking, tracking_oracle, tracking_speed
from benchmarks.clips import LANDMARK_NAMES, read_clip, resized, rounded
from benchmarks.runs import (
    BOTH,
    IMAGES,
    JOINTS,
    KEYPOINTS,
    Record,
    Run,
    follow,
    in_processes,
    keypoints_only,
    name_of,
    new_tracker,
    read_record,
    run_all,
    subject_of,
)
from benchmarks.runs import run as run_one
from benchmarks.stages import STAGES
from benchmarks.tracking_scores import (
    acceleration_ratio,
    detector_scores,
    interval,
    procrustes_aligned,
    scores_of,
    standing_speed,
)
from hmt_ros.body import load_body
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.tracking import TrackerSettings

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


@pytest.fixture
def quick_runs(monkeypatch, tmp_path):
    """The benchmark with runs of two images, by small trackers, in this process; the runs done."""
    done = []

    def run_here(runs, _processes=0):
        records = []
        for one in runs:
            short = read_clip(one.folder, 2)
            settings = replace(SMALL, **dict(one.changes))
            records.append(follow(short, new_tracker(short, load_body('human37'), settings, 0), 0))
            done.append(one)
        return records

    monkeypatch.setattr(tracking, 'run_all', run_here)
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
    contact[3:, 1] = [True, False, True]  # never in two consecutive images
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
    settings = keypoints_only(SMALL)
    record = follow(short, new_tracker(short, body, settings, 0), 0, seen)
    grey = replace(short, images=[np.full_like(image, 128) for image in short.images])
    blind = follow(grey, new_tracker(grey, body, settings, 0), 0, seen)
    assert np.array_equal(record.joints, blind.joints, equal_nan=True)
    assert scores_of(record)['best_mm'] < 150


def test_runs_go_on_where_they_were(tmp_path):
    """Of runs that were broken off only what is missing or damaged is done again."""
    runs = [Run(REACH, IMAGES, seed, limit=2) for seed in (0, 1)]
    (first,) = run_all(runs[:1], 1, tmp_path)
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
    assert len({line.count('|') for line in text.splitlines() if line.startswith('| reach')}) == 2
    assert json.loads(json.dumps(rounded(result), allow_nan=False))['accuracy']
    with pytest.raises(ValueError, match='none of the clips'):
        tracking.measure(only=['nobody'])


def test_clips_that_settings_were_chosen_on_are_apart():
    entries = [
        tracking._entry(clip, given, [{'kept': share, 'feet': np.nan}])
        for clip, given, share in (
            ('turns', BOTH, 0.1), ('walk', KEYPOINTS, 0.2), ('walk', IMAGES, 0.3),
            ('kick', IMAGES, 0.5),
        )
    ]  # fmt: skip
    chosen, others = tracking.grouped(entries)
    assert [(x['clip'], x['inputs']) for x in chosen['clips']] == [
        ('kick', IMAGES), ('walk', IMAGES), ('walk', KEYPOINTS),
    ]  # fmt: skip
    assert [(x['inputs'], x['kept'][0]) for x in chosen['means']] == [
        (IMAGES, pytest.approx(0.4)), (KEYPOINTS, 0.2),
    ]  # fmt: skip
    assert chosen['means'][0]['feet'] == (None, None, None)
    assert [x['clip'] for x in others['clips']] == ['turns']


def test_settings_are_compared_on_the_same_runs(quick_runs, monkeypatch):
    monkeypatch.setenv('HMT_SHARED', 'nowhere')
    changes = (('max_hypotheses', 2), ('rounds', 1))
    result = tracking.measure(inputs=[IMAGES], seeds=(0,), parts=(), against=changes)
    assert [one.changes for one in quick_runs] == [(), changes]
    found = result['against']
    (entry,) = found['groups'][0]['clips']
    ours, theirs = (scores_of(record) for record in tracking.run_all(quick_runs[:2]))
    for column in tracking.COMPARED:
        difference = theirs[column.key] - ours[column.key]
        assert entry[column.key] == pytest.approx(difference)
        assert found['means'][0][column.key][0] == pytest.approx(difference)
    assert entry['best_mm'] != 0.0
    text = tracking.as_text(result)
    assert 'max_hypotheses=2, rounds=1 minus the usual settings' in text
    assert f'{entry["best_mm"]:+.1f}' in text
    same = tracking.measure(inputs=[IMAGES], seeds=(0,), parts=(), against=(('max_hypotheses', 4),))
    assert same['against']['means'][0]['heaviest_mm'][0] == 0.0


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
    assert len(of) == len(cases) == 2 * (2 + 2 * 4)
    # The truth of this clip is of the same body, with lengths that were measured to 5 mm.
    assert 0 < of[tracking_oracle.OF_SUBJECT, '-', tracking_oracle.BEST_POSE]['error_mm'] < 5
    exact = of[tracking_oracle.TRUE, '-', tracking_oracle.BEST_POSE]
    assert exact['error_mm'] < 0.5
    assert exact['absolute_depth_percent'] < 0.01
    assert all(0 < case['error_mm'] < 300 for case in cases)
    found = {'every': 10, 'clips': {'reach': cases}, 'mean_of': ['reach']}
    found['means'] = tracking_oracle.means_of(found['clips'])
    text = tracking_oracle.as_text(found, markdown=True)
    assert sum(line.startswith('| true') for line in text.splitlines()) == 10


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


def test_speed_is_told(timed):
    text = tracking_speed.speed_as_text(timed[0], 2, markdown=True)
    assert text.startswith('reach 480x360, 3 images, 2 cores: ')
    assert '| candidates' in text
