import re
from pathlib import Path

import pytest

from hmt_learning.app import train
from hmt_ros.experts.pose_predictor import PosePredictor

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  End Site
  {
    OFFSET 0 10 0
  }
}
MOTION
Frames: 2
Frame Time: 0.033
0 0 0 0 0 0
0 0 0 0 0 0
"""


@pytest.fixture(autouse=True)
def short_motions(monkeypatch):
    monkeypatch.setattr(train, 'PROCEDURAL_SECONDS', 2.5)
    monkeypatch.setattr(train, 'PROCEDURAL_SEEDS', 2)


@pytest.fixture
def no_figures(monkeypatch):
    monkeypatch.setattr(train, 'write_report', lambda *_: [])


def test_procedural_motions_give_a_model_and_figures(tmp_path, capsys, monkeypatch):
    output = tmp_path / 'model.npz'
    arguments = ['--motions', 'reach', '--model', 'local', '--samples', '120', '--seed', '3']
    arguments += ['--dynamics', '--acknowledgement', 'Thanks.']
    assert train.main([*arguments, '-o', str(output)]) == 0
    predictor = PosePredictor.load(output)
    assert predictor.body.name == 'human37'
    assert predictor.dynamics is not None
    assert predictor.notes['samples'] == 120
    assert predictor.notes['source'] == 'Thanks.'
    assert predictor.notes['motions'] == ['reach 3', 'reach 4']
    assert predictor.notes['seconds'] == 5
    figures = sorted(x.name for x in (tmp_path / 'model_report').iterdir())
    assert figures == ['affinities.png', 'multimodality.png', 'silhouettes.png']
    for name in figures:
        assert (tmp_path / 'model_report' / name).read_bytes()[:4] == b'\x89PNG'
    assert '2 motions, ' in capsys.readouterr().out
    # The same again, without the figures.
    monkeypatch.setattr(train, 'write_report', lambda *_: [])
    again = tmp_path / 'again.npz'
    assert train.main([*arguments, '-o', str(again), '--quiet']) == 0
    assert again.read_bytes() == output.read_bytes()
    assert capsys.readouterr().out == ''


@pytest.mark.usefixtures('no_figures')
def test_broken_motions_are_skipped_and_counted(
    mocap_walk, tmp_path, read_here, capsys, monkeypatch
):
    monkeypatch.setattr(train, 'TESTED', 100)
    folder = tmp_path / 'motions'
    (folder / 'deeper').mkdir(parents=True)
    (folder / 'deeper' / 'fine_walk.bvh').write_bytes(mocap_walk.read_bytes())
    (folder / 'broken.bvh').write_text('HIERARCHY\nROOT Hips\n{\n')
    (folder / 'unknown.bvh').write_text(BVH)
    (folder / 'alone.amc').write_text(':DEGREES\n1\nroot 0 0 0 0 0 0\n')
    output = tmp_path / 'model.npz'
    arguments = ['--mocap', str(folder), '-o', str(output), '--samples', '60', '--model', 'local']
    assert train.main(arguments) == 0
    captured = capsys.readouterr()
    warnings = [x for x in captured.err.splitlines() if x.startswith('train: skipped')]
    assert sorted(x.split()[2] for x in warnings) == ['alone.amc:', 'broken.bvh:', 'unknown.bvh:']
    assert '1 motions, 3 skipped' in captured.out
    assert len(PosePredictor.load(output).notes['motions']) == 1
    read_here()
    # People are left out by name, and other people are the test set.
    more = ['--without', 'broke*', '--test', str(folder / 'deeper'), '--overwrite']
    assert train.main([*arguments, *more]) == 0
    assert '1 motions, 2 skipped' in capsys.readouterr().out
    notes = PosePredictor.load(output).notes
    assert notes['scored on'] == ['fine_walk']
    assert re.match(r'\d+ mm heaviest, \d+ best of 5, ', notes['scores'])


@pytest.fixture(scope='module')
def mocap_walk():
    import os

    root = Path(__file__).resolve().parents[3]
    folder = Path(os.environ.get('HMT_SHARED', root / '..' / 'shared')) / 'mocap'
    path = folder / 'train' / 'cmu_07_01_walk.bvh'
    if not path.is_file():
        pytest.skip(f'no development motions in {folder} (set HMT_SHARED)')
    return path


def _fails(arguments, capsys):
    assert train.main([*arguments, '--model', 'local']) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert error[-1].startswith('train: ')
    return error[-1]


def test_bad_input_is_one_line(tmp_path, read_here, capsys):
    read_here()
    output = str(tmp_path / 'm.npz')
    empty = tmp_path / 'empty'
    empty.mkdir()
    cases = [
        (['-o', output], 'nothing to learn from'),
        (['-o', output, '--mocap', str(empty)], 'has no motion'),
        (['-o', output, '--mocap', str(tmp_path / 'absent')], 'wanted a folder or a motion'),
        (['-o', output, '--motions', 'swim'], "no motion 'swim'"),
        (
            ['-o', str(tmp_path / 'x' / 'm.npz'), '--motions', 'walk'],
            'its folder is missing or not',
        ),
        (['-o', output, '--motions', 'walk', '--samples', '3'], 'from 50'),
        (['-o', output, '--motions', 'walk', '--body', 'nobody'], 'nobody'),
        (['--motions', 'walk'], '-o'),
    ]
    for arguments, wanted in cases:
        assert wanted in _fails(arguments, capsys)
    (empty / 'broken.bvh').write_text('nothing')
    given = ['-o', output, '--mocap', str(empty)]
    assert 'none of the 1 motions' in _fails(given, capsys)
    assert "no motion is called 'x*'" in _fails([*given, '--without', 'x*'], capsys)
    assert not Path(output).exists()
