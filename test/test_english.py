"""The script that finds phrases that are hard to read."""

from tools.english import main, stumbling


def test_phrases_are_found_with_their_lines(tmp_path, capsys):
    path = tmp_path / 'text.md'
    path.write_text('People, of whom one waits.\n\nThe track starts anew. None: there is none.\n')
    assert [line.partition(': ')[2] for line in stumbling(path)] == [
        '"of whom"; better a sentence of its own',
        '": there is none"; better "none", "... if missing"',
        '"anew"; better "again"',
    ]
    assert main([str(path)]) == 1
    assert f'{path}:3: "anew"' in capsys.readouterr().out
    path.write_text('The track starts again.\n')
    assert main([str(path)]) == 0
