"""YAML from outside is read as plain data of bounded size."""

import random
from pathlib import Path

import pytest

from hmt_ros.body import load_body, model_names, named_body
from msg_tools.files.plain_yaml import MAX_NODES, load_plain_yaml

MODEL = Path(__file__).resolve().parents[3] / 'hmt_ros' / 'body' / 'models' / 'human37.yaml'
BOMB = 'a: &a [x, x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{new}: &{new} [{", ".join([f"*{old}"] * 10)}]\n'
    for old, new in zip('abcdefghi', 'bcdefghij', strict=True)
)


def test_plain_documents():
    assert load_plain_yaml('a: {b: [1, 2.5, x], c: true}\n') == {
        'a': {'b': [1, 2.5, 'x'], 'c': True}
    }
    assert load_plain_yaml('') is None


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (BOMB, r'line 2: an alias \(\*\), wanted plain values'),
        ('a: &x {b: 1}\nc:\n  <<: *x\n', 'line 3: an alias'),
        ('a: &x [*x]', 'alias'),
        ('!!python/object/apply:os.getcwd []', 'could not determine a constructor'),
        ('!!python/name:os.system x', 'could not determine a constructor'),
        ('[' * 60 + ']' * 60, 'nested deeper than 50 levels'),
        ('[' * 20_000, 'nested deeper than 50 levels'),
        ('a: [1', 'expected'),
        ('a: 2000-99-99', 'month must be in'),
        ('a: \x00', 'special characters are not allowed'),
        ('a: 1\n---\nb: 2\n', 'single document'),
        ('a: [' + '1,' * MAX_NODES + ']', 'line 1: more than 20000 values'),
        ('- a\n' * MAX_NODES, 'more than 20000 values'),
        ('?\n' * MAX_NODES, 'more than 20000 values'),
        ('{' + '<<: {},' * MAX_NODES + '}', 'more than 20000 values'),
        ('a: ' + '9' * 101, 'a number of 101 characters'),
        ('a: 1' + ':1' * 50_000, 'a number of 100001 characters'),
        ('a: 0x' + 'f' * 1000, 'a number of 1002 characters'),
        ('a: !!float ' + '1_' * 1000 + '.0', 'a number of 2002 characters'),
        ('!!bool x', "'x'"),
        ('!!int ""', 'out of range'),
        ('!!timestamp x', 'groupdict'),
        ('!!set [a]', 'expected a mapping'),
        ('{[1]: 2}', 'unhashable key'),
    ],
)
def test_everything_else_is_one_line(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_plain_yaml(text)
    assert '\n' not in str(caught.value)


def test_damaged_model_files_are_read_or_refused(tmp_path):
    whole = MODEL.read_bytes()
    rng = random.Random(1)
    path = tmp_path / 'body.yaml'
    refused: list[str] = []
    for _ in range(25):
        content = bytearray(whole)
        for _ in range(rng.randint(1, 6)):
            content[rng.randrange(len(content))] = rng.choice(b'\x00\xff:-{}[]&*!?|>#0x9 \n"')
        path.write_bytes(content)
        try:
            load_body(path)
        except ValueError as error:
            refused.append(str(error))
    assert len(refused) > 5
    assert not any('\n' in text for text in refused)


def test_names_from_messages_lead_to_no_files(tmp_path):
    path = tmp_path / 'own.yaml'
    path.write_bytes(MODEL.read_bytes())
    assert load_body(path).name == 'human37'
    for name in (str(path), '../models/human37', 'human37.yaml', '', '/etc/passwd'):
        with pytest.raises(FileNotFoundError, match='wanted one of'):
            named_body(name)
    assert [named_body(name).name for name in model_names()] == model_names()
