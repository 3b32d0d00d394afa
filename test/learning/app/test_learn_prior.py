"""`learn prior` on a few short motions of a stick figure."""

import numpy as np
import pytest

import hmt_learning.app
from hmt_learning.app import learn
from hmt_ros.body import load_body
from hmt_ros.body.angle_mixture import read_pose_prior
from hmt_ros.body.mirror import mirror
from test.learning.stick_figure import figure, write_bvh


def write_motion(path, seed, frames=24):
    """A figure that swings its limbs."""
    rng, joints = np.random.default_rng(seed), figure(hang=True)
    rows = np.zeros((frames, 3 + 3 * len(joints)))
    rows[:, 1] = 1.0
    for i, name in enumerate(joints, 1):
        swing = 12.0 * np.sin(0.4 * np.arange(frames) + rng.uniform(0, 6))[:, None]
        bend = {'Leg': 25.0, 'ForeArm': -45.0}.get(name.removeprefix('Left').removeprefix('Right'))
        if bend is not None:
            rows[:, 3 * i + 1] = bend + swing[:, 0]
        elif not name.endswith('Hand'):
            rows[:, 3 * i : 3 * i + 3] = swing * [0.3, 1.0, 0.3]
    return write_bvh(path, joints, rows)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    result = tmp_path_factory.mktemp('motions')
    for i in range(4):
        write_motion(result / f'lab_{i:02d}_walk.bvh', i)
    (result / 'lab_00_damaged.bvh').write_text('HIERARCHY\n')
    return result


def test_the_command_learns_chooses_and_tells(folder, tmp_path, read_here, capsys):
    output = tmp_path / 'prior.npz'
    rest = [
        str(folder),
        '--without',
        'lab_03_walk',
        '--folds',
        '3',
        '--acknowledgement',
        'stick figures',
    ]
    rest += ['--components', '1', '2', '--test', str(folder / 'lab_03_walk.bvh')]
    assert hmt_learning.app.main(['learn', 'prior', *rest, '-o', str(output)]) == 0
    told = capsys.readouterr()
    assert told.err.count('learn: skipped lab_00_damaged.bvh') == 1
    assert 'of 3 motions of 3 people' in told.out
    assert '1 components' in told.out
    assert '2 components' in told.out
    assert 'lab_03' in told.out
    body = load_body('human37')
    prior = read_pose_prior(output, body)
    assert prior.card['source'] == 'stick figures'
    assert 'people: lab_00, lab_01, lab_02' in prior.card['method']
    # Neither hands that do not move nor the root are learned.
    assert {'left_elbow', 'right_knee', 'trunk_x'} <= set(prior.dofs)
    assert not any('root' in name or 'wrist' in name for name in prior.dofs)
    x = np.tile(body.prior_mean, (5, 1))
    x[:, 6:] += 0.3 * np.random.default_rng(0).normal(size=(5, 31))
    assert np.allclose(prior.log_density(x), prior.log_density(mirror(body, x)), atol=1e-6)
    # A second run, in one process, gives the same bytes; nothing is overwritten unasked.
    read_here()
    again = tmp_path / 'again'
    assert learn.main(['prior', *rest, '--quiet', '-o', str(again)]) == 0
    assert again.with_suffix('.npz').read_bytes() == output.read_bytes()
    assert learn.main(['prior', *rest, '-o', str(output)]) == 1
    assert 'exists; give another name, or --overwrite' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['nothing.bvh'], 'none of the 1 motions can be used'),
        (['ONE', '--folds', '9'], 'motions of 1 people, wanted at least 9'),
        (['FOLDER', '--folds', '1'], 'wanted a whole number from 2'),
        (['FOLDER', '--components', '0'], 'wanted a whole number from 1'),
        (['FOLDER', '--body', 'nobody'], "no body 'nobody'"),
        (['FOLDER', '--people', 'none.csv'], 'none.csv'),
    ],
)
def test_bad_input_is_one_line(folder, tmp_path, arguments, message, read_here, capsys):
    read_here()
    places = {'FOLDER': str(folder), 'ONE': str(folder / 'lab_00_walk.bvh')}
    given = [places.get(x, x) for x in arguments]
    assert learn.main(['prior', *given, '--quiet', '-o', str(tmp_path / 'x.npz')]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1]
    assert lines[-1].startswith('learn: ')
    assert not (tmp_path / 'x.npz').exists()
