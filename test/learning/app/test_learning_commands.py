"""The commands of hmt_learning have help texts and report bad arguments in one line."""

import pytest

from hmt_learning.app import COMMANDS, main

WHAT = ('lengths', 'lifter', 'motion', 'prior')


def test_help_names_all_commands(capsys):
    assert main(['--help']) == 0
    text = capsys.readouterr().out
    for name, (_, what) in COMMANDS.items():
        assert f'  {name}' in text
        assert what in text


@pytest.mark.parametrize(
    'command', [['make-bag'], ['train'], ['learn'], *(['learn', what] for what in WHAT)]
)
def test_commands_explain_themselves(command, capsys):
    with pytest.raises(SystemExit) as caught:
        main([*command, '--help'])
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith(f'usage: {" ".join(command)} ')
    assert main(command) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'{command[0]}: the following arguments are required')


def test_what_nobody_can_learn_is_one_line(capsys):
    assert main(['learn', 'weather', 'a.bvh']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert all(what in line for what in ('weather', *WHAT))
