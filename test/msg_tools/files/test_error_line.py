import unicodedata

import pytest

from msg_tools.files.error_line import MAX_LINE, error_line, one_line, printable


@pytest.mark.parametrize(
    ('text', 'line'),
    [
        ('two\nlines\t and\r\nspaces', 'two lines and spaces'),
        ('\x1b[2J\x1b]0;title\x07gone', r'\x1b[2J\x1b]0;title\x07gone'),
        ('\x9b31m, \x7f and \x00', r'\x9b31m, \x7f and \x00'),
        ('a\u2028b\u2029c\x85d', 'a b c d'),
        ('\u202eevil\u2066 \u200b\ufeff', r'\u202eevil\u2066 \u200b\ufeff'),
        ('caf\xe9 \u540d\udcff.mcap', 'caf\xe9 \u540d\\udcff.mcap'),
        ('\U000e0041', r'\U000e0041'),
    ],
)
def test_terminal_gets_no_characters_that_it_obeys(text, line):
    assert one_line(text) == line
    assert line.isprintable()


def test_no_character_passes_that_has_no_shape():
    every = ''.join(map(chr, range(0x110000)))
    shown = ''.join(one_line(every[i : i + 20], 500) for i in range(0, len(every), 20))
    assert not {unicodedata.category(x) for x in shown} & {'Cc', 'Cf', 'Cs', 'Zl', 'Zp'}
    shown.encode()


@pytest.mark.parametrize('middle', ['x' * 10**6, '\x1b' * 10**6, ' ' * 10**6, '\udcff\n' * 10**5])
def test_long_text_keeps_its_start_and_its_end(middle):
    line = one_line(f'/data/walk.mcap: {middle}; give another', MAX_LINE)
    assert len(line) <= MAX_LINE
    assert line.startswith('/data/walk.mcap: ')
    assert line.endswith('; give another')
    assert one_line(line, MAX_LINE) == line


def test_errors_without_a_text_give_their_type():
    assert error_line(KeyError()) == 'KeyError'
    assert error_line(ValueError('a\nb')) == 'a b'


def test_rows_of_tables_keep_their_spaces():
    assert printable('  a   b\n') == '  a   b\\n'
