"""The scripts that draw figures of the pages draw what they say."""

import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from benchmarks import hypotheses
from benchmarks.body_pictures import add_body, box_of, from_above
from benchmarks.tracking_means import OF_CHOSEN
from hmt_ros.body import Camera, load_body

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ('smoothing', 'sampling')


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def pose(body):
    """A pose of the prior, 3 m away."""
    rng = np.random.default_rng(3)
    sigma = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.0)
    result = np.clip(body.prior_mean + sigma * rng.normal(size=len(sigma)), body.lower, body.upper)
    result[body.skeleton.dof_index(['root_tx', 'root_ty', 'root_tz'])] = 0.0, 0.1, 3.0
    return result


@pytest.mark.parametrize('chain', ['left_arm', 'right_arm'])
def test_leaves_have_the_image_of_the_pose(body, pose, chain):
    sampling = runpy.run_path(str(ROOT / 'docs' / 'figures_sampling.py'))
    reached, pruned = sampling['leaves'](body, pose, chain)
    assert 1 <= len(reached) + len(pruned) <= 8
    every = np.concatenate([reached, pruned])
    lengths = np.linalg.norm(np.diff(every, axis=1), axis=2)
    np.testing.assert_allclose(lengths, np.tile(lengths[0], (len(every), 1)), atol=1e-6)
    pixels = every[:, :, :2] / every[:, :, 2:]
    np.testing.assert_allclose(pixels, np.tile(pixels[0], (len(every), 1, 1)), atol=1e-6)


def test_a_body_is_drawn_where_its_joints_are(body, pose):
    camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)
    joints = body.joint_positions(pose[None])[0]
    figure, axes = plt.subplots(1, 2)
    for ax, view in zip(axes, (camera, None), strict=True):
        add_body(ax, body, pose, view)
        points = camera.project(joints[None])[0] if view else from_above(joints, joints[0])
        drawn = np.concatenate([patch.get_xy() for patch in ax.patches])
        assert len(ax.patches) == len(body.shapes)
        size = np.ptp(points, axis=0).max()
        np.testing.assert_allclose(drawn.min(0), points.min(0), atol=0.2 * size)
        np.testing.assert_allclose(drawn.max(0), points.max(0), atol=0.2 * size)
    plt.close(figure)


def test_a_box_holds_known_points():
    left, right, bottom, top = box_of(np.array([[10.0, 20.0], [50.0, 120.0], [np.nan, 0.0]]))
    assert (left, right, bottom) == (0.0, 60.0, 130.0)
    assert top < 20.0


@pytest.mark.parametrize('name', FIGURES)
def test_figures_of_pages_exist_and_are_small(name):
    text = (ROOT / 'docs' / f'{name}.md').read_text('utf-8')
    drawn = sorted((ROOT / 'docs').glob(f'{name}_*.png'))
    assert drawn
    for path in drawn:
        assert f'({path.name})' in text, f'{name}.md does not show {path.name}'
    assert sum(path.stat().st_size for path in drawn) < 800_000


def test_numbers_of_modes_without_clips(tmp_path, monkeypatch):
    monkeypatch.setenv('HMT_SHARED', str(tmp_path))
    text = hypotheses.as_text(hypotheses.measure())
    assert text.startswith('skipped: ')
    assert 'walk' in text


def test_table_of_numbers_of_modes():
    row = {
        'group': OF_CHOSEN, 'modes': 4, 'clips': ['kick', 'walk'],
        'heaviest_mm': (70.4, 50.0, 99.0),
        'best_mm': (60.0, None, None), 'blind_mm': (65.0, 60.0, 70.0), 'evaluations': (400.2, 1, 2),
    }  # fmt: skip
    text = hypotheses.as_text({'rows': [row], 'images': 90, 'seeds': [0, 1]}, markdown=True)
    cells = [cell.strip() for cell in text.splitlines()[2].strip('|').split('|')]
    assert cells == ['kick, walk', '4', '70 (50 to 99)', '60', '65 (60 to 70)', '400']
