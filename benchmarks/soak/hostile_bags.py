"""Well-formed hostile bags: MCAP written record by record, SQLite with views, zstd by hand."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import lz4.frame
import zstandard
from mcap.reader import make_reader

from benchmarks.soak.hostile_file import ALIASES, CONTROL, DEEP, DIGITS, Hostile, alias_bomb, bare

_MAGIC = b'\x89MCAP0\r\n'
_BLOCK = 2**17  # content of the largest block of zstd, bytes
_SKIPPED = b'\x50\x2a\x4d\x18' + bytes(4)  # an empty skippable frame of zstd
_SUFFIX = '\n' + '=' * 80 + '\nMSG: '


def _types(first: str, others: dict[str, str]) -> str:
    """A message definition followed by those of its nested types."""
    return first + ''.join(f'{_SUFFIX}a_msgs/{name}\n{text}' for name, text in others.items())


# Message definitions that may cost a reader much more memory or time than their size.
_DEFINITIONS = {
    'string_bound': 'string<=1000000000[1000000000] x\nstring[1000000000] y',
    'array': 'float64[1000000000] x',
    'arrays': _types('B[1000] x', {'B': 'C[1000] x', 'C': 'D[1000] x', 'D': 'float64[1000] x'}),
    'doubling': _types('B0 a', {f'B{i}': f'B{i + 1} a\nB{i + 1} b' for i in range(40)}),
    'deep': _types('B0 a', {f'B{i}': f'B{i + 1} a' for i in range(5000)}),
    'itself': 'A x\nA[] y\nA[3] z',
    'each_other': _types('B x', {'B': 'A y'}),
    'fields': '\n'.join(f'uint8 x{i}' for i in range(100_000)),
    'types': _types('uint8 x', {f'B{i}': 'uint8 x' for i in range(30_000)}),
    'python_names': 'uint8 __class__\nuint8 self\nuint8 lambda\nuint8 __dict__\nuint8 None',
    'code': 'uint8 x #\n__import__("os").system("touch ../kept/pwned")\nuint8 y',
    'code_default': "string x \"\\\"); __import__('os').system('touch ../kept/pwned') #\"",
    'default': f'float64[] x [{"1," * 100_000}1]',
    'digits': f'int64 X={DIGITS}\nuint8[{DIGITS}] x\nuint8[<={DIGITS}] y',
    'comment': f'uint8 x #{"#" * 1_000_000}',
    'spaces': f'uint8{" " * 100_000}x\n' + ' ' * 100_000,
    'control': f'uint8 x{CONTROL}\nuint8 x\0y',
}


def _idl(fields: str, before: str = '') -> str:
    return f'module a_msgs {{ module msg {{ {before} struct A {{ {fields} }}; }}; }};'


def _constant(value: str) -> str:
    return _idl('long x;', f'module A_Constants {{ const long X = {value}; }};')


_IDL_DEFINITIONS = {
    'parentheses_20': _constant('(' * 20 + '1' + ')' * 20),
    'parentheses_5000': _constant('(' * 5000 + '1' + ')' * 5000),
    'sums': _constant('1 + (' * 20 + '1' + ')' * 20),
    'shifts': _constant('1' + ' << 99999 * 9' * 20),
    'products': _constant(' * '.join([DIGITS[:4000]] * 20)),
    'minuses': _constant('-' * 30 + '1'),
    'sequences': _idl('sequence<' * 500 + 'long' + '>' * 500 + ' x;'),
    'modules': 'module a { ' * 3000 + '};' * 3000,
    'typedefs': _idl('C x;', 'typedef double B[1000][1000][1000]; typedef B C[1000];'),
    'string_bound': _idl('string<1000000000> x; sequence<double, 1000000000> y;'),
    'comment': '/*' * 50_000 + _idl('long x;'),
    'stars': '/' + '*' * 100_000,
    'annotations': _idl('@a ' * 3000 + 'long x;', '@a(b="' + 'c' * 100_000 + '")\n' * 3),
    'quotes': _idl('@verbatim(text="' + '\\"' * 30_000 + ' long x;'),
    'enumeration': _idl('E x;', f'enum E {{ {", ".join(f"X{i}" for i in range(50_000))} }};'),
    'union': _idl('U x;', 'union U switch(long) { case 1: long a; };'),
    'spaces': ' ' * 200_000 + _idl('long x;'),
}
# Offered QoS, and other text that is read as YAML.
YAML_BOMBS = {
    'aliases': ALIASES,
    'bomb': alias_bomb(),
    'deep': '[' * 20_000 + ']' * 20_000,
    'maps_deep': '{a: ' * 20_000 + '1' + '}' * 20_000,
    'list': '- {history: 1}\n' * 60_000,
    'tag': '!!python/object/apply:os.system ["touch ../kept/pwned"]',
    'digits': f'- {{depth: {DIGITS}}}',
    'numbers': '- history: 3\n  depth: -1e999\n  reliability: [1]\n  durability: {}\n',
    'control': f'- history: "{CONTROL}"\n',
    'merge': 'a: &a {x: 1}\n' + ''.join(f'b{i}:\n  <<: [*a, *a]\n' for i in range(1000)),
}


def _string(text: bytes | str) -> bytes:
    data = text if isinstance(text, bytes) else text.encode()
    return struct.pack('<I', len(data)) + data


def _record(kind: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack('<BQ', kind, len(content) if length is None else length) + content


def _schema(number: int, name: str, encoding: str, text: str) -> bytes:
    return _record(3, struct.pack('<H', number) + _string(name) + _string(encoding) + _string(text))


def _channel(
    number: int, schema: int, topic: bytes | str, coding: str = 'cdr', qos: str = ''
) -> bytes:
    metadata = _string(_string('offered_qos_profiles') + _string(qos))
    numbers = struct.pack('<HH', number, schema)
    return _record(4, numbers + _string(topic) + _string(coding) + metadata)


def _message(channel: int, time: int, data: bytes) -> bytes:
    return _record(5, struct.pack('<HIQQ', channel, 0, time, time) + data)


def _chunk(data: bytes, compression: str, size: int) -> bytes:
    head = struct.pack('<QQQI', 0, 9, size, 0)
    return _record(6, head + _string(compression) + struct.pack('<Q', len(data)) + data)


def _chunk_index(at: int, length: int, size: int, compression: str = '') -> bytes:
    numbers = struct.pack('<QQQQ', 0, 9, at, length)
    sizes = struct.pack('<QQ', length, size)
    return _record(8, numbers + _string(b'') + bytes(8) + _string(compression) + sizes)


def _statistics(
    messages: int = 0, channels: int = 0, chunks: int = 0, counts: bytes = b''
) -> bytes:
    numbers = struct.pack('<QHIIIIQQ', messages, 1, channels, 0, 0, chunks, 0, 9)
    return _record(11, numbers + _string(counts))


def _mcap(data: bytes, summary: bytes = b'', *, start: int | None = None) -> bytes:
    """A file with a data section and a summary."""
    head = _MAGIC + _record(1, _string('ros2') + _string('')) + data + _record(15, bytes(4))
    at = start if start is not None else len(head) if summary else 0
    return head + summary + _record(2, struct.pack('<QQI', at, 0, 0)) + _MAGIC


_DATA_AT = len(_MAGIC) + len(_record(1, _string('ros2') + _string('')))


def zstd_zeros(size: int, head: bytes = b'', *, window: int = 0x58, claims: int = -1) -> bytes:
    """A zstd frame of a head and zeros, compressed to four bytes per 128 kB.

    Args:
        window: window descriptor, which states the memory a reader needs; 2 MB by default.
        claims: content size stated in the frame header; negative omits it.
    """
    told = b'' if claims < 0 else struct.pack('<Q', claims)
    blocks = [(len(head) << 3).to_bytes(3, 'little') + head] if head else []
    blocks += [((_BLOCK << 3) | 2).to_bytes(3, 'little') + b'\0'] * (size // _BLOCK)
    last = (1).to_bytes(3, 'little')
    return (
        b'\x28\xb5\x2f\xfd' + bytes([0xC0 if told else 0, window]) + told + b''.join(blocks) + last
    )


def bags(good: Path) -> Iterator[Hostile]:
    """MCAP files with one strange thing in an otherwise complete bag."""
    whole = _good_records(good)
    definitions = [(n, 'ros2msg', x) for n, x in _DEFINITIONS.items()]
    definitions += [(n, 'ros2idl', x) for n, x in _IDL_DEFINITIONS.items()]
    for name, coding, text in definitions:
        yield Hostile(f'{coding}_{name}.mcap', partial(_redefined, good, (coding, text)))
        unknown = _schema(1, 'a_msgs/msg/A', coding, text) + _channel(1, 1, '/a')
        yield Hostile(f'{coding}_{name}_a.mcap', _mcap(unknown + _message(1, 1, bytes(64)) + whole))
    for name, qos in YAML_BOMBS.items():
        yield Hostile(f'qos_{name}.mcap', _mcap(_channel(60000, 0, '/x', qos=qos) + whole))
    for name, records in {**dict(_of_names()), **_records()}.items():
        yield Hostile(f'{name}.mcap', partial(_mcap, records + whole))
    yield from _of_chunks(whole, _good_records(good, messages=False))
    last = _channel(1, 0, '/x') + _message(1, 2**64 - 1, bytes(4))
    yield Hostile('late.mcap', _mcap(whole + last))
    for name, summary in _SUMMARIES.items():
        yield Hostile(f'statistics_{name}.mcap', _mcap(whole, summary))
    for start in (1, 8, 2**40, 2**64 - 1):
        yield Hostile(f'summary_at_{start:x}.mcap', _mcap(whole, _statistics(), start=start))
    # Messages of known types with excessive lengths and sizes.
    for at in range(4, 120, 4):
        word = struct.pack('<I', 2**32 - 1 if at % 16 else 10**8)
        yield Hostile(f'word_{at}.mcap', partial(_changed, good, at, word))
    for at, size in ((0, 2**32), (4, 2**30)):
        yield Hostile(f'message_zstd_{at}.mcap', partial(_changed, good, at, zstd_zeros(size)))


def _changed(good: Path, at: int, word: bytes) -> bytes:
    """The good bags with some bytes of each message replaced."""
    return _mcap(_good_records(good, lambda data: data[:at] + word + data[at + len(word) :]))


def _redefined(good: Path, definition: tuple[str, str]) -> bytes:
    return _mcap(_good_records(good, definition=definition))


def _good_records(
    good: Path,
    change: Callable[[bytes], bytes] = bytes,
    definition: tuple[str, str] | None = None,
    *,
    messages: bool = True,
) -> bytes:
    """Schemas, channels and messages of the good bags, as records.

    Args:
        change: function applied to the bytes of each message.
        definition: encoding and text that replace all definitions, written for a_msgs/msg/A.
        messages: whether to include messages.
    """
    content: list[bytes] = []
    known: dict[str, int] = {}
    for path in (*(good / 'bag').glob('*.mcap'), *(good / 'lifted' / 'lifted').glob('*.mcap')):
        with path.open('rb') as file:
            for schema, channel, message in make_reader(file).iter_messages():
                assert schema is not None
                if (number := known.get(channel.topic)) is None:
                    number = known[channel.topic] = 1000 + len(known)
                    coding, text = definition or (schema.encoding, schema.data.decode())
                    package, _, kind = schema.name.split('/')
                    text = text.replace('a_msgs', package).replace('struct A ', f'struct {kind} ')
                    content.append(_schema(number, schema.name, coding, text))
                    content.append(_channel(number, number, channel.topic))
                if messages:
                    content.append(_message(number, message.log_time, change(message.data)))
    return b''.join(content)


_NAMES: dict[str, bytes | str] = {
    'control': CONTROL,
    'dots': '/../../kept/canary',
    'long': '/x' * 50_000,
    'bytes': b'/\xff\xfe\x80',
    'surrogate': b'/\xed\xa0\x80',
    'nul': '/a\0b',
    'empty': '',
    'yaml': '/a: [*b]\n- c',
    'percent': '/%s%n{0.__class__}',
}


def _of_names() -> Iterator[tuple[str, bytes]]:
    """Records with strange names of topics, types and encodings."""
    one = _message(1, 1, bytes(64))
    for name, topic in _NAMES.items():
        shown = topic if isinstance(topic, str) else 'bytes'
        mixture = _schema(1, 'hmt_msgs/msg/PoseMixture', 'ros2msg', '')
        yield f'topic_{name}', _channel(1, 0, topic)
        yield f'mixtures_{name}', mixture + _channel(1, 1, topic) + one
        typed = _schema(1, f'a/msg/{shown}', 'ros2msg', 'uint8 x')
        yield f'type_{name}', typed + _channel(1, 1, '/a') + one
        yield f'encoding_{name}', _channel(1, 0, '/image', coding=shown) + one


def _records() -> dict[str, bytes]:
    """Very many records, and records that claim to be large."""
    attachment = _record(9, bytes(16) + _string('../../kept/canary') + _string('') + bytes(12))
    claim = bytes(16) + _string('x') + _string('') + struct.pack('<Q', 2**40)
    metadata = _record(12, _string(CONTROL) + _string(_string('a') + _string('b')))
    schemas = (_schema(i, f'a/msg/B{i}', 'ros2msg', 'uint8 x') for i in range(1, 65536))
    return {
        'channels': b''.join(_channel(i, 0, f'/x{i}') for i in range(1, 65536)),
        'long_channels': b''.join(_channel(i, 0, f'/{"x" * 500}{i}') for i in range(1, 20000)),
        'schemas': b''.join(schemas),
        'schema_again': _schema(1, 'a_msgs/msg/A', 'ros2msg', 'uint8 x') * 100_000,
        'messages': _channel(1, 0, '/x') + _message(1, 1, b'\0\1\0\0') * 300_000,
        'messages_of_nobody': _message(7, 1, bytes(9)),
        'attachments': attachment * 20_000,
        'attachment_claims': _record(9, claim, 2**40),
        'metadata': metadata * 50_000,
        'strange_records': _record(200, b'') * 300_000,
        'record_claims': _record(200, b'', 2**63),
        'data_ends': _record(15, bytes(4)) * 100_000,
    }


_SUMMARIES = {
    'count': _statistics(2**63, 1, 0, struct.pack('<HQ', 1000, 2**63)),
    'nothing': _statistics(),
    'chunks': _statistics(chunks=2**32 - 1),
    'many': _statistics(counts=struct.pack('<HQ', 1, 1) * 100_000),
    'again': _statistics() * 100_000,
}


def _of_chunks(whole: bytes, channels: bytes) -> Iterator[Hostile]:
    good = zstandard.compress(whole)
    for name, data in {
        'zstd': zstd_zeros(2**29, whole[:1000]),
        'zstd_4GB': zstd_zeros(2**32, whole[:1000]),
        'zstd_claims': zstd_zeros(0, b'\0', claims=2**62),
        'zstd_window': zstd_zeros(0, b'\0', window=0xF8),
        'zstd_frames': good * 100,
        'zstd_skippable': _SKIPPED * 100_000 + good,
        'lz4': lz4.frame.compress(bytes(2**28)),
        'lz4_frames': lz4.frame.compress(bytes(2**20)) * 500,
        '': b'',
    }.items():
        compression = name.partition('_')[0]
        for size in (0, len(whole), 2**32, 2**63):
            chunk = _chunk(data, compression, size)
            index = _chunk_index(_DATA_AT, len(chunk), size, compression) + _statistics(9, 9, 1)
            yield Hostile(f'chunk_{name}_{size:x}.mcap', _mcap(chunk))
            yield Hostile(f'chunk_{name}_{size:x}_index.mcap', _mcap(chunk, index))
    yield Hostile('chunk_strange.mcap', _mcap(_chunk(good, CONTROL, 9)))
    yield Hostile('chunk_in_chunk.mcap', _mcap(_chunk(_chunk(whole, '', len(whole)), '', 10**5)))
    yield Hostile('chunks_empty.mcap', _mcap(_chunk(b'', '', 0) * 100_000))
    chunk = _chunk(good, 'zstd', len(whole))
    index = _chunk_index(_DATA_AT, len(chunk), len(whole), 'zstd')
    for count in (10, 20_000):
        summary = channels + index * count + _statistics(count, 9, count)
        yield Hostile(f'chunk_{count}_times.mcap', _mcap(chunk, summary))
    for at, size in ((_DATA_AT, 2**62), (0, 2**20)):
        summary = _chunk_index(at, size, size) + _statistics(1, 1, 1)
        yield Hostile(f'chunk_at_{at}.mcap', _mcap(chunk, summary))


_TOPICS = (
    'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, '
    'serialization_format TEXT, offered_qos_profiles TEXT)',
    "INSERT INTO topics VALUES(1, '/pose_mixture', 'hmt_msgs/msg/PoseMixture', 'cdr', ''), "
    "(2, '/image/compressed', 'sensor_msgs/msg/CompressedImage', 'cdr', '')",
)
_MESSAGES = (
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)'
)
_COUNT = 'WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c{}) SELECT '
_ROW = "x AS id, 1 + x % 2 AS topic_id, x AS timestamp, x'00010000' AS data FROM c"
_TOPIC_ROW = (
    "x AS id, '/x' || x AS name, 'a/msg/B' AS type, 'cdr' AS serialization_format, "
    "'' AS offered_qos_profiles FROM c"
)
_DOUBLED = 'CREATE VIEW v{1} AS SELECT * FROM v{0} UNION ALL SELECT * FROM v{0}'
# Views in the place of messages or topics, which run when a reader selects from them.
_MESSAGES_AS = {
    'endless': _COUNT.format('') + _ROW,
    'joins': "SELECT a.x AS id, 1 AS topic_id, a.x AS timestamp, x'00' AS data "
    'FROM n a, n b, n c, n d WHERE a.x + b.x + c.x + d.x < 0',
    'blobs': 'SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(999999999) AS data',
    'nested_views': 'SELECT * FROM v39',
    'itself': 'SELECT * FROM messages',
}
_ENDLESS_TOPICS = f'CREATE VIEW topics AS {_COUNT.format("")} {_TOPIC_ROW}'
_BEFORE = {
    'joins': ('CREATE TABLE n(x)', f'INSERT INTO n {_COUNT.format(" LIMIT 3000")} x FROM c'),
    'nested_views': (
        "CREATE VIEW v0 AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, x'00' AS data",
        *(_DOUBLED.format(i - 1, i) for i in range(1, 40)),
    ),
}
# Statements run after the tables of topics and messages are created.
_STATEMENTS: dict[str, Sequence[str]] = {
    'names': (
        f"UPDATE topics SET name = '{CONTROL}', type = '{'/x' * 50_000}' WHERE id = 1",
        "INSERT INTO messages VALUES(1, 1, 1, x'00010000'), (2, 2, 2, x'00010000')",
    ),
    'types': (
        "INSERT INTO topics VALUES(3, x'ff', 7, NULL, 3.5), (4, NULL, NULL, 'cdr', x'00')",
        "INSERT INTO messages VALUES(1, 'a', 'b', 7), (2, 1, 1e300, NULL)",
    ),
    'times': (
        "INSERT INTO messages VALUES(1, 1, -9223372036854775808, x'00010000'), "
        "(2, 2, 9223372036854775807, x'00010000')",
    ),
    'generated': (
        'DROP TABLE messages',
        _MESSAGES[:-1] + ' GENERATED ALWAYS AS (zeroblob(500000000 + id)) VIRTUAL)',
        'INSERT INTO messages(topic_id, timestamp) VALUES(1, 1), (2, 2), (1, 3)',
    ),
    'definitions': (
        'CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT)',
        "INSERT INTO schema VALUES(4, 'jazzy')",
        'CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, '
        'encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)',
        "INSERT INTO message_definitions VALUES(1, 'hmt_msgs/msg/PoseMixture', 'ros2msg', "
        "'string[1000000000] x', '')",
        'INSERT INTO messages VALUES(1, 1, 1, zeroblob(64)), (2, 2, 2, zeroblob(64))',
    ),
    'columns': (
        'DROP TABLE messages',
        f'CREATE TABLE messages({", ".join(f"c{i}" for i in range(2000))})',
    ),
}


def databases() -> Iterator[Hostile]:
    """SQLite files that are hostile even to a reader that only selects."""
    found: dict[str, Sequence[str]] = {
        name: (*_TOPICS, *_BEFORE.get(name, ()), f'CREATE VIEW messages AS {text}')
        for name, text in _MESSAGES_AS.items()
    }
    found['topics_endless'] = (_MESSAGES, _ENDLESS_TOPICS)
    for name, more in _STATEMENTS.items():
        found[name] = (*_TOPICS, _MESSAGES, *more)
    for name, qos in YAML_BOMBS.items():
        text = f'UPDATE topics SET offered_qos_profiles = {_quoted(qos)}'
        found[f'qos_{name}'] = (*_TOPICS, _MESSAGES, text)
    for name, statements in found.items():
        yield Hostile(f'{name}.db3', write=partial(_write_database, statements))


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _write_database(statements: Sequence[str], path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        for statement in ('BEGIN', *statements):
            connection.execute(statement)
        connection.commit()


def compressed_bags(good: Path) -> Iterator[Hostile]:
    """Bags in zstd files that are, or claim to be, very large."""
    whole = _mcap(_good_records(good))
    database = b'SQLite format 3\0'
    for name, content in {
        'zeros_1GB.mcap.zstd': lambda: zstd_zeros(2**30),
        'bag_64GB.mcap.zstd': lambda: zstd_zeros(2**36, _MAGIC),
        'chunk_8GB.mcap.zstd': lambda: zstd_zeros(2**33, _MAGIC + _record(200, b'', 2**33)),
        'claims.mcap.zstd': lambda: zstd_zeros(0, _MAGIC, claims=2**63),
        'window.mcap.zstd': lambda: zstd_zeros(0, _MAGIC, window=0xF8),
        'window_2GB.mcap.zstd': lambda: zstd_zeros(2**31, _MAGIC, window=0xA8),
        'frames.mcap.zstd': lambda: zstandard.compress(_MAGIC) * 100_000,
        'skippable.mcap.zstd': lambda: _SKIPPED * 300_000 + zstandard.compress(whole),
        'twice.mcap.zstd': lambda: zstandard.compress(zstandard.compress(whole)),
        'database.db3.zst': lambda: zstd_zeros(2**34, database),
        'nothing.mcap.zstd': lambda: zstd_zeros(0),
    }.items():
        yield Hostile(name, content)


def bag_folders(good: Path) -> Iterator[Hostile]:
    """Folders with metadata.yaml."""
    bag = next((good / 'bag').glob('*.mcap')).read_bytes()
    head = 'rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths: '
    many = ', '.join(f'x{i}.mcap' for i in range(100_000))
    metadata = {
        **{f'yaml_{x}': f'{head}[x.mcap]\n  a:\n{bare(y)}' for x, y in YAML_BOMBS.items()},
        **{f'whole_{x}': y for x, y in YAML_BOMBS.items()},
        'names': f'{head}[{many}]\n',
        'again': f'{head}[{", ".join(["x.mcap"] * 3000)}]\n',
        'dots': f'{head}[../../kept/canary, /etc/passwd]\n',
        'control': f'{head}["{CONTROL.encode("unicode_escape").decode()}"]\n',
        'long': f'{head}[{"x" * 100_000}]\n',
        'itself': f'{head}[metadata.yaml, ., ..]\n',
        'none': f'{head}[null, 1, []]\n',
        'digits': f'{head}[x.mcap]\n  message_count: {DIGITS}\n',
        'deep': f'{head}{DEEP}\n',
    }
    for name, text in metadata.items():
        yield Hostile(f'folder_{name}', write=partial(_write_folder, text, bag))


def _write_folder(metadata: str, bag: bytes, path: Path) -> None:
    path.mkdir()
    (path / 'metadata.yaml').write_text(metadata, 'utf-8')
    (path / 'x.mcap').write_bytes(bag)
