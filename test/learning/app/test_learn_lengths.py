"""`learn lengths` on motions of stick figures of different sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from hmt_learning.app import learn
from hmt_ros.body import load_body
from test.learning.stick_figure import figure, write_bvh


def write_figure(path: Path, size: float, arms: float = 1.0, hips: float = 1.0) -> Path:
    """Three frames of a T pose."""
    joints = figure(size, arms, hips)
    rows = np.zeros((3, 3 + 3 * len(joints)))
    rows[:, 1] = 0.95 * size
    return write_bvh(path, joints, rows)


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
