"""Writing bags: what other tools read, the same bytes every time, whole or not at all."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, Message, MessageIndex
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from msg_tools import BagError, BagReader, BagWriter, RosbagsMessages
from msg_tools.bags import bag_writer
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import typestore
from test.msg_tools.conftest import limited_file_size

STRING = 'std_msgs/msg/String'


def write_bag(path: Path, messages: RosbagsMessages, count: int = 20, **options: Any) -> None:
    rng = np.random.default_rng(1)
    with BagWriter(path, **options) as bag:
        bag.add_topic('/body', 'hmt_msgs/msg/Body', latched=True)
        bag.write('/body', 10**18, messages.create('hmt_msgs/msg/Body', name='human37'))
        for i in range(count):
            stamp = 10**18 + i * 33_333_333
            bag.write('/text', stamp, messages.create(STRING, data=f'text {i}'))
            image = messages.create(
                'sensor_msgs/msg/CompressedImage',
                header=header_message(messages, stamp, 'camera'),
                format='jpeg',
                data=rng.integers(0, 256, 120_000, dtype=np.uint8),
            )
            bag.write('/image/compressed', stamp, image)


def test_same_calls_write_the_same_bytes(tmp_path: Path, messages: RosbagsMessages) -> None:
    for folder in ('a', 'b'):
        write_bag(tmp_path / folder / 'bag', messages)
    for name in ('bag.mcap', 'metadata.yaml'):
        first = (tmp_path / 'a' / 'bag' / name).read_bytes()
        assert first == (tmp_path / 'b' / 'bag' / name).read_bytes()
    assert sorted(path.name for path in (tmp_path / 'a').iterdir()) == ['bag']


def test_topics_have_absolute_names(tmp_path: Path, messages: RosbagsMessages) -> None:
    """rosbag2 makes the names that a user gives absolute, and compares them with these."""
    text = messages.create(STRING, data='')
    with BagWriter(tmp_path / 'bag', namespace='/humans/bodies/p1') as bag:
        bag.add_topic('body', STRING, latched=True)
        for topic in ('body', '/humans/bodies/p1/body', 'image/compressed', '/tf'):
            bag.write(topic, 1, text)
        with pytest.raises(BagError, match='topic /humans/bodies/p1/body is there already'):
            bag.add_topic('/humans/bodies/p1/body', STRING)
    with (tmp_path / 'bag' / 'bag.mcap').open('rb') as file:
        written = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    wanted = {'/humans/bodies/p1/body': 2, '/humans/bodies/p1/image/compressed': 1, '/tf': 1}
    assert written == wanted
    content = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    topics = content['rosbag2_bagfile_information']['topics_with_message_count']
    assert {one['topic_metadata']['name']: one['message_count'] for one in topics} == wanted


def test_metadata_is_that_of_rosbag2(tmp_path: Path, messages: RosbagsMessages) -> None:
    write_bag(tmp_path / 'bag', messages)
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    assert '&' not in text
    information = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert information['version'] == 9
    assert information['storage_identifier'] == 'mcap'
    assert information['relative_file_paths'] == ['bag.mcap']
    assert information['message_count'] == 41
    assert information['starting_time'] == {'nanoseconds_since_epoch': 10**18}
    assert information['duration'] == {'nanoseconds': 19 * 33_333_333}
    assert information['files'] == [
        {
            'path': 'bag.mcap',
            'duration': {'nanoseconds': 19 * 33_333_333},
            'starting_time': {'nanoseconds_since_epoch': 10**18},
            'message_count': 41,
        }
    ]
    body, text_topic, _ = information['topics_with_message_count']
    assert body['message_count'] == 1
    assert body['topic_metadata']['type_description_hash'] == typestore().hash_rihs01(
        'hmt_msgs/msg/Body'
    )
    (offered,) = body['topic_metadata']['offered_qos_profiles']
    assert offered['durability'] == 'transient_local'
    assert offered['reliability'] == 'reliable'
    assert offered['deadline'] == {'sec': 9223372036, 'nsec': 854775807}
    (offered,) = text_topic['topic_metadata']['offered_qos_profiles']
    assert offered['durability'] == 'volatile'


def test_rosbags_reads_it(tmp_path: Path, messages: RosbagsMessages) -> None:
    write_bag(tmp_path / 'bag', messages)
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 41
        by_topic = {connection.topic: connection for connection in reader.connections}
        (offered,) = by_topic['/body'].ext.offered_qos_profiles  # type: ignore[union-attr]
        assert offered.durability == QosDurability.TRANSIENT_LOCAL
        assert offered.reliability == QosReliability.RELIABLE
        assert [time for _, time, _ in reader.messages([by_topic['/text']])] == [
            10**18 + i * 33_333_333 for i in range(20)
        ]
    # With the definitions of the bag alone.
    with AnyReader([tmp_path / 'bag']) as reader:
        connections = [
            connection for connection in reader.connections if connection.topic == '/body'
        ]
        ((connection, _, data),) = reader.messages(connections)
        assert reader.deserialize(data, connection.msgtype).name == 'human37'


def test_mcap_reads_it_with_all_checksums(tmp_path: Path, messages: RosbagsMessages) -> None:
    write_bag(tmp_path / 'bag', messages)
    path = tmp_path / 'bag' / 'bag.mcap'
    with path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        found = list(reader.iter_messages(topics=['/text']))
        summary = reader.get_summary()
        (metadata,) = reader.iter_metadata()
    assert len(found) == 20
    schema, channel, message = found[3]
    assert schema is not None
    assert (schema.name, schema.encoding) == (STRING, 'ros2msg')
    assert channel.message_encoding == 'cdr'
    assert channel.metadata['topic_type_hash'].startswith('RIHS01_')
    assert yaml.safe_load(channel.metadata['offered_qos_profiles'])[0]['depth'] == 10
    assert message.log_time == message.publish_time == 10**18 + 3 * 33_333_333
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 41
    assert len(summary.chunk_indexes) >= 2
    assert {index.compression for index in summary.chunk_indexes} == {'zstd'}
    assert metadata.name == 'rosbag2'
    assert yaml.safe_load(metadata.metadata['serialized_metadata'])['message_count'] == 41
    with path.open('rb') as file:
        # This one also compares the checksum of the data section.
        assert sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages()) == 41


def test_every_index_leads_where_it_says(tmp_path: Path, messages: RosbagsMessages) -> None:
    """What `mcap doctor` looks at: lengths, offsets, times and counts, record by record."""
    write_bag(tmp_path / 'bag', messages)
    path = tmp_path / 'bag' / 'bag.mcap'
    content = path.read_bytes()
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    ends = []
    counts: Counter[int] = Counter()
    for index in summary.chunk_indexes:
        start = index.chunk_start_offset
        assert content[start] == Opcode.CHUNK
        stream = ReadDataStream(BytesIO(content[start + 9 : start + index.chunk_length]))
        chunk = Chunk.read(stream)
        assert chunk.message_start_time == index.message_start_time
        assert chunk.message_end_time == index.message_end_time
        assert chunk.uncompressed_size == index.uncompressed_size
        assert len(chunk.data) == index.compressed_size
        plain = zstandard.decompress(chunk.data)
        times = []
        for channel, offset in index.message_index_offsets.items():
            assert content[offset] == Opcode.MESSAGE_INDEX
            found = MessageIndex.read(ReadDataStream(BytesIO(content[offset + 9 :])))
            assert found.channel_id == channel
            for time, place in found.records:
                assert plain[place] == Opcode.MESSAGE
                message = Message.read(ReadDataStream(BytesIO(plain[place + 9 :])), 0)
                assert (message.channel_id, message.log_time) == (channel, time)
                times.append(time)
                counts[channel] += 1
        assert (min(times), max(times)) == (index.message_start_time, index.message_end_time)
        first = start + index.chunk_length
        assert min(index.message_index_offsets.values()) == first
        ends.append(first + index.message_index_length)
    # One chunk follows the other: no message lies outside of the index.
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    assert starts[1:-1] == ends[:-2]
    assert counts == summary.statistics.channel_message_counts
    assert len(summary.schemas) == summary.statistics.schema_count == 3
    assert {channel.schema_id for channel in summary.channels.values()} == set(summary.schemas)


def test_mcap_ros2_support_reads_it(tmp_path: Path, messages: RosbagsMessages) -> None:
    """Every type that the project writes, with the definitions of the bag alone."""
    decoder = pytest.importorskip(
        'mcap_ros2.decoder', reason='mcap-ros2-support is not installed (pip install ...)'
    )
    write_bag(tmp_path / 'bag', messages)
    with (tmp_path / 'bag' / 'bag.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        found = [
            (channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()
        ]
    assert len(found) == 41
    assert found[0][1].name == 'human37'
    assert [message.data for topic, message in found if topic == '/text'][3] == 'text 3'
    mixture = messages.create(
        'hmt_msgs/msg/PoseMixture',
        dof_names=['a', 'b'],
        components=[
            messages.create(
                'hmt_msgs/msg/PoseComponent',
                weight=0.5,
                mean=np.array([1.5, -2.0]),
                covariance=np.eye(2).reshape(-1),
                joint_positions=messages.points(np.arange(6.0).reshape(2, 3)),
            )
        ],
    )
    types = sorted(name for name in typestore().fielddefs if name.startswith('hmt_msgs/'))
    with BagWriter(tmp_path / 'types') as bag:
        bag.write('mixture', 1, mixture)
        for msgtype in types:
            bag.write(msgtype, 2, messages.create(msgtype))
    with (tmp_path / 'types' / 'types.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        first, *others = (message for *_, message in reader.iter_decoded_messages())
    assert list(first.components[0].mean) == [1.5, -2.0]
    assert [point.y for point in first.components[0].joint_positions] == [1.0, 4.0]
    assert len(others) == len(types)


def test_every_type_of_the_project_has_its_definition_in_the_bag(
    tmp_path: Path, messages: RosbagsMessages
) -> None:
    types = sorted(name for name in typestore().fielddefs if name.startswith('hmt_msgs/'))
    assert len(types) == 11
    with BagWriter(tmp_path / 'bag') as bag:
        for msgtype in types:
            bag.write(f'/{msgtype}', 1, messages.create(msgtype))
    with AnyReader([tmp_path / 'bag']) as reader:
        for connection, _, data in reader.messages():
            assert reader.deserialize(data, connection.msgtype) is not None
            known = typestore().fielddefs[connection.msgtype][1]
            assert [name for name, _ in reader.typestore.fielddefs[connection.msgtype][1]] == [
                name for name, _ in known
            ]


def test_a_bag_without_messages(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/text', STRING)
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.topics['/text'].message_count == 0
        assert list(reader.messages()) == []
    with Reader(tmp_path / 'bag') as other:
        assert other.message_count == 0


# Whole or not at all


def test_an_error_leaves_nothing(tmp_path: Path, messages: RosbagsMessages) -> None:
    def fail() -> None:
        with BagWriter(tmp_path / 'bag') as bag:
            bag.write('/text', 1, messages.create(STRING, data='text'))
            assert not (tmp_path / 'bag').exists()
            assert len(list(tmp_path.iterdir())) == 1
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_close_and_abort_are_final(tmp_path: Path, messages: RosbagsMessages) -> None:
    bag = BagWriter(tmp_path / 'bag')
    bag.write('/text', 1, messages.create(STRING, data='text'))
    bag.close()
    bag.close()
    bag.abort()
    with pytest.raises(BagError, match='is closed'):
        bag.write('/text', 2, messages.create(STRING, data='text'))
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 1


def test_what_is_there_is_not_overwritten_unasked(
    tmp_path: Path, messages: RosbagsMessages
) -> None:
    write_bag(tmp_path / 'bag', messages, count=1)
    before = (tmp_path / 'bag' / 'bag.mcap').read_bytes()
    with pytest.raises(BagError, match=r'bag exists; give another name, or --overwrite'):
        BagWriter(tmp_path / 'bag')
    assert (tmp_path / 'bag' / 'bag.mcap').read_bytes() == before


def test_overwrite_replaces_at_the_end(tmp_path: Path, messages: RosbagsMessages) -> None:
    write_bag(tmp_path / 'bag', messages, count=1)
    with BagWriter(tmp_path / 'bag', overwrite=True) as bag:
        bag.write('/text', 1, messages.create(STRING, data='new'))
        with BagReader(tmp_path / 'bag') as reader:
            assert reader.message_count() == 3
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 1
    assert [path.name for path in tmp_path.iterdir()] == ['bag']

    def fail() -> None:
        with BagWriter(tmp_path / 'bag', overwrite=True) as bag:
            raise RuntimeError(bag.path.name)

    with pytest.raises(RuntimeError, match='bag'):
        fail()
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 1


def test_overwrite_never_touches_anything_but_a_bag(
    tmp_path: Path, messages: RosbagsMessages
) -> None:
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'folder' / 'thesis.tex').write_text('years of work')
    with pytest.raises(BagError, match=r'is not replaced: it has thesis\.tex'):
        BagWriter(tmp_path / 'folder', overwrite=True)
    write_bag(tmp_path / 'bag', messages, count=1)
    (tmp_path / 'bag' / 'notes.txt').write_text('mine')
    with pytest.raises(BagError, match=r'is not replaced: it has notes\.txt'):
        BagWriter(tmp_path / 'bag', overwrite=True)
    (tmp_path / 'file').write_text('mine')
    with pytest.raises(BagError, match='it is not the folder of a bag'):
        BagWriter(tmp_path / 'file', overwrite=True)
    (tmp_path / 'link').symlink_to(tmp_path / 'bag')
    with pytest.raises(BagError, match='is not replaced'):
        BagWriter(tmp_path / 'link', overwrite=True)
    with BagWriter(tmp_path / 'new') as bag:
        (tmp_path / 'new').mkdir()
        (tmp_path / 'new' / 'meanwhile.txt').write_text('mine')
        with pytest.raises(BagError, match='new exists'):
            bag.close()
    assert (tmp_path / 'new' / 'meanwhile.txt').read_text() == 'mine'
    assert not list(tmp_path.glob('.*'))


@pytest.mark.parametrize('limit', [1_000, 1_500_000])
def test_full_disk(tmp_path: Path, messages: RosbagsMessages, limit: int) -> None:
    with (
        pytest.raises(BagError, match=r'bag can not be written: File too large'),
        limited_file_size(limit),
    ):
        write_bag(tmp_path / 'bag', messages)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('step', ['fsync', 'rename'])
def test_failure_while_closing(
    tmp_path: Path, messages: RosbagsMessages, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    write_bag(tmp_path / 'bag', messages, count=1)

    def refuse(*arguments: object) -> None:
        raise OSError(28, 'No space left on device')

    def refuse_the_new_folder(path: Path, target: Path, rename: Callable[..., Any]) -> Any:
        refused = path.parent.suffix == '.partial' and path.name == 'bag'
        return refuse() if refused else rename(path, target)

    if step == 'fsync':
        monkeypatch.setattr(bag_writer.os, 'fsync', refuse)
    else:
        rename = Path.rename
        monkeypatch.setattr(Path, 'rename', lambda a, b: refuse_the_new_folder(a, b, rename))
    with pytest.raises(BagError, match='can not be written: No space left on device'):
        write_bag(tmp_path / 'bag', messages, count=5, overwrite=True)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ['bag']
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 3


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(BagError, match='can not be written: Permission denied'):
            BagWriter(tmp_path / 'bag')
    finally:
        tmp_path.chmod(0o755)


def test_place_that_can_not_be(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match=r'can not be written: (Not a directory|File exists)'):
        BagWriter(tmp_path / 'file' / 'bag')
    with pytest.raises(BagError, match='is not the name of a folder'):
        BagWriter('/')


# Wrong calls


def test_wrong_calls(tmp_path: Path, messages: RosbagsMessages) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/text', 1, messages.create(STRING, data='text'))
        with pytest.raises(BagError, match='/text is there already'):
            bag.add_topic('/text', STRING)
        with pytest.raises(BagError, match="unknown type 'no_msgs/msg/No'"):
            bag.add_topic('/no', 'no_msgs/msg/No')
        with pytest.raises(
            BagError, match='topic /text has type std_msgs/msg/String, not std_msgs/'
        ):
            bag.write('/text', 1, messages.create('std_msgs/msg/Int32', data=1))
        with pytest.raises(BagError, match='message of /text does not fit std_msgs/msg/String'):
            bag.write('/text', 1, messages.create(STRING, data=5))
        with pytest.raises(BagError, match='stamp -1 ns of a message of /text is not a time'):
            bag.write('/text', -1, messages.create(STRING, data='text'))
        with pytest.raises(BagError, match='topic /other has not been added'):
            bag.write_serialised('/other', 1, b'')
        bag.write('/text', 2, messages.create(STRING, data='text'))
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 2
