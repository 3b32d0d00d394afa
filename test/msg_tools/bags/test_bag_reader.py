"""Reading bags: all forms that recorders write, and one error line for every defect."""

import csv
import json
import os
import tempfile
import tracemalloc

import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from msg_tools import BagError, BagReader, BagWriter
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import typestore, typestore_of_definition

STRING = 'std_msgs/msg/String'


def text(messages, value):
    return serialise(messages.create(STRING, data=value))


def values(path, topics=None):
    with BagReader(path) as bag:
        return [(stored.log_time_ns, stored.message.data) for stored in bag.messages(topics)]


def write_mcap(
    path,
    entries,
    *,
    msgtype=STRING,
    encoding='cdr',
    definition=b'string data\n',
    topic='/chatter',
    **options,
):
    with path.open('wb') as file:
        writer = Writer(file, **options)
        writer.start(profile='ros2', library='test')
        schema = writer.register_schema(msgtype, 'ros2msg', definition)
        channel = writer.register_channel(topic, encoding, schema)
        for time, data in entries:
            writer.add_message(channel, time, data, time)
        writer.finish()


def write_metadata(folder, names):
    information = {'version': 9, 'storage_identifier': 'mcap', 'relative_file_paths': names}
    document = yaml.safe_dump({'rosbag2_bagfile_information': information})
    (folder / 'metadata.yaml').write_text(document)


# What recorders write


def test_reads_what_the_writer_wrote(small_bag):
    with BagReader(small_bag) as bag:
        assert {name: topic.message_count for name, topic in bag.topics.items()} == {
            '/note': 1,
            '/text': 26,
            '/image/compressed': 13,
        }
        assert bag.topic('note').msgtype == STRING
        assert bag.message_count() == 40
        assert bag.message_count(['/text', 'note']) == 27
        stored = list(bag.messages(['text']))
        assert [message.message.data for message in stored[:2]] == ['text 1', 'text 2']
        assert stored[0].message is stored[0].message
        assert all(message.topic == '/text' and message.msgtype == STRING for message in stored)
        # Again, and as a single file.
        assert [m.log_time_ns for m in bag.messages(['text'])] == [m.log_time_ns for m in stored]
    assert values(small_bag / 'small.mcap', ['text']) == values(small_bag, ['text'])


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize(
    'options',
    [
        {},
        {'use_chunking': False},
        {'index_types': IndexType.NONE, 'repeat_channels': False, 'repeat_schemas': False},
        {'use_statistics': False},
        {'use_chunking': False, 'use_statistics': False, 'use_summary_offsets': False},
        {'enable_crcs': False},
        {'enable_data_crcs': True},
    ],
    ids=lambda options: '-'.join(options) or 'plain',
)
def test_any_mcap_comes_in_the_order_of_time(tmp_path, messages, options, compression):
    rng = np.random.default_rng(5)
    # Many equal and unordered times, so that many chunks overlap.
    times = (np.arange(400) // 2 + rng.integers(-30, 30, 400)).clip(0).tolist()
    path = tmp_path / 'any.mcap'
    entries = [(time, text(messages, f'{i} ' + 'x' * 50)) for i, time in enumerate(times)]
    write_mcap(path, entries, chunk_size=900, compression=compression, **options)
    wanted = [(times[i], f'{i} ' + 'x' * 50) for i in np.argsort(times, kind='stable')]
    assert values(path) == wanted
    with BagReader(path) as bag:
        assert bag.message_count() == 400
        assert bag.topics['/chatter'].message_count == 400


def test_split_bag_is_merged_by_time(tmp_path, messages):
    folder = tmp_path / 'split'
    folder.mkdir()
    for part, times in enumerate([range(0, 100, 3), range(50, 150, 5), range(120, 200, 7)]):
        entries = [(time, text(messages, f'{part}.{time}')) for time in times]
        write_mcap(folder / f'split_{part}.mcap', entries, chunk_size=200)
    # Early versions included the folder in the names.
    write_metadata(folder, ['split/split_0.mcap', 'split_1.mcap', 'split_2.mcap'])
    found = values(folder)
    assert len(found) == 34 + 20 + 12
    order = [(time, int(value[0])) for time, value in found]
    assert order == sorted(order)
    with BagReader(folder) as bag:
        assert bag.message_count() == 66


def test_files_compressed_as_a_whole(tmp_path, messages, monkeypatch):
    folder = tmp_path / 'packed'
    folder.mkdir()
    for part in range(2):
        plain = tmp_path / f'{part}.mcap'
        write_mcap(plain, [(10 * part + i, text(messages, f'{part}.{i}')) for i in range(5)])
        packed = zstandard.compress(plain.read_bytes())
        (folder / f'packed_{part}.mcap.zstd').write_bytes(packed)
    write_metadata(folder, ['packed_0.mcap.zstd', 'packed_1.mcap.zstd'])
    assert values(folder) == [(10 * p + i, f'{p}.{i}') for p in range(2) for i in range(5)]
    single = folder / 'packed_1.mcap.zstd'
    assert values(single) == [(10 + i, f'1.{i}') for i in range(5)]
    scratch = tmp_path / 'scratch'
    scratch.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(scratch))
    with BagReader(single):
        (unpacked,) = scratch.iterdir()
        assert unpacked.is_dir()
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize(
    'mode', [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE]
)
@pytest.mark.parametrize('plugin', list(StoragePlugin))
def test_bags_of_rosbags(tmp_path, messages, plugin, mode):
    path = tmp_path / 'bag'
    writer = RosbagsWriter(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        chatter = writer.add_connection('/chatter', STRING, typestore=typestore())
        other = writer.add_connection('/other', STRING, typestore=typestore())
        for i in (3, 1, 2, 2, 0):
            writer.write(chatter, 100 + i, text(messages, f'text {i}'))
            writer.write(other, 50 + i, text(messages, 'other'))
    found = [(100 + i, f'text {i}') for i in (0, 1, 2, 2, 3)]
    assert values(path, ['chatter']) == found
    assert len(values(path)) == 10
    with BagReader(path) as bag:
        assert bag.topics['/chatter'].message_count == 5
        assert bag.topics['/chatter'].msgtype == STRING


def test_a_type_that_only_the_bag_knows(tmp_path):
    path = tmp_path / 'own.mcap'
    rule = b'=' * 80
    definition = b'my_msgs/Inner inner\nuint8[] data\n' + rule + b'\nMSG: my_msgs/Inner\nint16 x\n'
    data = b'\x00\x01\x00\x00' + b'\x07\x00\x00\x00' + b'\x02\x00\x00\x00\x05\x06'
    write_mcap(path, [(1, data)], msgtype='my_msgs/Outer', definition=definition)
    with BagReader(path) as bag:
        (stored,) = bag.messages()
        assert stored.msgtype == 'my_msgs/msg/Outer'
        assert stored.message.inner.x == 7
        assert stored.message.data.tolist() == [5, 6]
    write_mcap(path, [(1, b'\x00\x01\x00\x00\x00')], msgtype='my_msgs/msg/Empty', definition=b'')
    with BagReader(path) as bag:
        (stored,) = bag.messages()
        assert stored.message.structure_needs_at_least_one_member == 0


def test_a_known_type_in_another_version_is_read_by_its_own_definition(tmp_path):
    path = tmp_path / 'old.mcap'
    data = b'\x00\x01\x00\x00' + b'\x03\x00\x00\x00ab\x00'
    for msgtype in (STRING, 'hmt_msgs/msg/Keypoints2D'):
        write_mcap(path, [(1, data)], msgtype=msgtype, definition=b'string only_this\n')
        with BagReader(path) as bag:
            (stored,) = bag.messages()
            if msgtype == STRING:
                assert stored.message.only_this == 'ab'
                continue
            # All fields of the project's own types must be known.
            with pytest.raises(BagError, match='recorded with another definition of this type'):
                _ = stored.message


@pytest.mark.parametrize('nested', [False, True])
def test_messages_of_the_project_from_before_a_field(tmp_path, messages, nested):
    """Fields missing in the definition are zero or empty, also in older nested types."""
    kind = 'hmt_msgs/msg/PoseMixture'
    component = messages.create('hmt_msgs/msg/PoseComponent', id=3, mean=np.arange(4.0))
    header = header_message(messages, 5, 'lens')
    message = messages.create(kind, header=header, components=[component, component], reason='so')
    definition, _ = typestore().generate_msgdef(kind, ros_version=2)
    lacking = ['float64 posterior_weight\n', 'float64[] ancestry\n']
    if not nested:
        lacking += ['uint32[] ancestry_ids\n', 'builtin_interfaces/Time ancestry_stamp\n']
    for field in lacking:
        assert definition.count(field) == 1
        definition = definition.replace(field, '')
    old = typestore_of_definition(kind, 'ros2msg', definition)
    data = bytes(old.serialize_cdr(message, kind))
    assert len(data) < len(serialise(message))
    path = tmp_path / 'old.mcap'
    write_mcap(path, [(1, data)], msgtype=kind, definition=definition.encode())
    with BagReader(path) as bag:
        (stored,) = bag.messages()
        assert serialise(stored.message) == serialise(message)


def test_find_topic(tmp_path, messages):
    path = tmp_path / 'bag'
    with BagWriter(path) as writer:
        writer.add_topic('/empty', STRING)
        writer.write('/a', 1, messages.create(STRING, data='a'))
        writer.write('/b', 2, messages.create('std_msgs/msg/Int32', data=1))
        writer.add_topic('/none', 'std_msgs/msg/Bool')
    with BagReader(path) as bag:
        assert bag.find_topic([STRING]).name == '/a'
        assert bag.find_topic([STRING], 'a').name == '/a'
        with pytest.raises(
            BagError, match=r'has no topic of type Image; it has /empty, /a, /b, /none$'
        ):
            bag.find_topic(['sensor_msgs/msg/Image'])
        with pytest.raises(
            BagError, match='topic /b has messages of type std_msgs/msg/Int32, wanted S'
        ):
            bag.find_topic([STRING], '/b')
        with pytest.raises(BagError, match='topic /empty has no messages'):
            bag.find_topic([STRING], '/empty')
        with pytest.raises(BagError, match='topic /none has no messages'):
            bag.find_topic(['std_msgs/msg/Bool'])
        with pytest.raises(
            BagError, match=r'several topics of String or Int32: name one of /a, /b'
        ):
            bag.find_topic([STRING, 'std_msgs/msg/Int32'])
        with pytest.raises(BagError, match='has no topic /c; it has /empty'):
            bag.messages(['/c'])


# Defects


@pytest.mark.parametrize(
    ('content', 'error'),
    [
        (b'', 'is empty, wanted'),
        (b'\x89MCA', 'is not a bag: it starts with'),
        (b'hello world, not a bag', 'is not a bag: it starts with'),
        (b'#ROSBAG V2.0\n' + bytes(100), 'is a bag of ROS 1'),
        (b'SQLite format 3\x00' + bytes(100), 'is damaged: DatabaseError: '),
        (zstandard.compress(b'hello world'), 'is not a bag: it starts with'),
        (b'\x28\xb5\x2f\xfd' + b'\xff' * 30, 'is damaged: ZstdError: '),
    ],
    ids=['empty', 'short', 'text', 'ros1', 'sqlite', 'zstd', 'bad-zstd'],
)
def test_files_that_are_no_bag(tmp_path, content, error):
    path = tmp_path / 'file.db3'
    path.write_bytes(content)
    with pytest.raises(BagError, match=error):
        BagReader(path)


def test_places_that_are_no_bag(tmp_path):
    with pytest.raises(BagError, match='can not be read: No such file or folder'):
        BagReader(tmp_path / 'nowhere')
    with pytest.raises(BagError, match=r'has no metadata\.yaml'):
        BagReader(tmp_path)
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(BagError, match='can not be read: No such file or folder'):
        BagReader(tmp_path / 'pipe')
    with pytest.raises(BagError, match='can not be read'):
        BagReader('name\0with zero')


@pytest.mark.parametrize(
    ('content', 'error'),
    [
        ('a: [', 'not YAML'),
        ('- 1', 'names no files of a bag'),
        ('rosbag2_bagfile_information: {version: 9}', 'names no files of a bag'),
        ('rosbag2_bagfile_information: {relative_file_paths: []}', 'names no files of a bag'),
        ('rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}', 'gone.mcap, which its'),
        ('rosbag2_bagfile_information: {relative_file_paths: [..]}', 'is missing'),
        ('\x00', 'not YAML'),
    ],
)
def test_metadata_that_is_wrong(tmp_path, content, error):
    (tmp_path / 'metadata.yaml').write_text(content)
    with pytest.raises(BagError, match=error):
        BagReader(tmp_path)


def test_foreign_encoding(tmp_path):
    path = tmp_path / 'json.mcap'
    write_mcap(path, [(1, b'{}')], encoding='json')
    with BagReader(path) as bag:
        assert bag.topics['/chatter'].encoding == 'json'
        with pytest.raises(
            BagError, match="messages of /chatter are encoded as 'json', wanted cdr"
        ):
            bag.messages(['/chatter'])
        (stored,) = bag.messages()
        with pytest.raises(BagError, match="encoded as 'json'"):
            _ = stored.message


@pytest.mark.parametrize(
    ('data', 'msgtype', 'definition', 'error'),
    [
        (
            b'\x00\x01\x00\x00\xff\xff\xff\x7fab',
            STRING,
            b'string data',
            'std_msgs/msg/String: ',
        ),
        (b'\x00\x01', STRING, b'string data', 'encapsulation'),
        (b'\x00\x03\x00\x00abcd', STRING, b'string data', 'encapsulation'),
        (b'\x00\x01\x00\x00', 'no_msgs/msg/X', b'far_msgs/Y y', 'no_msgs/msg/X'),
        (b'\x00\x01\x00\x00', 'no_msgs/msg/X', b'!!', 'line 1 of its definition'),
        (b'\x00\x01\x00\x00', '', b'', 'unknown type: its definition has a type named'),
        (b'\x28\xb5\x2f\xfd' + b'\xff' * 9, STRING, b'string data', 'encapsulation'),
    ],
)
def test_messages_that_can_not_be_read(tmp_path, data, msgtype, definition, error):
    path = tmp_path / 'bad.mcap'
    write_mcap(path, [(7, data)], msgtype=msgtype, definition=definition)
    with BagReader(path) as bag:
        (stored,) = bag.messages()
        with pytest.raises(
            BagError, match='message of /chatter at 7 ns can not be read as'
        ) as caught:
            _ = stored.message
    assert error in str(caught.value)


def test_topic_of_two_types(tmp_path, messages):
    path = tmp_path / 'two.mcap'
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start()
        for msgtype in (STRING, 'std_msgs/msg/Int32'):
            schema = writer.register_schema(msgtype, 'ros2msg', b'')
            channel = writer.register_channel('/chatter', 'cdr', schema)
            writer.add_message(channel, 1, text(messages, 'text'), 1)
        writer.finish()
    with (
        BagReader(path) as bag,
        pytest.raises(BagError, match='of several kinds: std_msgs/msg/Int32'),
    ):
        bag.messages(['/chatter'])


def test_cut_anywhere_gives_what_was_there(tmp_path, small_bag, read):
    content = (small_bag / 'small.mcap').read_bytes()
    whole, error = read(small_bag / 'small.mcap')
    assert error is None
    path = tmp_path / 'cut.mcap'
    rng = np.random.default_rng(0)
    lengths = {
        *range(40),
        *rng.integers(0, len(content), 80),
        *range(len(content) - 40, len(content)),
    }
    counts = []
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        found, error = read(path)
        assert error is not None
        assert '\n' not in error
        assert found == whole[: len(found)]
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] == len(whole)


def test_flipped_bits_never_change_a_message(tmp_path, small_bag, read):
    content = (small_bag / 'small.mcap').read_bytes()
    whole, _ = read(small_bag / 'small.mcap')
    messages = {(time, data) for time, _, data in whole}
    path = tmp_path / 'flipped.mcap'
    for seed in range(150):
        rng = np.random.default_rng(seed)
        damaged = bytearray(content)
        # Headers and the summary are small, so half of the damage is placed there.
        span = len(content) if seed % 2 else 2500
        for offset in rng.integers(0, span, 1 + seed % 3):
            damaged[-1 - offset] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        found, error = read(path)
        # The summary has no checked checksum, so a topic's name may change there.
        assert error is not None or len(found) == len(whole)
        assert {(time, data) for time, _, data in found} <= messages


@pytest.mark.parametrize(
    'options', [{}, {'use_chunking': False}, {'compression': CompressionType.LZ4}]
)
def test_damage_without_checksums_is_still_bounded(tmp_path, messages, read, options):
    path = tmp_path / 'damaged.mcap'
    entries = [(i, text(messages, f'text {i}')) for i in range(50)]
    write_mcap(path, entries, chunk_size=400, enable_crcs=False, **options)
    content = path.read_bytes()
    tracemalloc.start()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        damaged = bytearray(content)
        offset = int(rng.integers(8, len(content)))
        width = int(rng.integers(1, 9))
        damaged[offset : offset + width] = [b'\xff', b'\x00', rng.bytes(1)][seed % 3] * width
        path.write_bytes(damaged)
        found, _ = read(path)
        assert len(found) <= 50
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize('field', ['record', 'uncompressed', 'compressed'])
@pytest.mark.parametrize('value', [2**62, 2**40, 2**30, 2**28])
def test_lengths_are_not_believed(tmp_path, messages, read, field, value):
    path = tmp_path / 'long.mcap'
    write_mcap(path, [(1, text(messages, 'text'))], enable_crcs=False, use_statistics=False)
    content = bytearray(path.read_bytes())
    chunk = content.index(b'\x06', 8 + 9 + 4 + 4 + 4 + 4)
    place = {'record': 1, 'uncompressed': 9 + 16, 'compressed': 9 + 28 + 8}[field]
    content[chunk + place : chunk + place + 8] = value.to_bytes(8, 'little')
    path.write_bytes(content)
    tracemalloc.start()
    found, _ = read(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # The libraries do not read all of the file.
    assert len(found) <= 1
    assert peak < 5e6


def test_a_cut_is_told_in_one_line(tmp_path, small_bag, caplog):
    path = tmp_path / 'cut.mcap'
    path.write_bytes((small_bag / 'small.mcap').read_bytes()[:1000])
    with BagReader(path) as bag:
        assert caplog.messages == [
            f'{path} breaks off: it is read up to its last complete message; `mcap recover` '
            'repairs the file, and `ros2 bag reindex` the metadata of its folder'
        ]
        with pytest.raises(BagError, match=r'has no topic of type String; it has none'):
            bag.find_topic([STRING])


def test_memory_does_not_grow_with_the_bag(tmp_path):
    path = tmp_path / 'large.mcap'
    noise = np.random.default_rng(0).bytes(250_000)
    definition = b'uint8[] data\n'
    data = b'\x00\x01\x00\x00' + len(noise).to_bytes(4, 'little') + noise
    write_mcap(
        path,
        [(time, data) for time in range(160)],
        msgtype='my_msgs/msg/Blob',
        definition=definition,
        compression=CompressionType.NONE,
    )
    assert path.stat().st_size > 40e6
    tracemalloc.start()
    with BagReader(path) as bag:
        count = sum(len(stored.message.data) for stored in bag.messages())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 160 * 250_000
    assert peak < 12e6


# The development data


@pytest.mark.parametrize(
    'group',
    ['NoData', 'OneAttachment', 'OneMessage', 'OneMetadata', 'OneSchemalessMessage', 'TenMessages'],
)
def test_conformance_files(shared, group):
    paths = sorted((shared / 'mcap' / 'conformance' / group).glob('*.mcap'))
    assert paths
    for path in paths:
        records = json.loads(path.with_suffix('.json').read_text())['records']
        wanted = []
        for record in records:
            if record['type'] == 'Message':
                fields = dict(record['fields'])
                wanted.append((int(fields['log_time']), bytes(map(int, fields['data']))))
        wanted.sort(key=lambda message: message[0])
        with BagReader(path) as bag:
            assert [(m.log_time_ns, bytes(m.data)) for m in bag.messages()] == wanted, path.name
            assert bag.message_count() == len(wanted), path.name


def test_collected_bags_read_wholly_or_say_why_not(shared, read):
    folder = shared / 'mcap'
    with (folder / 'index.csv').open() as file:
        rows = list(csv.DictReader(file))
    errors = {
        'camera/foxglove_json_camera.mcap': "encoded as 'json'",
        'other/json_logs.mcap': "encoded as 'json'",
        'other/mouse_json_zstd.mcap': "encoded as 'json'",
        'rosbag2/tests_wrong_rmw_test__wrong_rmw_test_0.mcap': "encoded as 'wrong_format'",
        'rosbag2/cpp_only_services.mcap': 'AddTwoInts_Event',
        'rosbag2/cpp_topics_and_services.mcap': 'AddTwoInts_Event',
        'rosbag2/tests_bag_with_topics_and_service_events__'
        'bag_with_topics_and_service_events.mcap': 'BasicTypes_Event',
        'ros2_misc/truncated.mcap': 'breaks off',
        'ros1/example.bag': 'ROS 1',
        'ros1/example-lz4.bag': 'ROS 1',
        'ros1/test_bag.bag': 'ROS 1',
    }
    seen = 0
    for row in rows:
        if row['file'].endswith('.yaml') or row['file'].startswith('conformance'):
            continue
        found, error = read(folder / row['file'])
        if row['file'] in errors:
            assert errors[row['file']] in str(error), row['file']
            assert '\n' not in str(error)
        else:
            assert error is None, row['file']
            if row['messages']:
                assert len(found) == int(row['messages']), row['file']
        seen += 1
    assert seen >= 35
