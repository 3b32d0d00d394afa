"""`learn motion` on small motions of a stick figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hmt_learning.app import learn
from hmt_ros.body.motion_prior import read_motion_prior
from test.learning.stick_figure import figure, write_bvh


def write_motion(path: Path, times: int, fps: float, seed: int) -> Path:
    """A figure that sways, swings its limbs and drifts to the side."""
    rng, joints = np.random.default_rng(seed), figure()
    t = np.arange(times)[:, None] / fps
    numbers = 3 + 3 * len(joints)
    size = rng.uniform(2.0, 15.0, numbers)
    phases = 2 * np.pi * rng.uniform(0.3, 1.2, numbers) * t + rng.uniform(0, 6, numbers)
    rows = size * np.sin(phases)
    rows[:, :3] = np.concatenate([0.2 * t, np.full_like(t, 0.95), 0.05 * np.sin(t)], axis=1)
    return write_bvh(path, joints, rows, fps)


def test_motions_give_a_motion_prior(tmp_path, read_here, capsys):
    folder = tmp_path / 'motions'
    folder.mkdir()
    write_motion(folder / 'sway.bvh', 150, 30.0, 0)
    write_motion(folder / 'slow.bvh', 40, 25.0, 1)
    write_motion(folder / 'bad.bvh', 150, 30.0, 2)
    swing = write_motion(tmp_path / 'swing.bvh', 120, 60.0, 3)
    output = tmp_path / 'learned.npz'
    arguments = [str(folder), str(swing), '--without', 'bad', '--acknowledgement', 'From nobody.']
    assert learn.main(['motion', *arguments, '-o', str(output)]) == 0
    told = capsys.readouterr()
    assert '2 motions, 1 skipped' in told.out
    assert 'skipped slow.bvh: 25 frames per second, wanted a multiple of 30' in told.err
    learned = read_motion_prior(output)
    assert learned.body == 'human37'
    assert learned.card['source'] == 'From nobody.'
    assert (len(learned.card['motions']), learned.card['seconds']) == (2, 7)
    assert learned.dynamics.dimension == 37
    # The result is the same in one process.
    read_here()
    again = tmp_path / 'again.npz'
    assert learn.main(['motion', *arguments, '-o', str(again), '--quiet']) == 0
    assert again.read_bytes() == output.read_bytes()


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['absent'], 'wanted a folder or a motion'),
        (['empty'], 'has no motion'),
        (['absent.bvh'], 'none of the 1 motions can be used'),
        (['short.bvh'], 'give more of them'),
        (['short.bvh', '--without', 'long'], "no motion is called 'long'"),
        (['short.bvh', '-o', 'there.npz'], 'there.npz exists; give another name, or --overwrite'),
        (
            ['short.bvh', '-o', 'nowhere/file.npz'],
            'file.npz can not be written: its folder',
        ),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path, read_here, monkeypatch, capsys):
    read_here()
    monkeypatch.chdir(tmp_path)
    Path('empty').mkdir()
    Path('there.npz').touch()
    write_motion(Path('short.bvh'), 12, 30.0, 0)
    assert learn.main(['motion', '-o', 'out.npz', '--quiet', *arguments]) == 1
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not Path('out.npz').exists()
