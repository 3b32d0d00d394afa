"""The command that learns experts of depth: what it refuses before learning."""

import pytest

from hmt_learning.app import learn


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--start-from', 'none.npz'], 'none.npz'),
        (['--start-from', 'WRONG'], 'wrong.npz'),
        (['--rate', '2'], 'wanted a number from 0 to 1'),
        (['--steps', '0'], 'wanted a whole number from 1'),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path, capsys):
    wrong = tmp_path / 'wrong.npz'
    wrong.write_bytes(b'no lifter')
    given = [str(wrong) if x == 'WRONG' else x for x in arguments]
    output = tmp_path / 'x.npz'
    assert learn.main(['lifter', 'walk.bvh', *given, '--quiet', '-o', str(output)]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1]
    assert lines[-1].startswith('learn: ')
    assert not output.exists()
