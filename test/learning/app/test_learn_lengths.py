"""`learn lengths` on motions of stick figures of different sizes."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from hmt_learning.app import learn
from hmt_ros.body import load_body

LEG = [('UpLeg', (0.1, -0.1, 0)), ('Leg', (0, -0.42, 0)), ('Foot', (0, -0.41, 0))]
LEG += [('ToeBase', (0, -0.03, 0.13))]
ARM = [('Arm', (0.18, 0.26, 0)), ('ForeArm', (0.28, 0, 0)), ('Hand', (0.23, 0, 0))]
TRUNK = [('Spine', (0, 0.15, 0)), ('Neck', (0, 0.28, 0)), ('Head', (0, 0.18, 0))]
CHANNELS = '3 Zrotation Xrotation Yrotation'


def write_figure(path: Path, size: float, arms: float = 1.0, hips: float = 1.0) -> Path:
    """Three frames of a T pose."""
    count = 0

    def chain(bones, side: int, factor: float) -> str:
        nonlocal count
        text, name = '', ('', 'Left', 'Right')[side]
        for bone, (x, y, z) in bones:
            first = hips if bone == 'UpLeg' else 1.0
            mirror = -1.0 if side == 2 else 1.0
            place = [mirror * x, first * y, z]
            offset = ' '.join(f'{size * factor * v:.5f}' for v in place)
            text += f'JOINT {name}{bone}\n{{\nOFFSET {offset}\nCHANNELS {CHANNELS}\n'
            count += 1
            if bone == 'Spine':
                text += chain(ARM, 1, arms) + chain(ARM, 2, arms)
        return text + 'End Site\n{\nOFFSET 0 0.05 0\n}\n' + '}\n' * len(bones)

    body = chain(LEG, 1, 1.0) + chain(LEG, 2, 1.0) + chain(TRUNK, 0, 1.0)
    channels = '6 Xposition Yposition Zposition Zrotation Xrotation Yrotation'
    head = f'HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\nCHANNELS {channels}\n{body}}}\n'
    row = ' '.join(['0', f'{0.95 * size:.3f}', '0', *['0'] * (3 * count + 3)])
    path.write_text(f'{head}MOTION\nFrames: 3\nFrame Time: 0.033333\n' + f'{row}\n' * 3)
    return path


def test_people_give_the_spreads_of_the_yaml_file(tmp_path, capsys):
    for name, size, arms in (('a', 0.95, 1.05), ('b', 1.0, 0.93), ('c', 1.06, 1.0)):
        write_figure(tmp_path / f'{name}_one.bvh', size, arms)
        write_figure(tmp_path / f'{name}_shared.bvh', 1.15)
    write_figure(tmp_path / 'd_odd.bvh', 1.0, 1.2, hips=-1.0)
    table = tmp_path / 'index.csv'
    names = sorted(path.name for path in tmp_path.glob('*.bvh'))
    table.write_text('file,subject\n' + ''.join(f'{x},{x[0]}\n' for x in names))
    assert learn.main(['lengths', str(tmp_path), '--people', str(table)]) == 0
    told = capsys.readouterr()
    assert '# 3 people with a skeleton of their own: a, b, c' in told.out
    assert 'people left out' in told.out
    assert 'skipped d_odd.bvh: hip_drop must be positive' in told.err
    found, body = yaml.safe_load(told.out), load_body('human37')
    assert list(found['lengths']) == list(body.segment_lengths)
    assert found['lengths']['thigh'][0] == pytest.approx(body.segment_lengths['thigh'])
    assert found['lengths']['thigh'][1] < 0.05
    assert 0.04 < found['stature_spread'] < 0.07


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['absent.bvh'], 'none of the 1 motions can be used'),
        (['one.bvh'], '1 people have a skeleton of their own, wanted at least 2'),
        (['one.bvh', '--people', 'table.csv'], "no column 'subject'"),
        (['one.bvh', '--body', 'flat.yaml'], 'no spreads of stature and proportions'),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path, read_here, monkeypatch, capsys):
    read_here()
    monkeypatch.chdir(tmp_path)
    write_figure(Path('one.bvh'), 1.0)
    Path('table.csv').write_text('file\none.bvh\n')
    Path('flat.yaml').write_text('name: flat\nextends: human37\nstature_spread: 0\n')
    assert learn.main(['lengths', *arguments]) == 1
    assert message in capsys.readouterr().err.splitlines()[-1]
