"""`learn motion` on small motions of a stick figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hmt_learning.app import learn
from hmt_ros.body.motion_prior import read_motion_prior

# Joints of a stick figure: name, parent, offset in cm (y up); the T pose faces z.
JOINTS = [('Hips', None, (0, 95, 0)), ('Spine', 'Hips', (0, 15, 0)), ('Neck', 'Spine', (0, 28, 0))]
JOINTS += [('Head', 'Neck', (0, 18, 0))]
for side, x in (('Left', 1), ('Right', -1)):
    JOINTS += [
        (f'{side}UpLeg', 'Hips', (10 * x, -10, 0)),
        (f'{side}Leg', f'{side}UpLeg', (0, -41, 0)),
        (f'{side}Foot', f'{side}Leg', (0, -41, 0)),
        (f'{side}ToeBase', f'{side}Foot', (0, -3, 13)),
        (f'{side}Arm', 'Spine', (18 * x, 26, 0)),
        (f'{side}ForeArm', f'{side}Arm', (28 * x, 0, 0)),
        (f'{side}Hand', f'{side}ForeArm', (23 * x, 0, 0)),
        (f'{side}FingerBase', f'{side}Hand', (10 * x, 0, 0)),
    ]


def hierarchy(name: str, order: list[str]) -> str:
    """The part of a BVH file for a joint and its children; `order` gains the joints in turn."""
    order.append(name)
    offset = next(o for n, _, o in JOINTS if n == name)
    channels = '3 Zrotation Xrotation Yrotation'
    if name == 'Hips':
        channels = '6 Xposition Yposition Zposition Zrotation Xrotation Yrotation'
    text = 'ROOT ' if name == 'Hips' else 'JOINT '
    text += f'{name}\n{{\nOFFSET {offset[0]} {offset[1]} {offset[2]}\nCHANNELS {channels}\n'
    children = [n for n, parent, _ in JOINTS if parent == name]
    text += ''.join(hierarchy(child, order) for child in children)
    if not children:
        text += 'End Site\n{\nOFFSET 0 2 0\n}\n'
    return text + '}\n'


def write_motion(path: Path, times: int, fps: float, seed: int) -> Path:
    """A figure that sways, swings its limbs and drifts to the side."""
    order: list[str] = []
    head = hierarchy('Hips', order)
    rng = np.random.default_rng(seed)
    t = np.arange(times)[:, None] / fps
    numbers = 3 + 3 * len(order)
    size = rng.uniform(2.0, 15.0, numbers)
    rows = size * np.sin(
        2 * np.pi * rng.uniform(0.3, 1.2, numbers) * t + rng.uniform(0, 6, numbers)
    )
    rows[:, :3] = np.concatenate([20 * t, np.full_like(t, 95.0), 5 * np.sin(t)], axis=1)
    lines = '\n'.join(' '.join(f'{x:.4f}' for x in row) for row in rows)
    path.write_text(
        f'HIERARCHY\n{head}MOTION\nFrames: {times}\nFrame Time: {1 / fps:.6f}\n{lines}\n'
    )
    return path


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
    assert learned.card.startswith('From nobody.\nLearned from 2 motions, 7 s: ')
    assert learned.dynamics.dimension == 37
    # The same in one process.
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
        (['short.bvh', '-o', 'there.npz'], 'there.npz exists: --overwrite'),
        (['short.bvh', '-o', 'nowhere/file.npz'], 'there is no folder nowhere'),
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
