"""JSON from outside: the memory it needs is bounded before it is parsed."""

import json

import pytest

from msg_tools.files import plain_json
from msg_tools.files.plain_json import load_plain_json, read_plain_json


def test_values_come_back(tmp_path):
    content = {'a': [1, 2.5, None, True, 'ü'], 'b': {}}
    path = tmp_path / 'a.json'
    path.write_text(json.dumps(content, ensure_ascii=False), 'utf-8-sig')
    assert read_plain_json(path, 1000) == load_plain_json(json.dumps(content)) == content
    with pytest.raises(ValueError, match='wanted at most 10'):
        read_plain_json(path, 10)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('[' * 100_000, 'not JSON .nested too deep.'),
        ('{"a":' * 100_000, 'not JSON .nested too deep.'),
        ('9' * 5000, 'not JSON .Exceeds the limit'),
        ('{"a"', 'not JSON .Expecting'),
        ('', 'not JSON'),
        (b'"\xff"', 'not JSON'),
    ],
)
def test_everything_else_is_one_line(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_plain_json(text)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('part', ['[],', '{},', '"",', '1.5,', '[[[0]]],', '{"":{"":{}}},'])
def test_memory_is_counted_before_it_is_spent(part, monkeypatch):
    text = f'[{part * 1000}0]'
    needed = load_plain_json(text)
    assert len(needed) == 1001
    # A value takes 24 bytes at least, and its place in a list eight.
    monkeypatch.setattr(plain_json, 'MAX_MEMORY_BYTES', 24 * 1000)
    with pytest.raises(ValueError, match='bytes, wanted at most 24000'):
        load_plain_json(text)
