"""The benchmarks run, and what they compare is comparable. Times are printed, never asserted."""

import json
import multiprocessing
import time
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from benchmarks import (
    absence,
    bags,
    contour_noise,
    depth,
    distance,
    flips,
    gate,
    joint_errors,
    kernels,
    keypoint_noise,
    kjs,
    live,
    nodes,
    real_video,
    rolled,
    unseen,
    vertical,
    votes,
)
from benchmarks.__main__ import main
from benchmarks.clips import find_clips, read_clip, table
from benchmarks.command import run_stages
from benchmarks.machine import best_time, forget_peak, peak_memory, resident_memory
from benchmarks.stages import StageClock
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera, load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import Status
from msg_tools import RosbagsMessages
from msg_tools.files.plain_yaml import read_plain_yaml
from msg_tools.messages.cdr import serialise
from msg_tools.messages.keep_out import KeepOut, KeepOutState, keep_out_message

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope='module')
def clip():
    return read_clip(ROOT / 'bags' / 'reach', 4)


@pytest.fixture
def one_clip(tmp_path):
    """A folder that holds the bag `reach` alone."""
    folder = tmp_path / 'clips'
    folder.mkdir()
    (folder / 'reach').symlink_to(ROOT / 'bags' / 'reach')
    return folder


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def timed_flips():
    return flips.measure(seconds=0.0)


def test_the_tree_that_is_timed_has_1024_leaves(body, timed_flips):
    pose, chains = flips.pose_with_leaves(body, flips.LEAVES)
    assert len(enumerate_flips(body, pose[None], list(chains))[0]) == 1024
    result = timed_flips
    first = next(iter(result['cases'].values()))
    assert (first['poses'], first['leaves']) == (1, 1024)
    assert all(case['us_per_leaf'] > 0 for case in result['cases'].values())
    assert result['dgemm_gflops'] > 0
    whole = result['whole_body']
    assert whole['leaves'] == flips.MOST_LEAVES
    assert whole['trunks'] > whole['poses']
    assert set(whole['us_per_leaf']) == set(whole['us_per_leaf_at_yardstick'])
    assert 50 < whole['peak_mb'] < 600
    assert 'most probable first' in flips.as_text(result)


def test_both_read_the_same_bags_and_memory_is_followed(tmp_path):
    found = bags.reading(tmp_path, 0.002, rounds=1)
    assert [case['messages'] for case in found] == [10, 10, 100, 100]
    for case in found:
        assert case['ratio'] == pytest.approx(
            case['ours_mb_per_s'] / case['rosbags_mb_per_s'], rel=1e-9
        )
    assert bags.read_our_bytes(tmp_path / 'states') == bags.read_their_bytes(tmp_path / 'states')
    assert bags.read_our_messages(tmp_path / 'states') == bags.read_their_messages(
        tmp_path / 'states'
    )
    remembered = bags.memory(tmp_path, 20_000_000)
    assert 0.019 < remembered['gb'] < 0.021
    assert [share for share, _ in remembered['resident_mb']][-1] == 1.0
    assert remembered['growth_mb'] < 32
    text = bags.as_text({'reading': found, 'memory': remembered}, markdown=True)
    assert 'images of 100 kB, as bytes' in text
    assert '0.02 GB' in text


def test_time_in_estimators_is_counted_once():
    class Inner:
        def step(self):
            time.sleep(0.02)

    class Outer:
        def step(self):
            Inner().step()

    before = Outer.step
    clock = StageClock(((Outer, 'step', bags.ESTIMATE), (Inner, 'step', bags.ESTIMATE)))
    with clock.running():
        start = time.perf_counter()
        Outer().step()
        spent = time.perf_counter() - start
    assert 0.02 <= clock.seconds[bags.ESTIMATE] <= spent
    assert Outer.step is before
    case = {'what': 'filter', 'clip': 'walk', 'images': 2, 'estimate_ms': 100.0, 'added_ms': 9.0}
    text = bags.as_text({'replay': [{**case, 'share': 0.09, 'met': True}]})
    assert '9.0 %' in text


def test_jumps_are_minima_and_cheap(monkeypatch):
    monkeypatch.setattr(kjs, 'RUNS', 1)
    monkeypatch.setattr(kjs, 'MOST_LEAVES', 200)
    result = kjs.measure(count=40, frontal=1)
    rows = {(r['sampler'], r['scale']): r for r in result['rows']}
    assert len(rows) == len(kjs.PARTITIONS) + 2 * len(kjs.SCALES)
    arms, calves = (rows[name, ''] for name in list(kjs.PARTITIONS)[:2])
    assert arms['minima'] >= 0.99 * arms['samples'] > 100
    assert calves['minima'] >= 0.95 * calves['samples'] > 100
    random = [r for r in rows.values() if r['scale']]
    assert arms['cost'][0] < 0.01 * min(r['cost'][0] for r in random)
    assert all(r['samples'] == 40 and r['minima'] + r['unconverged'] <= 40 for r in random)
    assert all(r['alike'] <= r['minima'] for r in rows.values())
    text = kjs.as_text(result, markdown=True)
    assert text.count('| CSS') == text.count('| SS') == len(kjs.SCALES)


def test_the_pose_of_the_jumps_has_its_links_out_of_the_image_plane():
    human34 = load_body('human34')
    pose = kjs.chosen_pose(human34)
    assert kjs.out_of_plane(human34, pose[None])[0] > kjs.OUT_OF_PLANE
    # A leg that hangs straight down, seen from far away, is in the plane.
    pose[:] = 0.0
    pose[2] = 40.0
    assert kjs.out_of_plane(human34, pose[None])[0] < 0.03


def test_compiled_and_vectorised_code_compute_the_same(monkeypatch):
    monkeypatch.setattr(kernels, 'best_time', partial(best_time, least=1))
    result = kernels.measure(seconds=0.0)
    assert len(result['cases']) >= 9
    for case in result['cases']:
        assert case['difference'] < 1e-9, case
        assert case['numpy_ms'] > 0
        assert case['compiled_ms'] > 0
    rows = {row['what']: row for row in result['evaluation']}
    # The motion is one product with a matrix of 37 rows, a difference and a scalar product.
    assert rows['motion']['value']['flops'] == 2 * 37**2 + 4 * 37 + 2
    for kind in kernels.KINDS:
        parts = [rows[x][kind]['flops'] for x in ('keypoints', 'pose prior', 'motion')]
        assert 0 < sum(parts) < rows[kernels.ALL][kind]['flops']
    assert all(row['sums']['flops'] >= row['value']['flops'] for row in rows.values())
    assert 'of peak' in kernels.as_text(result)


def test_a_clip_of_the_repository(clip):
    assert clip.name == 'reach'
    assert len(clip.images) == len(clip.stamps) == 4
    assert clip.images[0].shape == clip.background.shape == (360, 480, 3)
    assert set(clip.stamps) <= set(clip.truth.joints)
    projected = clip.camera.project(clip.truth.joints[clip.stamps[2]])
    assert np.allclose(projected, clip.pixels[clip.stamps[2]])


def test_back_and_forth(clip):
    played = list(clip.back_and_forth(9))
    assert (np.diff([stamp for stamp, _ in played]) > 0).all()
    order = [next(i for i, x in enumerate(clip.images) if x is image) for _, image in played]
    assert order == [0, 1, 2, 3, 2, 1, 0, 1, 2]


def test_time_in_a_stage_is_not_charged_to_the_one_around_it():
    class Part:
        def search(self):
            self.rate()

        def rate(self):
            pass

    stages = ((Part, 'search', 'chain search'), (Part, 'rate', 'rating'))
    times = iter([0.0, 1.0, 3.0, 6.0, 10.0, 11.0])
    clock = StageClock(stages, times.__next__)
    with clock.running():
        Part().search()
        assert clock.seconds == {'chain search': 4.0, 'rating': 2.0}
        # Time between stages is charged to none.
        Part().rate()
    assert clock.seconds == {'chain search': 4.0, 'rating': 3.0}


def test_where_clips_come_from(tmp_path, monkeypatch):
    monkeypatch.setenv('HMT_SHARED', str(tmp_path))
    folders, source = find_clips(None)
    assert ROOT / 'bags' / 'reach' in folders
    assert 'absent' in source
    with pytest.raises(ValueError, match=r'truth\.npz'):
        find_clips(tmp_path)
    shared = tmp_path / 'video'
    shared.mkdir()
    (shared / 'mine').symlink_to(ROOT / 'bags' / 'reach')
    assert find_clips(None) == ([shared / 'mine'], 'development clips')


def test_votes():
    """Every vote finds minima, none more than it draws; films are tracked."""
    for vote in votes.VOTES:
        one = votes.new_minima('human34', vote, 0, 3, 6)
        assert 0 <= one['plausible_per_sample'] <= one['minima_per_sample'] < 1
        assert one == votes.new_minima('human34', vote, 0, 3, 6)
    film = votes.filmed('walk', 0, 2)
    tracked = [votes.tracked(film, count, 0) for count in votes.SEARCHED.values()]
    assert all(one['best_mm'] < 150 for one in tracked)
    assert tracked[0]['evaluations'] < tracked[1]['evaluations']
    summary = votes.summary_of([{'best_mm': 1.0}, {'best_mm': 3.0}])
    assert summary == {'best_mm': 2.0, 'best_mm_error': 1.0}


def test_robust_deviations_are_those_of_most_values():
    rng = np.random.default_rng(0)
    values = 0.01 * rng.normal(size=4000)
    values[:200] += 1.0
    assert contour_noise.robust_deviation(values) == pytest.approx(0.01, rel=0.1)


def drawn_distances(rho, images=80, rings=40):
    """Distances along one part whose neighbours correlate by rho, over two that are apart."""
    rng = np.random.default_rng(1)
    values = np.empty((images, rings))
    values[:, 0] = rng.normal(size=images)
    for r in range(1, rings):
        values[:, r] = rho * values[:, r - 1] + np.sqrt(1 - rho**2) * rng.normal(size=images)
    index = np.arange(images * rings)
    return contour_noise.Distances(
        0.005 * values.ravel(), np.zeros(len(index), dtype=int),
        np.zeros(len(index), dtype=bool), index % rings, index // rings,
    )  # fmt: skip


def test_correlation_along_a_contour():
    found = drawn_distances(0.6)
    for apart in (1, 2, 3):
        assert contour_noise.correlation(found, apart) == pytest.approx(0.6**apart, abs=0.06)
    # Other parts and other images do not count as neighbours.
    split = found._replace(parts=found.rings % 2)
    assert contour_noise.correlation(split, 2) == pytest.approx(contour_noise.correlation(found, 2))
    both = contour_noise.joined([found, found])
    assert len(np.unique(both.images)) == 160
    assert contour_noise.correlation(both, 1) == pytest.approx(contour_noise.correlation(found, 1))
    assert contour_noise.independent_points(80, [0.59, 0.39, 0.3]) == pytest.approx(22.5, abs=0.1)


def test_distances_of_contours_to_outlines(body):
    """Of silhouettes that are moved to the left by 2 px, at the sides of a person who stands."""
    camera = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
    poses = np.zeros((1, body.dimension))
    poses[0, 2] = 3.5
    scene = Scene(viewpoint=Viewpoint(distance=3.5), seed=2)
    (frame,) = render_frames(body, poses, camera, scene)
    found = contour_noise.contour_distances(body, camera, poses, [frame.mask])
    assert len(found.values) > 30
    assert abs(np.median(found.values)) < 1.0 / camera.magnification(3.5)
    moved = np.roll(frame.mask, -2, axis=1)
    other = contour_noise.contour_distances(body, camera, poses, [moved])
    assert np.array_equal(other.rings, found.rings)
    change = camera.magnification(3.5) * (other.values - found.values)
    assert change.max() > 1.5
    assert change.min() < -1.5
    assert np.abs(change).max() < 3.0


def test_the_file_of_contour_noise_is_that_which_is_read(body, tmp_path):
    found = drawn_distances(0.6)
    found = found._replace(
        parts=found.images % len(body.shapes), ahead=found.images // len(body.shapes) % 2 == 1
    )
    groups = len(dict.fromkeys(contour_noise.groups_of(body)))
    numbers = contour_noise.summary(found, body, np.zeros((groups, 5)))
    result = {'clips': ['walk', 'kick'], **numbers}
    path = tmp_path / 'noise.yaml'
    path.write_text(contour_noise.as_yaml(result))
    content = read_plain_yaml(path, 10_000)
    assert list(content) == [*numbers['groups'], 'other']
    shipped = ROOT / 'hmt_ros' / 'image' / 'contour_noise.yaml'
    assert sorted(content) == sorted(read_plain_yaml(shipped, 10_000))
    for name, row in numbers['groups'].items():
        wanted = [row[side]['deviation'] for side in ('side', 'ahead')]
        assert content[name] == pytest.approx(wanted, abs=6e-4)
    assert content['other'] == pytest.approx([0.005, 0.005], abs=0.0015)
    assert 'walk, kick' in contour_noise.as_text(result)


def test_without_the_clips_contour_noise_is_skipped(tmp_path, capsys):
    assert contour_noise.main(['--clips', str(tmp_path)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'contour_noise: skipped, {tmp_path} lacks truth.npz of walk')


def test_tables():
    rows = [['name', 'a'], ['long name', '1'], ['b', '22']]
    assert table(rows).splitlines() == ['name        a', 'long name   1', 'b          22']
    lines = table(rows, markdown=True).splitlines()
    assert lines[1] == '| --------- | -: |'
    assert lines[3] == '| b         | 22 |'


def test_command_line(capsys, tmp_path, monkeypatch, timed_flips):
    assert main(['--help']) == 0
    assert 'tracking' in capsys.readouterr().out
    assert main(['flops']) == 1
    assert capsys.readouterr().err.splitlines() == [
        "benchmarks: no 'flops', wanted one of absence, bags, blind, contour_noise, depth, "
        'distance, '
        'error_model, experts, flips, forecast, gate, hypotheses, joint_errors, keep_out, '
        'keypoint_noise, '
        'kernels, kjs, lifting, live, motion_prior, nodes, people, real_clips, real_video, '
        'rolled, smoothing, soak, strangers, '
        'tracking, unseen, vertical, votes'
    ]
    assert main(['tracking', '--clips', str(tmp_path)]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
    asked = []
    monkeypatch.setattr(flips, 'measure', lambda seconds: asked.append(seconds) or timed_flips)
    for options, seconds in (([], 1.0), (['--quick'], 0.1)):
        assert main(['flips', '--json', *options]) == 0
        assert json.loads(capsys.readouterr().out)['cases']
        assert asked.pop() == seconds


def test_stages_are_told_as_they_begin(capsys):
    seen = []
    stages = {name: lambda name=name: seen.append(name) or len(seen) for name in 'abc'}
    result = run_stages('letters', stages, ('c', 'a'))
    assert (list(result), result['a'], result['c']) == (['machine', 'a', 'c'], 1, 2)
    assert capsys.readouterr().err == 'letters: a, 1 of 2, at 0:00\nletters: c, 2 of 2, at 0:00\n'


def test_peak_memory_is_that_of_the_process_alone():
    forget_peak()
    assert peak_memory() == pytest.approx(resident_memory(), rel=0.05)
    block = np.ones(50_000_000)
    largest = peak_memory()
    assert largest > block.nbytes
    # A child that is started by one so large.
    with multiprocessing.get_context('spawn').Pool(1) as pool:
        assert pool.apply(peak_memory) < block.nbytes
    del block
    # The kernel counts by batches of pages.
    assert peak_memory() == pytest.approx(largest, rel=0.01)
    forget_peak()
    assert peak_memory() < largest - 3e8


def test_nodes_that_lose_images_are_told():
    found = {
        'rate_hz': 30.0, 'answered_hz': 20.0, 'images': 90, 'results': 60, 'wanted': 'all',
        'met': False, 'latency_ms': {'median': 4.0, '99 %': 9.0, 'largest': None},
    }  # fmt: skip
    text = nodes.as_text({'added, raw': found, '4': 'skipped: no ROS'})
    assert '60  4.0 ms  9.0 ms           missed, wanted all' in ' '.join(text.split('\n'))
    assert 'skipped: no ROS' in text
    assert nodes.prompt_feed('raw').images[0].data.size == 640 * 480 * 3


# keypoint_noise


def test_offset_of_a_landmark_is_found_among_outliers():
    rng = np.random.default_rng(0)
    offset = np.array([0.02, -0.03, 0.01])
    by_offset = rng.standard_normal((400, 2, 3))
    errors = by_offset @ offset + 0.003 * rng.standard_normal((400, 2))
    errors[:60] += 0.5
    np.testing.assert_allclose(keypoint_noise.robust_offset(by_offset, errors), offset, atol=0.002)


def test_correlation_of_keypoints_over_images():
    rng = np.random.default_rng(1)
    errors = [np.zeros((4000, 2))]
    for t in range(1, 4000):
        errors[0][t] = 0.8 * errors[0][t - 1] + 0.6 * 0.01 * rng.standard_normal(2)
    images = [np.arange(4000)]
    for apart in (1, 2):
        found = keypoint_noise.correlation(errors, images, apart)
        assert found == pytest.approx(0.8**apart, abs=0.05)
    assert np.isnan(keypoint_noise.correlation(errors[:1], [np.arange(0, 8000, 2)], 1))


# live


def test_live_tells_of_a_camera_that_does_not_wait():
    errors = {
        topic: {'heaviest_mm': 80.4, 'best_mm': 60.6}
        for topic in ('pose_mixture', 'smoothed_pose_mixture')
    }
    found = {
        'images': 480, 'lost': 2, 'answered': 120,
        'latency_ms': {'median': 151.2, '95 %': 190.0, '99 %': 201.0},
        'age_s': {'median': 0.75, '95 %': 0.9}, 'cpu_ms_per_pose': 210.0, 'nobody': 0,
        'memory_mb': 417.2, **errors,
    }  # fmt: skip
    text = live.as_text(
        {'offline': {'images': 480, **errors}, 'newest': found, 'queue': 'skipped: no ROS'}
    )
    offline, newest, queue = (' '.join(line.split()) for line in text.splitlines()[-3:])
    assert offline == 'offline, every image 480 0 100 % 80 mm 61 mm 80 mm'
    assert newest == (
        'processes apart: newest complete image 480 2 25 % 151 ms 190 ms 201 ms 210 ms 417 MB '
        '0 0.75 s 0.90 s 80 mm 61 mm 80 mm'
    )
    assert queue == 'queue_size 5 skipped: no ROS'
    seen = {'in_view': 40, 'in_view_tracked': 38, 'away': 90, 'away_not_nobody': 1}
    text = live.as_text({'visit': found | seen, 'people 2': found | {'people': 1.875}})
    lines = [' '.join(line.split()) for line in text.splitlines()]
    assert any(line.endswith('417 MB 0 38 of 40 1 of 90') for line in lines)
    assert lines[-1].endswith('417 MB 1.88')


def test_medians_of_runs():
    runs = [{'a': x, 'b': {'c': [2.0 * x, 1]}, 'd': x > 1, 'e': 'text'} for x in (3, 1, 2)]
    assert live.median_of(runs) == {'a': 2, 'b': {'c': [4.0, 1]}, 'd': True, 'e': 'text'}


def test_states_of_a_visit_are_counted_a_second_late(tmp_path, monkeypatch):
    """Somebody comes at image 20 and leaves at 50, of ten images a second."""
    monkeypatch.setattr(
        live, 'shares_in_view', lambda clip: {k: float(20 <= k < 50) for k in range(80)}
    )
    states = [KeepOutState.UNKNOWN] * 22 + [KeepOutState.TRACKING] * 30 + [KeepOutState.NOBODY] * 28
    none = np.empty((0, 3))
    messages = {
        k: serialise(
            keep_out_message(RosbagsMessages(), KeepOut(k, 'eye', state, none, none, np.empty(0)))
        )
        for k, state in enumerate(states)
    }
    found = live.told_of_a_visit(messages, tmp_path, 10.0)
    assert found == {
        'nobody': 0, 'in_view': 20, 'in_view_tracked': 20, 'away': 20, 'away_not_nobody': 0,
    }  # fmt: skip
    messages[30] = messages[79]
    assert live.told_of_a_visit(messages, tmp_path, 10.0)['nobody'] == 1


def test_depth_brings_tracks_nearer():
    """Six images of one rendered clip, without depth and with it."""
    result = depth.measure(quick=True)
    (entry,) = result['clips']
    for score in ('heaviest_mm', 'absolute_mm', 'start_mm'):
        assert entry['with'][score] < 0.85 * entry['without'][score]
    text = depth.as_text(result, markdown=True)
    assert f'| walk 0 | {entry["without"]["heaviest_mm"]:.0f} -> ' in ' '.join(text.split())
    assert result['speed']['with_ms'] > 0


def test_absence_counts_wrong_states(one_clip):
    """The person of the clip is seen at every rate, and the empty scene is noticed."""
    result = absence.measure(one_clip, rates=(2.0,), hypotheses=2, quick=True)
    assert [(x['gaps'], x['offset']) for x in result['film']] == [
        (False, 0.0), (False, 0.5), (True, 0.0), (True, 0.5),
    ]  # fmt: skip
    for case in result['film']:
        assert case['images'] == (12 if not case['gaps'] else 10)
        assert (case['nobody'], case['tracks']) == (0, 1)
    (empty,) = result['empty']
    assert empty['empty'] == 3 * 2
    assert (empty['nobody'], empty['unnoticed']) == (0, 0)
    assert 'not NOBODY' in absence.as_text(result)
    with pytest.raises(ValueError, match='no clip is called moon'):
        absence.measure(ROOT / 'bags', ['moon'])


@pytest.mark.parametrize('given', [0, 1])
def test_absence_tells_tracks_of_nobody_and_late_states(given):
    """A track in the first empty image, one of a person, and one that goes on for too long."""
    counts = absence.Counts(tracks=given)
    for i, (track, status) in enumerate(
        [(1, 'TRACKING'), (1, 'NOBODY'), (2, 'TRACKING'), (2, 'LOST'), (2, 'LOST'), (2, 'LOST')]
    ):
        tracker = SimpleNamespace(
            track_id=track, status=Status[status], existence_probability=1.0 - 0.1 * i
        )
        counts.add(tracker, 0.6 * i, here=i == 2, empty=i != 2)
    result = counts.result()
    assert (result['images'], result['nobody'], result['least_probability']) == (1, 0, 0.8)
    assert (result['tracks'], result['started']) == (2, 1 - given)
    # 1.2 s after the start of the second empty time.
    assert (result['empty'], result['unnoticed']) == (1, 1)
    case = {'inputs': 'images', 'clip': 'park', 'rate': 2.0} | result
    assert absence.as_text({'scenes': [case]}).split()[-9:] == [
        'images', '2', '1', '1', '0', '1', '1', str(1 - given), 'park',
    ]  # fmt: skip


# distance


def test_the_distance_of_the_demonstration_needs_keypoints(capsys):
    assert main(['distance', '--clips', str(ROOT / 'bags')]) == 1
    assert 'keypoints' in capsys.readouterr().err
    three = {'rms': 3 * [0.05], 'mean': 3 * [-0.01], 'said': 3 * [0.04]}
    text = distance.as_text({'cases': [{'known': 'stature', 'clips': 3} | three]}, markdown=True)
    row = text.splitlines()[-1].split('|')
    assert [x.strip() for x in row[1:-1]] == ['stature', '3', *(3 * ['5.0 (-1.0; 4.0)'])]


# gate


def test_the_gate_fails_where_a_step_costs_too_much(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gate, 'TABLE', tmp_path / 'gate.json')
    monkeypatch.setattr(gate, 'QUICK', 8)
    # What is measured is the same with --write and without.
    monkeypatch.setattr(gate, 'floors_of', cache(gate.floors_of))
    run = ['gate', '--quick', '--clips', str(ROOT / 'bags')]
    assert main(run) == 1
    assert '--write adds what is measured' in capsys.readouterr().err
    assert main([*run, '--write']) == 0
    assert 'met' in capsys.readouterr().out  # what has just been written
    known = gate.read_table(tmp_path / 'gate.json')
    (source,) = known
    floors = known[source]['images']['all']
    assert floors > 1.0
    limits = {source: {'images': {'all': floors}}}
    for factor, over in ((1.1, False), (1.2, True)):
        (row,) = gate.compared(source, {'images': {'all': factor * floors}}, limits)
        assert row['over'] == over
    text = gate.as_text({'rows': [row]})
    assert text.splitlines()[-1].endswith('too much')
    assert main(['gate', '--clips', str(ROOT / 'test')]) == 1


# vertical


def test_the_vertical_of_a_clip_is_seen(one_clip, capsys):
    result = vertical.measure(one_clip, quick=True)
    assert [one['clip'] for one in result['clips']] == ['reach']
    (one,) = result['clips']
    assert one['found'] == one['looks'] == len(one['errors'])
    assert max(one['errors']) < 2.0
    text = vertical.as_text(result, markdown=True)
    assert text.splitlines()[-1].startswith('| all')
    assert main(['vertical', '--clips', str(ROOT / 'test')]) == 1
    assert capsys.readouterr().err.startswith('vertical: ')


# rolled


@pytest.mark.parametrize('degrees', rolled.ANGLES)
def test_a_turned_camera_sees_the_same(degrees):
    lens = (-0.05, 0.1, 1e-3, -2e-3, 0.0)
    camera = Camera(600.0, 600.0, 310.0, 250.0, 640, 480, lens)
    made, pixels = rolled.turned(camera, degrees)
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (20, 3))
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = np.column_stack([points[:, :2] @ turn.T, points[:, 2]])
    wanted = camera.project(points) @ pixels[:, :2].T + pixels[:, 2]
    assert np.abs(made.project(moved) - wanted).max() < 1e-6
    assert degrees != 90 or (made.width, made.height) == (480, 640)


def test_turned_clips_are_compared(monkeypatch, capsys, tmp_path):
    mm = {0: 50.0, 15: 51.0, 90: 45.0, 180: 60.0}
    monkeypatch.setattr(rolled, 'in_processes', lambda _, work, *__: [mm[x[3]] for x in work])
    monkeypatch.setattr(rolled, 'find_clips', lambda *_, **__: ([tmp_path / 'walk'], 'clips'))
    (tmp_path / 'walk').mkdir()
    (tmp_path / 'walk' / 'keypoints_mediapipe.npz').touch()
    text = rolled.as_text(rolled.measure())
    assert text.splitlines()[1].split() == ['lift', 'walk', '50.0', '51.0', '45.0', '60.0', '+20']
    assert main(['rolled', '--names', 'none']) == 1
    assert capsys.readouterr().err.startswith('rolled: clips has no keypoints_mediapipe.npz of no')


# real_video


def test_a_contact_sheet_shows_a_clip(one_clip, tmp_path, monkeypatch, capsys):
    """Of as many images as the sheet has columns."""
    short = partial(read_clip, frames=real_video.COLUMNS)
    monkeypatch.setattr(real_video, 'read_clip', short)
    path, *_ = real_video.draw_sheets(tmp_path, one_clip, quick=True)
    sheet = cv2.imread(str(path))
    assert path.name == 'reach.png'
    assert sheet.shape == (3 * real_video.CELL, real_video.COLUMNS * real_video.CELL, 3)
    # The truth and the heaviest mode are drawn in every view.
    for row in np.split(sheet, 3):
        for colour in (real_video.TRUE, (0, 159, 230)):
            assert (np.abs(row.astype(int) - colour).max(2) < 12).any()
    assert main(['real_video', '--clips', str(tmp_path)]) == 0
    assert 'skipped' in capsys.readouterr().err


def test_scores_of_real_videos_are_told():
    one = {
        'clip': 'park', 'images': 3, 'held_out': 0.02, 'given': 0.01, 'feet': 0.1, 'standing': 2,
        'lengths': 0.003, 'empty': [0, 9],
    }  # fmt: skip
    row = real_video.as_text({'clips': [one]}, markdown=True).splitlines()[-1]
    assert [x.strip() for x in row.split('|')[1:-1]] == [
        'park', '3', '2.0', '1.0', '0.10 (2 steps)', '0.3', '0 of 9',
    ]  # fmt: skip


# joint_errors


def said(rng, count, share, error):
    """What modes say, of a truth that has a share of their covariances, and an error besides."""
    result = []
    for _ in range(count):
        root = 0.03 * rng.standard_normal((2, 3, 3))
        covariances = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(3)
        own = share * covariances[0] + error**2 * np.eye(3)
        off = rng.multivariate_normal(np.zeros(3), own)
        means = np.stack([off, off + 0.5])
        weights = np.array([0.9, 0.1])
        result += [
            joint_errors.Said('right_knee', kind, weights, means, covariances)
            for kind in (True, False)
        ]
    return result


def test_errors_of_joints_are_found_so_that_regions_hold():
    found = joint_errors.learned(said(np.random.default_rng(0), 600, 0.5, 0.02))
    best = max(found, key=lambda one: one['log_density'])
    assert best['share'] == 0.5
    assert best['relative'][1] == pytest.approx(0.9, abs=0.03)
    # The lighter of two modes, which is half a metre away, makes the regions wider.
    assert best['errors_mm'] == pytest.approx({'right_knee': 20.0}, abs=6.0)
    for one in found:
        # With a large t the regions hold more without any error.
        assert one['relative'][1] > 0.87
        assert one['absolute'] == pytest.approx(one['relative'], abs=0.03)
    text = joint_errors.as_text({'shares': found}, markdown=True)
    assert text.count('\n|') == 1 + len(joint_errors.SHARES)


def test_cut_clips_hide_what_is_below_or_beside(clip):
    stamp = clip.stamps[0]
    names = list(clip.truth.joint_names)
    ankles = [names.index(f'{side}_ankle') for side in ('left', 'right')]
    for cut in (unseen.WAIST, unseen.KNEES):
        shorter, area = unseen.cut_clip(clip, cut)
        rows = shorter.camera.height
        assert shorter.images[0].shape[0] == rows < clip.camera.height
        assert area[rows:].all()
        assert not area[:rows].any()
        assert unseen.is_hidden(area, clip.pixels[stamp][ankles]).all()
        assert not unseen.is_hidden(area, clip.pixels[stamp][[names.index('neck')]]).any()
    covered, area = unseen.cut_clip(clip, unseen.PILLAR)
    assert covered.images[0].shape == clip.images[0].shape
    assert (covered.images[0][area] == unseen.GREY).all()
    assert (covered.images[0][~area] == clip.images[0][~area]).all()
    assert unseen.is_hidden(area, np.array([[-5.0, 3.0], [np.nan, np.nan]])).all()


def test_hidden_keypoints_are_not_seen():
    area = np.zeros((10, 10), dtype=bool)
    area[5:] = True
    names, pixels = (
        ('neck', 'left_hip', 'left_knee'),
        np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 7.0]]),
    )
    keypoints = Keypoints(names, pixels, np.tile(np.eye(2), (3, 1, 1)), np.ones(3))
    assert unseen.shown(keypoints, area, {'left_hip'}).seen.tolist() == [True, False, False]
