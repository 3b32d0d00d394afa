"""The benchmark of experts runs on made-up motions, and what it compares is what it says."""

import json

import numpy as np
import pytest

from benchmarks import experts, experts_clips, experts_figures, experts_motion
from benchmarks.clips import find_clips, rounded
from benchmarks.experts_motion import COLUMNS, SeenMotion
from benchmarks.tracking_means import OF_CHOSEN
from hmt_ros.experts.pose_encoding import PoseEncoding
from hmt_ros.experts.pose_predictor import ALONE, BY_DYNAMICS, BY_EXPERTS
from hmt_ros.inference import GaussianMixture

NAMES = ('nearest', 'relevance-vector', 'joint')


@pytest.fixture(scope='module')
def made_up():
    return experts.made_up(120, frames=4)


@pytest.fixture(scope='module')
def found(made_up):
    return experts_motion.compared(*made_up, names=NAMES)


def test_motions_are_compared_by_activity(found):
    assert found['samples'] == 120
    assert found['frames'] == 2 * len(experts_motion.VIEWS) * 4
    for name in NAMES:
        scores = found[name]['alone']
        assert set(scores) == {'walk', 'dance', 'all'}
        for entry in scores.values():
            assert 0 < entry['best_mm'] <= entry['mm'] <= entry['max_mm']
            assert 0 < entry['best_degrees'] <= entry['degrees'] < 60
            assert 0 <= entry['coverage_50'] <= entry['coverage_90'] <= 1
    one = found['relevance-vector']['alone']['all']
    assert one['best_mm'] == one['mm']
    assert json.loads(json.dumps(rounded(found)))['samples'] == 120


def test_verdicts_name_what_misses(found):
    for one in found['wanted']:
        assert one['model'] == 'joint'
        assert one['met'] == (not one['missed']) or 'coverage' in one['what']
    verdict = experts_motion.verdict_of('joint', 'ratio', {'walk': 0.5, 'dance': 0.7}, 0.6)
    assert verdict['missed'] == ['dance']
    assert (verdict['value'], verdict['mean'], verdict['met']) == (0.7, pytest.approx(0.6), False)


def test_a_truth_that_is_known_has_no_error(made_up):
    learned, motions = made_up
    poses = motions[0].poses
    sharp = [GaussianMixture([1.0], pose[None], 1e-6 * np.eye(37)[None]) for pose in poses]
    scores = experts_motion.summary([experts_motion.frame_scores(learned.body, sharp, motions[0])])
    assert scores['mm'] == pytest.approx(0.0, abs=1e-9)
    assert scores['degrees'] == pytest.approx(0.0, abs=1e-9)
    assert scores['coverage_50'] == 1.0
    # A full turn more is the same angle; a tenth of a radian in one of 34 is not.
    turned = poses.copy()
    turned[:, 3] += 2.0 * np.pi
    turned[:, 7] += 0.1
    other = [GaussianMixture([1.0], pose[None], 1e-6 * np.eye(37)[None]) for pose in turned]
    scores = experts_motion.summary([experts_motion.frame_scores(learned.body, other, motions[0])])
    assert scores['degrees'] == pytest.approx(np.degrees(0.1) / 34)


@pytest.mark.parametrize('rule', [BY_EXPERTS, BY_DYNAMICS])
def test_propagation_goes_from_frame_to_frame(made_up, rule):
    learned, motions = made_up
    predictor, _ = experts_motion.predictor_of(learned, 'local')
    alone, after = (
        experts_motion.sequence_mixtures(predictor, motions[0], x) for x in (ALONE, rule)
    )
    np.testing.assert_array_equal(alone[0].means, after[0].means)
    assert max(len(mixture) for mixture in after) <= experts_motion.BEST_OF
    assert any(len(a) != len(b) or not np.allclose(a.means, b.means)
               for a, b in zip(alone[1:], after[1:], strict=True))  # fmt: skip


def test_two_groups_are_told_from_one():
    rng = np.random.default_rng(0)
    one = rng.normal(size=(30, 5))
    two = one + 20.0 * (np.arange(30) % 2)[:, None]
    assert not experts_motion.two_groups(one)
    assert experts_motion.two_groups(two)
    lonely = one + 20.0 * (np.arange(30) == 3)[:, None]
    assert not experts_motion.two_groups(lonely)


def test_neighbours_of_both_kinds_make_an_activity_ambiguous(made_up):
    learned, motions = made_up
    shares = experts_motion.ambiguous_share(learned, motions)
    assert set(shares) == {'walk', 'dance'}
    assert all(0 <= share <= 1 for share in shares.values())
    encoded = PoseEncoding(learned.body).encode(motions[0].poses)
    assert encoded.shape == learned.training.targets[: len(encoded)].shape
    assert isinstance(motions[0], SeenMotion)


def test_clips_of_the_repository(monkeypatch, tmp_path):
    monkeypatch.setenv('HMT_SHARED', str(tmp_path))
    folders, _ = find_clips(None)
    found = experts_clips.of_clip((next(x for x in folders if x.name == 'reach'), 4))
    assert set(found) == {'true', 'subtracted'}
    for entry in found.values():
        assert 0 < entry['best_mm'] <= entry['heaviest_mm']
        assert entry['depth_error'] < 0.5


def test_without_development_data_the_reason_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv('HMT_SHARED', str(tmp_path))
    assert 'is absent' in experts.motion(quick=True)
    assert experts_figures.draw(tmp_path / 'figures').startswith('skipped: ')


def test_reports(found):
    keys = (
        'best_mm', 'heaviest_mm', 'depth_error', 'coverage_90', 'joint_coverage_90',
        'propagated_best_mm', 'propagated_heaviest_mm',
    )  # fmt: skip
    clip = dict.fromkeys(keys, 1.0)
    masks = {'true': clip, 'subtracted': {**clip, 'best_mm': 1.5}}
    rows = {'clips': {'walk': masks}, 'means': {OF_CHOSEN: masks}}
    rows['wanted'] = experts_clips.wanted(rows['means'])
    assert [one['met'] for one in rows['wanted']] == [True, False]
    result = {
        'machine': {'cores': 2},
        'oracle': 'absent: scikit-learn is not installed',
        'motion': found,
        'clips': rows,
        'figures': ['walk.png'],
        'speed': {
            'descriptor_ms': 2.0, 'whole_ms': 9.0,
            'prediction_ms': dict.fromkeys(COLUMNS, 0.5),
        },
    }  # fmt: skip
    text = experts.as_text(result)
    assert 'absent: scikit-learn' in text
    assert 'missed' in text
    markdown = experts.as_text(result, markdown=True).splitlines()
    assert sum(line.startswith(f'| {OF_CHOSEN}') for line in markdown) == 4
    assert 'figures: walk.png' in text
    assert 'motion: skipped: no' in experts.as_text({'motion': 'skipped: no', 'clips': 'skipped'})
