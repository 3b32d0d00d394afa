"""Well-formed bags with excessive claims: one error line, without much memory."""

import os
import sqlite3
import struct
import tempfile
import tracemalloc
import zlib

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, Statistics

from msg_tools import BagError, BagReader
from msg_tools.bags import bag_reader, mcap_file, sqlite_file
from msg_tools.messages import cdr

MAGIC = b'\x89MCAP0\r\n'
HEADER = b'\x01' + struct.pack('<QII', 8, 0, 0)
END = b'\x0f' + struct.pack('<QI', 4, 0) + b'\x02' + struct.pack('<QQQI', 20, 0, 0, 0) + MAGIC
STRING = 'std_msgs/msg/String'
ZEROS = bytes(2**24)


def text(value):
    data = value.encode()
    return struct.pack('<I', len(data)) + data


def record(opcode, content):
    return struct.pack('<BQ', opcode, len(content)) + content


def described(msgtype=STRING, definition='string data', topic='/a', key=1, encoding='ros2msg'):
    schema = struct.pack('<H', key) + text(msgtype) + text(encoding) + text(definition)
    channel = struct.pack('<HH', key, key) + text(topic) + text('cdr') + text('')
    return record(3, schema) + record(4, channel)


def message(data, time=0, key=1):
    return record(5, struct.pack('<HIQQ', key, 0, time, time) + data)


def chunk(content, compression='zstd', size=None, packed=None):
    pack = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress, '': bytes}
    packed = pack[compression](content) if packed is None else packed
    size = len(content) if size is None else size
    fixed = struct.pack('<QQQI', 0, 0, size, zlib.crc32(content) if size == len(content) else 0)
    return record(6, fixed + text(compression) + struct.pack('<Q', len(packed)) + packed)


def with_summary(data, chunks, count):
    """A file whose summary lists chunks by offset and length."""
    summary = RecordBuilder()
    for offset, length in chunks:
        ChunkIndex(length, offset, 'zstd', 0, 0, 0, {}, 0, 0).write(summary)
    Statistics(0, 1, {1: count}, len(chunks), count, 0, 0, 0, 1).write(summary)
    content = described() + summary.end()
    start = len(MAGIC + HEADER + data)
    footer = b'\x02' + struct.pack('<QQQI', 20, start, 0, 0)
    return MAGIC + HEADER + data + content + footer + MAGIC


def error_of(path, *, peak=2**25):
    """The error line for a bag, refused with at most `peak` bytes of memory."""
    line = ''
    tracemalloc.start()
    try:
        with BagReader(path) as bag:
            for stored in bag.messages():
                assert stored.message is not None
    except BagError as error:
        line = str(error)
    reached = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reached < peak
    assert line
    assert '\n' not in line
    return line


def string(value):
    return b'\x00\x01\x00\x00' + struct.pack('<I', len(value) + 1) + value.encode() + b'\x00'


# Chunks


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_many_bombs_share_one_budget(tmp_path, compression):
    path = tmp_path / 'bombs.mcap'
    bomb = chunk(record(0x80, ZEROS), compression)
    path.write_bytes(MAGIC + HEADER + described() + bomb * 100 + END)
    assert 'is refused: it unpacks to more than' in error_of(path, peak=2 * len(ZEROS) + 2**22)


@pytest.mark.parametrize(
    ('size', 'packed', 'compression', 'error'),
    [
        (2**60, None, 'zstd', 'a chunk of'),
        (2**27, None, 'zstd', 'it unpacks to more than'),
        (2**27, None, 'lz4', 'it unpacks to more than'),
        (100, None, 'zstd', 'a chunk of another size than 100'),
        (100, None, 'lz4', 'a chunk of another size than 100'),
        (100, zstandard.ZstdCompressor(write_content_size=False).compress(ZEROS), 'zstd', 'Zstd'),
        (100, b'\x28\xb5\x2f\xfd\xe0' + b'\xff' * 8 + bytes(9), 'zstd', 'ZstdError'),
        (0, None, 'zstd', 'a chunk of another size than 0'),
    ],
)
def test_the_size_that_a_chunk_claims_bounds_its_unpacking(
    tmp_path, size, packed, compression, error
):
    path = tmp_path / 'claim.mcap'
    content = record(0x80, ZEROS)
    body = described() + chunk(content, compression, size, packed)
    path.write_bytes(MAGIC + HEADER + body + END)
    assert error in error_of(path, peak=2**20)


def test_a_chunk_of_nothing_but_empty_records(tmp_path):
    path = tmp_path / 'records.mcap'
    path.write_bytes(MAGIC + HEADER + described() + chunk(message(b'') * 200_000) + END)
    assert 'is refused: it has more than 10' in error_of(path, peak=2**24)


def test_a_file_of_nothing_but_empty_records(tmp_path):
    path = tmp_path / 'records.mcap'
    path.write_bytes(MAGIC + HEADER + record(0x80, b'') * 200_000 + END)
    assert 'is refused: it has more than' in error_of(path, peak=2**20)


def test_a_summary_that_lists_one_chunk_many_times(tmp_path):
    path = tmp_path / 'again.mcap'
    data = described() + chunk(message(string('once')) + record(0x80, ZEROS))
    place = len(MAGIC + HEADER + described()), len(data) - len(described())
    path.write_bytes(with_summary(data, [place] * 20_000, 1))
    with BagReader(path) as bag:
        assert [stored.message.data for stored in bag.messages()] == ['once']
    path.write_bytes(with_summary(data, [(place[0], 2**63)], 1))
    with BagReader(path) as bag:
        assert [stored.message.data for stored in bag.messages()] == ['once']


def test_chunks_that_are_open_at_a_time(tmp_path, monkeypatch):
    path = tmp_path / 'overlap.mcap'
    content = message(string('first')) + message(string('x' * 10_000), 10)
    path.write_bytes(MAGIC + HEADER + described() + chunk(content) * 50 + END)
    with BagReader(path) as bag:
        assert len(list(bag.messages())) == 100
    monkeypatch.setattr(mcap_file, '_MAX_OPEN', 200_000)
    assert 'is refused: its chunks overlap in time' in error_of(path)


def test_lengths_and_keys_that_lead_nowhere(tmp_path, read):
    path = tmp_path / 'file.mcap'
    whole = MAGIC + HEADER + described() + message(string('whole'))
    for opcode in (3, 4, 5, 6, 9, 12, 0x80):
        path.write_bytes(whole + struct.pack('<BQ', opcode, 2**62) + bytes(100))
        found, error = read(path)
        assert len(found) == 1
        assert error == 'breaks off'
    for content in (message(b'', key=9), record(5, b'\x01\x00'), record(6, b''), record(3, b'')):
        path.write_bytes(whole + content + END)
        found, error = read(path)
        assert len(found) == 1
        assert 'is damaged: ' in error


def test_schemas_are_spent_too(tmp_path):
    path = tmp_path / 'descriptions.mcap'
    many = b''.join(described(definition='#' * 60_000, key=key) for key in range(100))
    path.write_bytes(MAGIC + HEADER + described() + chunk(many) + END)
    assert 'is refused: it unpacks to more than' in error_of(path)
    path.write_bytes(MAGIC + HEADER + described() + described(definition='#' * 2**20) + END)
    assert 'a schema or channel of 1048' in error_of(path)


def test_a_bag_of_very_many_topics(tmp_path, monkeypatch):
    path = tmp_path / 'topics.mcap'
    channels = b''.join(
        record(4, struct.pack('<HH', i, 1) + text(f'/topic/{i}') + text('cdr') + text(''))
        for i in range(2, 65_535)
    )
    path.write_bytes(MAGIC + HEADER + described() + channels + message(string('x')) + END)
    with BagReader(path) as bag:
        assert len(bag.topics) == 65_534
        with pytest.raises(BagError) as caught:
            bag.find_topic(['sensor_msgs/msg/Image'])
        assert len(str(caught.value)) < 600
        # The two are not compared with each other.
        assert len(list(bag.messages(list(bag.topics)))) == 1


def test_attachments_are_not_read(tmp_path):
    path = tmp_path / 'attachment.mcap'
    attachment = record(9, bytes(16) + text('../../name') + text('') + struct.pack('<Q', 0) + ZEROS)
    path.write_bytes(MAGIC + HEADER + described() + attachment + message(string('x')) + END)
    tracemalloc.start()
    with BagReader(path) as bag:
        assert [stored.message.data for stored in bag.messages()] == ['x']
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


# Compressed files and messages


def test_a_compressed_file_is_unpacked_within_its_budget(tmp_path, monkeypatch):
    scratch = tmp_path / 'scratch'
    scratch.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(scratch))
    path = tmp_path / 'bomb.mcap.zstd'
    path.write_bytes(zstandard.compress(MAGIC + ZEROS * 20))
    assert 'is refused: it unpacks to more than' in error_of(path, peak=2**23)
    assert list(scratch.iterdir()) == []
    # Consecutive frames, and a skippable one.
    content = MAGIC + HEADER + described() + message(string('x')) + END
    skipped = struct.pack('<II', 0x184D2A50, 4) + b'note'
    path.write_bytes(zstandard.compress(content[:60]) + skipped + zstandard.compress(content[60:]))
    with BagReader(path) as bag:
        assert [stored.message.data for stored in bag.messages()] == ['x']


def test_the_files_of_a_folder_share_one_budget(tmp_path):
    bomb = zstandard.compress(MAGIC + HEADER + described() + record(0x80, ZEROS) + END)
    names = [f'{i}.mcap.zstd' for i in range(10)]
    for name in names:
        (tmp_path / name).write_bytes(bomb)
    metadata = 'rosbag2_bagfile_information: {relative_file_paths: [%s]}'
    (tmp_path / 'metadata.yaml').write_text(metadata % ', '.join(names))
    assert 'is refused: it unpacks to more than' in error_of(tmp_path, peak=2**23)


def test_the_topics_of_all_files_of_a_folder_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_reader, 'MAX_TOPICS', 1)
    for name in ('a.mcap', 'b.mcap'):
        (tmp_path / name).write_bytes(MAGIC + HEADER + described() + END)
    text = 'rosbag2_bagfile_information: {relative_file_paths: [a.mcap, b.mcap]}'
    (tmp_path / 'metadata.yaml').write_text(text)
    assert 'has more than 1 topics in its files' in error_of(tmp_path)


def test_a_compressed_message(tmp_path):
    path = tmp_path / 'message.mcap'
    packed = zstandard.compress(b'\x00\x01\x00\x00' + ZEROS * 20)
    path.write_bytes(MAGIC + HEADER + described() + message(packed) + END)
    assert 'can not be read as std_msgs/msg/String: it unpacks to more' in error_of(
        path, peak=2**28
    )


# Messages


@pytest.mark.parametrize(
    ('msgtype', 'definition', 'data'),
    [
        ('a/msg/X', 'a/Y[] y\n=====\nMSG: a/Y\n', struct.pack('<I', 2**24)),
        ('a/msg/X', 'string[] y', struct.pack('<I', 2**21)),
        ('visualization_msgs/msg/MarkerArray', '', struct.pack('<I', 2**17)),
    ],
)
def test_the_values_of_a_message_are_bounded_before_they_are_made(
    tmp_path, monkeypatch, msgtype, definition, data
):
    monkeypatch.setattr(cdr, 'MAX_VALUES', 10_000)
    path = tmp_path / 'values.mcap'
    data = b'\x00\x01\x00\x00' + data + ZEROS
    path.write_bytes(MAGIC + HEADER + described(msgtype, definition) + chunk(message(data)) + END)
    assert f'can not be read as {msgtype}: 1677' in error_of(path, peak=2**27)


def test_the_length_of_a_sequence_is_compared_with_the_bytes(tmp_path):
    path = tmp_path / 'length.mcap'
    for definition in ('uint8[] y', 'string[] y', 'a/Y[] y\n===\nMSG: a/Y\n', 'float64[] y'):
        data = message(b'\x00\x01\x00\x00' + b'\xff' * 4 + bytes(100))
        path.write_bytes(MAGIC + HEADER + described('a/msg/X', definition) + data + END)
        assert 'can not be read as a/msg/X: ' in error_of(path, peak=2**21)


def test_many_definitions_of_one_topic(tmp_path):
    path = tmp_path / 'definitions.mcap'
    channels = [described('a/msg/X', f'int32 x{key}', key=key) for key in range(1, 100)]
    path.write_bytes(MAGIC + HEADER + b''.join(channels) + message(bytes(8)) + END)
    with BagReader(path) as bag, pytest.raises(BagError, match='topic /a has 99 definitions'):
        bag.messages(['/a'])


# SQLite


TOPICS = (
    'CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, '
    'offered_qos_profiles)'
)
MESSAGES = 'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)'
NUMBERS = 'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT {})'
# Each view uses the previous one twice, so counting their columns takes 2**40 steps.
NESTED_VIEWS = (
    'CREATE VIEW v0 AS SELECT 1 AS x',
    *(f'CREATE VIEW v{i + 1} AS SELECT a.x FROM v{i} a, v{i} b' for i in range(40)),
)
TOPIC = f"INSERT INTO topics VALUES (1, '/a', '{STRING}', 'cdr', 'a: &a [*a]')"


def database(path, *statements):
    path.unlink(missing_ok=True)
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()
    return path


@pytest.mark.parametrize(
    ('statements', 'error'),
    [
        ([TOPICS, f'CREATE VIEW messages AS {NUMBERS.format(-1)} SELECT i FROM n'], 'has views'),
        ([MESSAGES, f'CREATE VIEW topics AS {NUMBERS.format(-1)} SELECT i FROM n'], 'has views'),
        ([TOPICS, 'CREATE VIRTUAL TABLE messages USING fts4(topic_id, timestamp)'], 'has views'),
        ([TOPICS, MESSAGES, *NESTED_VIEWS], 'has views'),
        (
            [
                TOPICS,
                'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, '
                'data AS (zeroblob(1000000000)))',
            ],
            'no tables',
        ),
        (
            [
                TOPICS,
                MESSAGES,
                f'INSERT INTO topics {NUMBERS.format(2000)} '
                f"SELECT i, '/' || i, '{STRING}', 'cdr', '' FROM n",
            ],
            'is refused: it has more than',
        ),
        ([TOPICS, MESSAGES, 'INSERT INTO topics VALUES (1, 1, 2, 3, 4)'], 'DataError: a row has'),
        ([TOPICS, MESSAGES, TOPIC, "INSERT INTO messages VALUES (1, 1, 'x', x'00')"], 'a row has'),
        ([TOPICS, MESSAGES, TOPIC, 'INSERT INTO messages VALUES (1, 1, 1, 5)'], 'a row has'),
        ([TOPICS, MESSAGES, TOPIC, "INSERT INTO messages VALUES (1, 1, -1, x'00')"], 'before 1970'),
    ],
)
def test_databases_that_are_no_bags(tmp_path, monkeypatch, statements, error):
    monkeypatch.setattr(sqlite_file, 'MAX_TOPICS', 1000)
    line = error_of(database(tmp_path / 'file.db3', *statements), peak=2**26)
    assert error in line


def test_a_database_is_opened_for_reading_alone_and_its_steps_are_counted(tmp_path, monkeypatch):
    path = database(
        tmp_path / 'a?b #%20.db3',
        TOPICS,
        MESSAGES,
        TOPIC,
        f'INSERT INTO messages {NUMBERS.format(50_000)} '
        f"SELECT i, 1, i, x'{string('x').hex()}' FROM n",
    )
    before = path.read_bytes(), sorted(tmp_path.iterdir())
    with BagReader(path) as bag:
        assert sum(stored.message.data == 'x' for stored in bag.messages()) == 50_000
    assert (path.read_bytes(), sorted(tmp_path.iterdir())) == before
    monkeypatch.setattr(sqlite_file, '_STEPS', 0)
    monkeypatch.setattr(sqlite_file, '_STEPS_PER_BYTE', 0)
    assert 'interrupted' in error_of(path)


# Folders


@pytest.mark.parametrize(
    ('metadata', 'error'),
    [
        ('a: &a [x]\nb: *a', 'an alias'),
        ('[' * 10_000, 'nested deeper'),
        ('#' * 2**19 + '\na: 1', 'wanted at most'),
        (
            'rosbag2_bagfile_information: {relative_file_paths: [x.mcap, /dev/x.mcap]}',
            'names a file twice',
        ),
        ('rosbag2_bagfile_information: {relative_file_paths: [pipe]}', 'pipe, which its metadata'),
        ('rosbag2_bagfile_information: {relative_file_paths: [folder]}', 'folder, which its'),
        (f'rosbag2_bagfile_information: {{relative_file_paths: [{"x" * 5000}]}}', 'is missing'),
        ('rosbag2_bagfile_information: {relative_file_paths: ["a\\0b"]}', 'is missing'),
    ],
)
def test_metadata_from_outside(tmp_path, metadata, error):
    (tmp_path / 'metadata.yaml').write_text(metadata)
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'folder').mkdir()
    assert error in error_of(tmp_path)
