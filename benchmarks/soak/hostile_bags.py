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
_UNKNOWN, _SUFFIX = 'a_msgs/msg/A', '\n' + '=' * 80 + '\nMSG: '

# Definitions of a message: what a reader might do with more memory or time than they have bytes.
_DEFINITIONS = {
    'string_bound': 'string[1000000000] x',
    'string_at_most': 'string<=1000000000[1000000000] x',
    'array': 'float64[1000000000] x',
    'arrays': 'B[1000] x'
    + ''.join(f'{_SUFFIX}a_msgs/{a}\n{b}[1000] x' for a, b in ('BC', 'CD'))
    + f'{_SUFFIX}a_msgs/D\nfloat64[1000] x',
    'doubling': 'B0 a'
    + ''.join(f'{_SUFFIX}a_msgs/B{i}\nB{i + 1} a\nB{i + 1} b' for i in range(40))
    + f'{_SUFFIX}a_msgs/B40\nuint8 x',
    'deep': 'B0 a'
    + ''.join(f'{_SUFFIX}a_msgs/B{i}\nB{i + 1} a' for i in range(5000))
    + f'{_SUFFIX}a_msgs/B5000\nuint8 x',
    'itself': 'A x\nA[] y\nA[3] z',
    'each_other': f'B x{_SUFFIX}a_msgs/B\nA y',
    'fields': '\n'.join(f'uint8 x{i}' for i in range(100_000)),
    'constants': '\n'.join(f'int64 X{i}={i}' for i in range(100_000)),
    'types': 'uint8 x' + ''.join(f'{_SUFFIX}a_msgs/B{i}\nuint8 x' for i in range(30_000)),
    'long_name': f'uint8 {"x" * 100_000}',
    'python_names': 'uint8 __class__\nuint8 self\nuint8 lambda\nuint8 __dict__\nuint8 None',
    'code': 'uint8 x #\n__import__("os").system("touch ../kept/pwned")\nuint8 y',
    'code_default': "string x \"\\\"); __import__('os').system('touch ../kept/pwned') #\"",
    'default': f'float64[] x [{"1," * 100_000}1]',
    'long_integer': f'int64 X={DIGITS}',
    'bound_digits': f'uint8[{DIGITS}] x\nuint8[<={DIGITS}] y',
    'comment': f'uint8 x #{"#" * 1_000_000}',
    'spaces': f'uint8{" " * 100_000}x\n' + ' ' * 100_000,
    'control': f'uint8 x{CONTROL}',
    'nul': 'uint8 x\0y',
}
_IDL = 'module a_msgs { module msg { %s struct A { %s }; }; };'
_IDL_DEFINITIONS = {
    **{
        f'parentheses_{depth}': _IDL
        % (f'module A_Constants {{ const long X = {"(" * depth}1{")" * depth}; }};', 'long x;')
        for depth in (14, 20, 25, 5000)
    },
    'sums': _IDL
    % (f'module A_Constants {{ const long X = {"1 + (" * 20}1{")" * 20}; }};', 'long x;'),
    'shifts': _IDL
    % ('module A_Constants { const long X = 1' + ' << 99999 * 9' * 20 + '; };', 'long x;'),
    'products': _IDL
    % (f'module A_Constants {{ const long X = {" * ".join([DIGITS[:4000]] * 20)}; }};', 'long x;'),
    'minuses': _IDL % ('module A_Constants { const long X = ' + '-' * 30 + '1; };', 'long x;'),
    'sequences': _IDL % ('', 'sequence<' * 500 + 'long' + '>' * 500 + ' x;'),
    'modules': 'module a { ' * 3000 + '};' * 3000,
    'typedefs': _IDL % ('typedef double B[1000][1000][1000]; typedef B C[1000];', 'C x;'),
    'string_bound': _IDL % ('', 'string<1000000000> x; sequence<double, 1000000000> y;'),
    'comment': '/*' * 50_000 + _IDL % ('', 'long x;'),
    'stars': '/' + '*' * 100_000,
    'annotations': _IDL % ('@a(b="' + 'c' * 100_000 + '")\n' * 3, '@a ' * 3000 + 'long x;'),
    'quotes': _IDL % ('', '@verbatim(text="' + '\\"' * 30_000 + ' long x;'),
    'enumeration': _IDL % (f'enum E {{ {", ".join(f"X{i}" for i in range(50_000))} }};', 'E x;'),
    'union': _IDL % ('union U switch(long) { case 1: long a; };', 'U x;'),
    'spaces': ' ' * 200_000 + _IDL % ('', 'long x;'),
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
    number: int, schema: int, topic: bytes | str, encoding: str = 'cdr', qos: str = ''
) -> bytes:
    metadata = _string('offered_qos_profiles') + _string(qos)
    return _record(
        4,
        struct.pack('<HH', number, schema) + _string(topic) + _string(encoding) + _string(metadata),
    )


def _message(channel: int, time: int, data: bytes) -> bytes:
    return _record(5, struct.pack('<HIQQ', channel, 0, time, time) + data)


def _chunk(data: bytes, compression: str = '', size: int | None = None, inner: int = 0) -> bytes:
    head = struct.pack('<QQQI', 0, 9, inner if size is None else size, 0)
    return _record(6, head + _string(compression) + struct.pack('<Q', len(data)) + data)


def _chunk_index(at: int, length: int, size: int, compression: str = '') -> bytes:
    numbers = struct.pack('<QQQQ', 0, 9, at, length)
    sizes = struct.pack('<QQ', length, size)
    return _record(8, numbers + _string(b'') + bytes(8) + _string(compression) + sizes)


def _statistics(messages: int, channels: int, chunks: int, counts: bytes = b'') -> bytes:
    numbers = struct.pack('<QHIIIIQQ', messages, 1, channels, 0, 0, chunks, 0, 9)
    return _record(11, numbers + _string(counts))


def _mcap(data: bytes, summary: bytes = b'', *, start: int | None = None) -> bytes:
    """A file with a data section and a summary."""
    head = _MAGIC + _record(1, _string('ros2') + _string('')) + data + _record(15, bytes(4))
    at = start if start is not None else len(head) if summary else 0
    return head + summary + _record(2, struct.pack('<QQI', at, 0, 0)) + _MAGIC


_DATA_AT = len(_MAGIC) + len(_record(1, _string('ros2') + _string('')))


def zstd_zeros(size: int, head: bytes = b'', *, window: int = 0x58, claims: int = -1) -> bytes:
    """A zstd frame of a head and zeros, in four bytes for each 128 kB.

    Args:
        window: the byte that claims the memory a reader needs, by default 2 MB.
        claims: size that the head of the frame tells; negative: it tells none.
    """
    told = b'' if claims < 0 else struct.pack('<Q', claims)
    blocks = [(len(head) << 3).to_bytes(3, 'little') + head] if head else []
    blocks += [((_BLOCK << 3) | 2).to_bytes(3, 'little') + b'\0'] * (size // _BLOCK)
    last = (1).to_bytes(3, 'little')
    return (
        b'\x28\xb5\x2f\xfd' + bytes([0xC0 if told else 0, window]) + told + b''.join(blocks) + last
    )


def bags(good: Path) -> Iterator[Hostile]:
    """MCAP files: one strange thing in a bag that has all that the commands look for."""
    whole = _good_records(good)
    definitions = [(n, 'ros2msg', x) for n, x in _DEFINITIONS.items()]
    definitions += [(n, 'ros2idl', x) for n, x in _IDL_DEFINITIONS.items()]
    for name, encoding, text in definitions:
        make = partial(_good_records, good, definition=(encoding, text))
        yield Hostile(f'{encoding}_{name}.mcap', lambda make=make: _mcap(make()))
        unknown = _schema(1, _UNKNOWN, encoding, text) + _channel(1, 1, '/a')
        yield Hostile(
            f'{encoding}_{name}_a.mcap', _mcap(unknown + _message(1, 1, bytes(64)) + whole)
        )
    for name, qos in YAML_BOMBS.items():
        content = _channel(60000, 0, '/x', qos=qos) + whole
        yield Hostile(f'qos_{name}.mcap', _mcap(content))
    yield from _of_names(whole)
    yield from _of_chunks(whole)
    yield from _of_records(whole)
    yield from _of_messages(good, whole)


def _good_records(
    good: Path,
    change: Callable[[str, bytes], bytes] = lambda _, data: data,
    definition: tuple[str, str] | None = None,
) -> bytes:
    """Schemas, channels and messages of the good bags, as records.

    Args:
        change: of the bytes of a message, by its type.
        definition: encoding and text that stand in the place of all, as of a_msgs/msg/A.
    """
    content: list[bytes] = []
    known: dict[str, int] = {}
    for path in (*(good / 'bag').glob('*.mcap'), *(good / 'lifted' / 'lifted').glob('*.mcap')):
        with path.open('rb') as file:
            for schema, channel, message in make_reader(file).iter_messages():
                assert schema is not None
                if (number := known.get(channel.topic)) is None:
                    number = known[channel.topic] = 1000 + len(known)
                    encoding, text = definition or (schema.encoding, schema.data.decode())
                    package, _, kind = schema.name.split('/')
                    text = text.replace('a_msgs', package).replace('struct A ', f'struct {kind} ')
                    content += [
                        _schema(number, schema.name, encoding, text),
                        _channel(number, number, channel.topic),
                    ]
                data = change(schema.name, message.data)
                content.append(_message(number, message.log_time, data))
    return b''.join(content)


def _of_names(whole: bytes) -> Iterator[Hostile]:
    names: dict[str, bytes | str] = {
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
    for name, topic in names.items():
        yield Hostile(f'topic_{name}.mcap', _mcap(_channel(1, 0, topic) + whole))
        shown = topic if isinstance(topic, str) else 'bytes'
        mixture = 'hmt_msgs/msg/PoseMixture'
        twice = _schema(1, mixture, 'ros2msg', '') + _channel(1, 1, topic)
        yield Hostile(f'mixtures_{name}.mcap', _mcap(twice + _message(1, 1, bytes(64))))
        typed = _schema(1, f'a/msg/{shown}', 'ros2msg', 'uint8 x') + _channel(1, 1, '/a')
        yield Hostile(f'type_{name}.mcap', _mcap(typed + _message(1, 1, bytes(64))))
        encoded = _channel(1, 0, '/image', encoding=shown) + _message(1, 1, bytes(64))
        yield Hostile(f'encoding_{name}.mcap', _mcap(encoded))
    many = b''.join(_channel(i, 0, f'/x{i}') for i in range(1, 65536))
    yield Hostile('channels.mcap', partial(_mcap, many))
    yield Hostile('channels_and_more.mcap', partial(_mcap, many[:-1] + b'x' + whole))
    long = b''.join(_channel(i, 0, f'/{"x" * 500}{i}') for i in range(1, 20000))
    yield Hostile('long_channels.mcap', partial(_mcap, long))
    schemas = b''.join(_schema(i, f'a/msg/B{i}', 'ros2msg', 'uint8 x') for i in range(1, 65536))
    yield Hostile('schemas.mcap', partial(_mcap, schemas + whole))
    again = _schema(1, _UNKNOWN, 'ros2msg', 'uint8 x') * 100_000
    yield Hostile('schema_again.mcap', partial(_mcap, again + whole))


def _of_chunks(whole: bytes) -> Iterator[Hostile]:
    good = zstandard.compress(whole)
    for compression, data in {
        'zstd': zstd_zeros(2**29, whole[:1000]),
        'zstd_4GB': zstd_zeros(2**32, whole[:1000]),
        'zstd_claims': zstd_zeros(0, b'\0', claims=2**62),
        'zstd_window': zstd_zeros(0, b'\0', window=0xF8),
        'zstd_frames': good * 100,
        'zstd_skippable': b'\x50\x2a\x4d\x18\x00\x00\x00\x00' * 100_000 + good,
        'lz4': lz4.frame.compress(bytes(2**28)),
        'lz4_frames': lz4.frame.compress(bytes(2**20)) * 500,
        '': b'',
    }.items():
        for size in (0, len(whole), 2**29, 2**32, 2**63):
            chunk = _chunk(data, compression.partition('_')[0], size)
            index = _chunk_index(_DATA_AT, len(chunk), size, compression.partition('_')[0])
            name = f'chunk_{compression or "none"}_{size:x}'
            if size in (0, len(whole), 2**63):
                yield Hostile(f'{name}.mcap', _mcap(chunk))
            yield Hostile(f'{name}_index.mcap', _mcap(chunk, index + _statistics(9, 9, 1)))
    yield Hostile('chunk_strange.mcap', _mcap(_chunk(good, CONTROL, 9)))
    yield Hostile('chunk_in_chunk.mcap', _mcap(_chunk(_chunk(whole, inner=len(whole)), '', 10**5)))
    yield Hostile('chunks_empty.mcap', _mcap(_chunk(b'') * 100_000))
    chunk = _chunk(good, 'zstd', len(whole))
    index = _chunk_index(_DATA_AT, len(chunk), len(whole), 'zstd')
    channels = _without_messages(whole)
    for count in (10, 1000, 20_000):
        summary = channels + index * count + _statistics(count, 9, count)
        yield Hostile(f'chunk_{count}_times.mcap', _mcap(chunk, summary))
    bare = _chunk_index(_DATA_AT, 2**62, 2**62) + _statistics(1, 1, 1)
    yield Hostile('chunk_beyond.mcap', _mcap(chunk, bare))
    itself = _chunk_index(0, 2**20, 2**20, 'zstd') + _statistics(1, 1, 1)
    yield Hostile('chunk_at_0.mcap', _mcap(chunk, itself))


def _without_messages(records: bytes) -> bytes:
    kept, at = [], 0
    while at < len(records):
        kind, length = struct.unpack_from('<BQ', records, at)
        end = at + 9 + length
        if kind != 5:
            kept.append(records[at:end])
        at = end
    return b''.join(kept)


def _of_records(whole: bytes) -> Iterator[Hostile]:
    many = _channel(1, 0, '/x') + _message(1, 1, b'\0\1\0\0') * 300_000
    last = 2**64 - 1
    late = _channel(1, 0, '/x') + _message(1, last, bytes(4))
    counts = struct.pack('<HQ', 1000, 2**63)
    attachment = _record(9, bytes(16) + _string('../../kept/canary') + _string('') + bytes(12))
    claim = bytes(16) + _string('x') + _string('') + struct.pack('<Q', 2**40)
    metadata = _record(12, _string(CONTROL) + _string(_string('a') + _string('b')))
    yield Hostile('messages.mcap', partial(_mcap, many))
    yield Hostile('messages_of_nobody.mcap', _mcap(_message(7, 1, bytes(9)) + whole))
    yield Hostile('late.mcap', _mcap(whole + late))
    yield Hostile('attachments.mcap', _mcap(attachment * 20_000 + whole))
    yield Hostile('attachment_claims.mcap', _mcap(_record(9, claim, 2**40) + whole))
    yield Hostile('metadata.mcap', _mcap(metadata * 50_000 + whole))
    yield Hostile('strange_records.mcap', _mcap(_record(200, b'') * 300_000 + whole))
    yield Hostile('record_claims.mcap', _mcap(_record(200, b'', 2**63) + whole))
    yield Hostile('data_ends.mcap', _mcap(_record(15, bytes(4)) * 100_000 + whole))
    for name, summary in {
        'count': _statistics(2**63, 1, 0, counts),
        'nothing': _statistics(0, 0, 0),
        'chunks': _statistics(0, 0, 2**32 - 1),
        'many': _statistics(0, 0, 0, struct.pack('<HQ', 1, 1) * 100_000),
        'again': _statistics(0, 0, 0) * 100_000,
    }.items():
        yield Hostile(f'statistics_{name}.mcap', _mcap(whole, summary))
    for start in (1, 8, 2**40, last):
        yield Hostile(f'summary_at_{start:x}.mcap', _mcap(whole, _statistics(0, 0, 0), start=start))


def _of_messages(good: Path, whole: bytes) -> Iterator[Hostile]:
    """Messages of known types with lengths and sizes that claim much."""
    for at in range(4, 120, 4):
        for value in (2**32 - 1, 2**31, 10**8):
            word = struct.pack('<I', value)

            def change(_: str, data: bytes, at: int = at, word: bytes = word) -> bytes:
                return data[:at] + word + data[at + 4 :]

            if value == 2**32 - 1 or at % 16 == 4:
                make = partial(_changed, good, change)
                yield Hostile(f'word_{at}_{value:x}.mcap', make)

    def zeros(_: str, data: bytes) -> bytes:
        return data[:4] + zstd_zeros(2**30)

    yield Hostile('message_zstd.mcap', partial(_changed, good, lambda _, __: zstd_zeros(2**32)))
    yield Hostile('message_zeros.mcap', partial(_changed, good, zeros))


def _changed(good: Path, change: Callable[[str, bytes], bytes]) -> bytes:
    return _mcap(_good_records(good, change))


_TABLES = (
    'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, '
    'serialization_format TEXT, offered_qos_profiles TEXT)',
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)',
)
_TOPIC = (
    "INSERT INTO topics VALUES(1, '/pose_mixture', 'hmt_msgs/msg/PoseMixture', 'cdr', ''), "
    "(2, '/image/compressed', 'sensor_msgs/msg/CompressedImage', 'cdr', '')"
)
_ENDLESS = 'WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c{}) '
_ROW = "SELECT x AS id, 1 + x % 2 AS topic_id, x AS timestamp, x'00010000' AS data FROM c"
_TOPIC_ROW = (
    "SELECT x AS id, '/x' || x AS name, 'a/msg/B' AS type, 'cdr' AS serialization_format, "
    "'' AS offered_qos_profiles FROM c"
)
_MESSAGES_OF = 'CREATE VIEW messages AS '
_DATABASES: dict[str, Sequence[str]] = {
    'endless': (_TABLES[0], _TOPIC, _MESSAGES_OF + _ENDLESS.format('') + _ROW),
    'view_1e7': (_TABLES[0], _TOPIC, _MESSAGES_OF + _ENDLESS.format(' LIMIT 10000000') + _ROW),
    'topics_endless': (_TABLES[1], 'CREATE VIEW topics AS ' + _ENDLESS.format('') + _TOPIC_ROW),
    'topics_1e6': (
        _TABLES[1],
        'CREATE VIEW topics AS ' + _ENDLESS.format(' LIMIT 1000000') + _TOPIC_ROW,
    ),
    'joins': (
        _TABLES[0],
        _TOPIC,
        'CREATE TABLE n(x)',
        'INSERT INTO n ' + _ENDLESS.format(' LIMIT 3000') + 'SELECT x FROM c',
        _MESSAGES_OF + 'SELECT a.x AS id, 1 AS topic_id, a.x AS timestamp, '
        "x'00' AS data FROM n a, n b, n c, n d WHERE a.x + b.x + c.x + d.x < 0",
    ),
    'blobs': (
        _TABLES[0],
        _TOPIC,
        _MESSAGES_OF + 'SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(999999999) AS data',
    ),
    'concatenated': (
        _TABLES[0],
        _TOPIC,
        _MESSAGES_OF + 'SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, '
        "replace(hex(zeroblob(100000000)), '0', '0000') AS data",
    ),
    'generated': (
        _TABLES[0],
        _TOPIC,
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, '
        'data BLOB GENERATED ALWAYS AS (zeroblob(500000000 + id)) VIRTUAL)',
        'INSERT INTO messages(topic_id, timestamp) VALUES(1, 1), (2, 2), (1, 3)',
    ),
    'names': (
        *_TABLES,
        f"INSERT INTO topics VALUES(1, '{CONTROL}', 'hmt_msgs/msg/PoseMixture', 'cdr', ''), "
        f"(2, '{'/x' * 50_000}', '{CONTROL}', 'cdr', '')",
        "INSERT INTO messages VALUES(1, 1, 1, x'00010000'), (2, 2, 2, x'00010000')",
    ),
    'types': (
        *_TABLES,
        "INSERT INTO topics VALUES(1, x'ff', 7, NULL, 3.5), (2, NULL, NULL, 'cdr', x'00')",
        "INSERT INTO messages VALUES(1, 'a', 'b', 7), (2, 1, 1e300, NULL)",
    ),
    'times': (
        *_TABLES,
        _TOPIC,
        "INSERT INTO messages VALUES(1, 1, -9223372036854775808, x'00010000'), "
        "(2, 2, 9223372036854775807, x'00010000')",
    ),
    'definitions': (
        *_TABLES,
        _TOPIC,
        'CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT)',
        "INSERT INTO schema VALUES(4, 'jazzy')",
        'CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, '
        'encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)',
        "INSERT INTO message_definitions VALUES(1, 'hmt_msgs/msg/PoseMixture', 'ros2msg', "
        "'string[1000000000] x', '')",
        'INSERT INTO messages VALUES(1, 1, 1, zeroblob(64)), (2, 2, 2, zeroblob(64))',
    ),
    'metadata': (
        *_TABLES,
        _TOPIC,
        'CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT)',
        f"INSERT INTO metadata VALUES(1, 9, '{ALIASES}')",
    ),
    'triggers': (
        *_TABLES,
        _TOPIC,
        'CREATE TABLE x(a CHECK (a < 1))',
        'CREATE TRIGGER t AFTER INSERT ON x BEGIN INSERT INTO x VALUES(NEW.a - 1); END',
        "CREATE INDEX i ON messages(replace(hex(data), '0', '0000'))",
    ),
    'nested_views': (
        _TABLES[0],
        _TOPIC,
        "CREATE VIEW v0 AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, x'00' AS data",
        *(
            f'CREATE VIEW v{i} AS SELECT * FROM v{i - 1} UNION ALL SELECT * FROM v{i - 1}'
            for i in range(1, 40)
        ),
        _MESSAGES_OF + 'SELECT * FROM v39',
    ),
    'itself': (_TABLES[0], _MESSAGES_OF + 'SELECT * FROM messages'),
    'tables': tuple(f'CREATE TABLE t{i}(x)' for i in range(2000)),
    'columns': (f'CREATE TABLE messages({", ".join(f"c{i}" for i in range(2000))})', _TABLES[0]),
}


def databases() -> Iterator[Hostile]:
    """SQLite files of what a reader that only selects runs into."""
    for name, statements in _DATABASES.items():
        yield Hostile(f'{name}.db3', write=partial(_write_database, statements))
    for name, qos in YAML_BOMBS.items():
        topic = f"INSERT INTO topics VALUES(1, '/x', 'a/msg/B', 'cdr', {_quoted(qos)})"
        yield Hostile(f'qos_{name}.db3', write=partial(_write_database, (*_TABLES, topic)))


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _write_database(statements: Sequence[str], path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        for statement in ('BEGIN', *statements):
            connection.execute(statement)
        connection.commit()


def compressed_bags(good: Path) -> Iterator[Hostile]:
    """Bags inside zstd files that claim, or are, much."""
    whole = _mcap(_good_records(good))
    for name, content in {
        'zeros_1GB': lambda: zstd_zeros(2**30),
        'bag_64GB': lambda: zstd_zeros(2**36, _MAGIC),
        'chunk_8GB': lambda: zstd_zeros(2**33, _MAGIC + _record(200, b'', 2**33)),
        'claims': lambda: zstd_zeros(0, _MAGIC, claims=2**63),
        'window': lambda: zstd_zeros(0, _MAGIC, window=0xF8),
        'window_2GB': lambda: zstd_zeros(2**31, _MAGIC, window=0xA8),
        'frames': lambda: zstandard.compress(_MAGIC) * 100_000,
        'skippable': lambda: b'\x50\x2a\x4d\x18\0\0\0\0' * 300_000 + zstandard.compress(whole),
        'twice': lambda: zstandard.compress(zstandard.compress(whole)),
        'database': lambda: zstd_zeros(2**34, b'SQLite format 3\0'),
        'nothing': lambda: zstd_zeros(0),
    }.items():
        for suffix in ('.mcap.zstd', '.db3.zst')[: 1 + (name == 'database')]:
            yield Hostile(f'{name}{suffix}', content)


def bag_folders(good: Path) -> Iterator[Hostile]:
    """Folders with metadata.yaml."""
    bag = next((good / 'bag').glob('*.mcap')).read_bytes()
    head = 'rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths: '
    many = ', '.join(f'x{i}.mcap' for i in range(100_000))
    metadata = {
        **{
            f'yaml_{name}': f'{head}[x.mcap]\n  a:\n{bare(text)}'
            for name, text in YAML_BOMBS.items()
        },
        **{f'whole_{name}': text for name, text in YAML_BOMBS.items()},
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
