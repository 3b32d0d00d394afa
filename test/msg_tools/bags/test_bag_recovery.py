"""Bags that were cut off or damaged: what is whole comes back, and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from msg_tools import BagError, BagReader, BagWriter, RosbagsMessages
from msg_tools.bags.bag_metadata import quality_of_service, recorded_quality_of_service
from msg_tools.bags.bag_recovery import recover_bag
from msg_tools.messages.cdr import serialise
from test.msg_tools.conftest import Read, limited_file_size

STRING = 'std_msgs/msg/String'
# tmp_path is the same for all examples: each takes a name of its own.
EXAMPLES = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
WRITER = """\
import sys
from msg_tools import BagWriter, RosbagsMessages
messages = RosbagsMessages()
with BagWriter(sys.argv[1]) as bag:
    bag.add_topic('text', 'std_msgs/msg/String', latched=True)
    for i in range(100_000):
        bag.write('text', i, messages.create('std_msgs/msg/String', data=f'{i} ' + 'x' * 50_000))
        print(i, flush=True)
"""


@cache
def in_file(path: Path) -> list[tuple[int, str, bytes]]:
    """Messages in the order of the file, as the `mcap` package reads them."""
    with path.open('rb') as file:
        return [
            (message.log_time, channel.topic, message.data)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


@cache
def chunks(path: Path) -> list[tuple[int, int, int]]:
    """First byte, byte behind the last, and number of messages of the chunks."""
    with path.open('rb') as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        found = []
        for index in summary.chunk_indexes:
            count = sum(
                index.message_start_time <= time <= index.message_end_time
                for time, _, _ in in_file(path)
            )
            start = index.chunk_start_offset
            found.append((start, start + index.chunk_length, count))
    return found


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory, messages: RosbagsMessages) -> Path:
    """A bag of 16 messages, in six chunks that do not overlap in time."""
    path = tmp_path_factory.mktemp('bags') / 'whole'
    rng = np.random.default_rng(4)
    with BagWriter(path) as bag:
        for i in range(16):
            text = rng.bytes(220_000).hex()
            bag.write('text', 1000 + i, messages.create(STRING, data=text))
    return path / 'whole.mcap'


def test_a_writer_that_is_killed_loses_at_most_the_last_chunk(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, '-c', WRITER, str(tmp_path / 'bag')],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).resolve().parents[3],
    ) as process:
        assert process.stdout is not None
        written = [next(process.stdout) for _ in range(90)]
        process.send_signal(signal.SIGKILL)
        written += list(process.stdout)
    assert not (tmp_path / 'bag').exists()
    found = recover_bag(tmp_path / 'bag', tmp_path / 'recovered')
    # 21 messages make a chunk.
    assert len(written) // 21 * 21 <= found.messages <= len(written) + 1
    assert found.lost_messages is None
    assert 'breaks off after' in found.losses[0]
    with BagReader(tmp_path / 'recovered') as bag:
        times = [stored.log_time_ns for stored in bag.messages()]
        assert times == list(range(found.messages))
        first = next(bag.messages()).message.data
    assert first == '0 ' + 'x' * 50_000
    document = yaml.safe_load((tmp_path / 'recovered' / 'metadata.yaml').read_text())
    information = document['rosbag2_bagfile_information']
    assert information['message_count'] == found.messages
    (topic,) = information['topics_with_message_count']
    assert topic['topic_metadata']['offered_qos_profiles'] == quality_of_service(latched=True)
    assert topic['topic_metadata']['type_description_hash'].startswith('RIHS01_')
    with AnyReader([tmp_path / 'recovered']) as reader:
        assert sum(1 for _ in reader.messages()) == found.messages


def test_chunks_are_on_the_disk_when_they_are_complete(
    tmp_path: Path, messages: RosbagsMessages
) -> None:
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / 'bag') as bag:
        for i in range(30):
            bag.write('text', i, messages.create(STRING, data=rng.bytes(100_000).hex()))
            (file,) = tmp_path.glob('.bag.*.partial/bag.mcap')
            # Six messages of 200 kB make a chunk; 100 kB each when compressed.
            assert file.stat().st_size >= (i + 1) // 6 * 600_000
        (folder,) = tmp_path.glob('.bag.*.partial')
        assert recover_bag(folder, tmp_path / 'recovered').messages == 30
        bag.abort()


@EXAMPLES
@given(share=st.floats(0, 1, exclude_max=True))
def test_cut_anywhere_gives_all_whole_chunks(
    tmp_path: Path, whole: Path, read: Read, share: float
) -> None:
    content = whole.read_bytes()
    length = int(share * len(content))
    wanted = sum(count for _, end, count in chunks(whole) if end <= length)
    broken, target = tmp_path / 'broken.mcap', tmp_path / f'{length}'
    broken.write_bytes(content[:length])
    if target.exists():
        return
    if not wanted:
        with pytest.raises(BagError, match=r'nothing to be saved|no message that could be saved'):
            recover_bag(broken, target)
        assert not target.exists()
    else:
        found = recover_bag(broken, target)
        assert found.messages == wanted
        assert found.losses
        assert read(target) == (in_file(whole)[:wanted], None)
    assert broken.read_bytes() == content[:length]


@EXAMPLES
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7), data=st.data())
def test_a_flipped_bit_loses_one_chunk_at_most(
    tmp_path: Path, whole: Path, share: float, bit: int, data: st.DataObject
) -> None:
    content = bytearray(whole.read_bytes())
    spans = chunks(whole)
    if data.draw(st.booleans()):
        # The beginning of a chunk, which says how long it is.
        offset = data.draw(st.sampled_from(spans))[0] + int(share * 60)
    else:
        offset = int(share * len(content))
    content[offset] ^= 1 << bit
    broken = tmp_path / 'broken.mcap'
    broken.write_bytes(content)
    target = tmp_path / f'{offset}.{bit}'
    if target.exists():
        return
    found = recover_bag(broken, target)
    hit = [i for i, (start, end, _) in enumerate(spans) if start <= offset < end]
    everything = in_file(whole)
    counts = [0, *np.cumsum([count for *_, count in spans]).tolist()]
    wanted = [
        message
        for i, _ in enumerate(spans)
        if i not in hit
        for message in everything[counts[i] : counts[i + 1]]
    ]
    saved = in_file(target / f'{target.name}.mcap')
    if not hit:
        assert saved == everything
    else:
        # Flipped times of a chunk harm nothing; its checksum is of the messages.
        assert saved in (wanted, everything)
    if saved != everything:
        assert found.losses
        assert found.lost_messages in (len(everything) - len(saved), None)


@EXAMPLES
@given(data=st.data())
def test_garbage_never_crashes(tmp_path: Path, whole: Path, data: st.DataObject) -> None:
    content = bytearray(whole.read_bytes()[:400_000])
    for _ in range(data.draw(st.integers(1, 5))):
        offset = data.draw(st.integers(0, len(content) - 1))
        garbage = data.draw(st.binary(min_size=1, max_size=40))
        content[offset : offset + len(garbage)] = garbage
    broken, target = tmp_path / 'broken.mcap', tmp_path / 'garbage'
    broken.write_bytes(content)
    with suppress(BagError):
        found = recover_bag(broken, target)
    if target.exists():
        with BagReader(target) as bag:
            assert len(list(bag.messages())) == found.messages
        for path in target.iterdir():
            path.unlink()
        target.rmdir()


def write_bare(path: Path, messages: RosbagsMessages, **options: Any) -> None:
    """Twenty messages in a file with all that may stand in one."""
    with path.open('wb') as file:
        writer = Writer(file, **options)
        writer.start(profile='other', library='test')
        schema = writer.register_schema(STRING, 'ros2msg', b'string data')
        offered = yaml.safe_dump([{'history': 3, 'depth': 7, 'reliability': 2, 'durability': 1}])
        metadata = {'offered_qos_profiles': offered, 'topic_type_hash': 'RIHS01_ab'}
        channel = writer.register_channel('/text', 'cdr', schema, metadata)
        writer.add_metadata('place', {'city': 'Pisa'})
        writer.add_attachment(5, 6, 'map.png', 'image/png', b'picture')
        for i in range(20):
            text = serialise(messages.create(STRING, data=f'text {i}'))
            writer.add_message(channel, 100 + i, text, 90 + i, i)
        writer.finish()


def test_all_that_a_file_holds_is_kept(tmp_path: Path, messages: RosbagsMessages) -> None:
    write_bare(tmp_path / 'all.mcap', messages, chunk_size=200)
    found = recover_bag(tmp_path / 'all.mcap', tmp_path / 'out')
    assert (found.messages, found.topics, found.lost_messages, found.losses) == (20, 1, 0, ())
    with (tmp_path / 'out' / 'out.mcap').open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == 'other'
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.data) == ('map.png', b'picture')
        assert (attachment.create_time, attachment.log_time) == (5, 6)
        kept = {record.name: record.metadata for record in reader.iter_metadata()}
        assert kept['place'] == {'city': 'Pisa'}
        assert set(kept) == {'place', 'rosbag2'}
        schema, channel, message = list(reader.iter_messages())[7]
        assert schema is not None
        assert (schema.name, schema.data) == (STRING, b'string data')
        assert channel.metadata['topic_type_hash'] == 'RIHS01_ab'
        assert (message.sequence, message.log_time, message.publish_time) == (7, 107, 97)
        (profile,) = yaml.safe_load(channel.metadata['offered_qos_profiles'])
    assert profile['history'] == 'unknown'
    assert profile['reliability'] == 'best_effort'
    assert profile['durability'] == 'transient_local'
    assert profile['depth'] == 7


def test_topics_of_ros_get_absolute_names(tmp_path: Path, messages: RosbagsMessages) -> None:
    with (tmp_path / 'old.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(STRING, 'ros2msg', b'string data')
        text = serialise(messages.create(STRING, data='text'))
        for topic, encoding in (('note', 'cdr'), ('/note', 'cdr'), ('sensor.log', 'json')):
            writer.add_message(writer.register_channel(topic, encoding, schema), 1, text, 1)
        writer.finish()
    counts: list[int | None] = []
    recover_bag(tmp_path / 'old.mcap', tmp_path / 'out', counts.append)
    assert counts == [3, 3, 3]
    with BagReader(tmp_path / 'out') as bag:
        found = {name: topic.message_count for name, topic in bag.topics.items()}
    assert found == {'/note': 2, 'sensor.log': 1}


@pytest.mark.parametrize('text', ['', 'a: [', '5', '[5]', '- [a]'])
def test_quality_of_service_that_nobody_understands(text: str) -> None:
    assert recorded_quality_of_service(text) == []


def test_whole_messages_outside_of_chunks(tmp_path: Path, messages: RosbagsMessages) -> None:
    write_bare(tmp_path / 'bare.mcap', messages, use_chunking=False)
    content = (tmp_path / 'bare.mcap').read_bytes()
    counts = []
    for length in range(200, len(content), 97):
        (tmp_path / 'cut.mcap').write_bytes(content[:length])
        ends = [i for i in range(20) if 0 <= content.find(b'text %d\x00' % i) <= length - 8]
        wanted = sum(content.find(b'text %d\x00' % i) + 6 + len(str(i)) <= length for i in ends)
        if wanted:
            found = recover_bag(tmp_path / 'cut.mcap', tmp_path / str(length))
            assert found.messages == wanted
            counts.append(wanted)
    assert counts[0] < 5
    assert counts[-1] == 20


@pytest.mark.parametrize('compression', list(CompressionType))
def test_the_chunk_with_the_definitions_is_damaged(
    tmp_path: Path, messages: RosbagsMessages, compression: CompressionType
) -> None:
    write_bare(tmp_path / 'all.mcap', messages, chunk_size=200, compression=compression)
    content = bytearray((tmp_path / 'all.mcap').read_bytes())
    start, end, count = chunks(tmp_path / 'all.mcap')[0]
    content[end - 1] ^= 1
    (tmp_path / 'all.mcap').write_bytes(content)
    found = recover_bag(tmp_path / 'all.mcap', tmp_path / 'out')
    assert found.messages == 20 - count
    assert found.lost_messages == count
    (line,) = found.losses
    assert f'all.mcap is damaged in the chunk at byte {start}' in line
    # Without a summary nobody knows what the messages are.
    (tmp_path / 'all.mcap').write_bytes(content[:-10])
    with pytest.raises(BagError, match=r'has no message that could be saved: all\.mcap is damaged'):
        recover_bag(tmp_path / 'all.mcap', tmp_path / 'nothing')


def test_split_and_compressed_files(tmp_path: Path, messages: RosbagsMessages, whole: Path) -> None:
    folder = tmp_path / 'split'
    folder.mkdir()
    for part in (0, 2):
        write_bare(folder / 'plain', messages, chunk_size=200)
        packed = zstandard.compress((folder / 'plain').read_bytes())
        (folder / f'split_{part}.mcap.zstd').write_bytes(packed)
    packed = zstandard.compress(whole.read_bytes())
    (folder / 'split_10.mcap.zstd').write_bytes(packed[: len(packed) // 2])
    (folder / 'split_11.mcap').write_bytes(b'')
    found = recover_bag(folder, tmp_path / 'out')
    assert 40 + 5 < found.messages < 40 + 20
    assert found.losses[0] == 'split_11.mcap has 0 bytes: there is nothing to be saved'
    assert found.losses[1].startswith('split_10.mcap.zstd breaks off')
    (folder / 'split_11.mcap').unlink()
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {relative_file_paths: [split_0.mcap.zstd, split_1.mcap]}'
    )
    found = recover_bag(folder, tmp_path / 'again')
    assert found.losses[0] == 'split_1.mcap, which metadata.yaml names, is missing'
    assert found.lost_messages is None
    assert list(folder.parent.glob('.*')) == []


def test_what_can_not_be_recovered(tmp_path: Path, messages: RosbagsMessages) -> None:
    target = tmp_path / 'out'
    with pytest.raises(BagError, match='nowhere is not there'):
        recover_bag(tmp_path / 'nowhere', target)
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match=r'empty has no \.mcap file'):
        recover_bag(tmp_path / 'empty', target)
    (tmp_path / 'empty' / 'a.db3').write_bytes(b'')
    with pytest.raises(BagError, match=r'a\.db3 is a database'):
        recover_bag(tmp_path / 'empty', target)
    (tmp_path / 'text').write_text('Hello, this is no bag')
    with pytest.raises(BagError, match='text is not a bag'):
        recover_bag(tmp_path / 'text', target)
    for name in ('.twice.0123456a.partial', '.twice.0123456b.partial'):
        (tmp_path / name).mkdir()
    with pytest.raises(BagError, match='twice was begun several times: name one of'):
        recover_bag(tmp_path / 'twice', target)
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(BagError, match='neither a file nor a folder'):
        recover_bag(tmp_path / 'pipe', target)
    assert not target.exists()


def test_nothing_is_overwritten(tmp_path: Path, whole: Path) -> None:
    for target in (tmp_path / 'file', tmp_path / 'folder'):
        target.write_text('mine') if target.name == 'file' else target.mkdir()
        with pytest.raises(BagError, match='exists, and nothing is overwritten'):
            recover_bag(whole, target)
    assert (tmp_path / 'file').read_text() == 'mine'
    assert list((tmp_path / 'folder').iterdir()) == []


def test_full_disk(tmp_path: Path, whole: Path) -> None:
    with (
        pytest.raises(BagError, match=r'out can not be written: File too large'),
        limited_file_size(1_500_000),
    ):
        recover_bag(whole, tmp_path / 'out')
    assert list(tmp_path.iterdir()) == []


def test_collected_bags_come_back_as_they_are(shared: Path, tmp_path: Path, read: Read) -> None:
    folder = shared / 'mcap' / 'ros2_misc'
    for number, path in enumerate(sorted(folder.glob('*.mcap*'))):
        messages, _ = read(path)
        if messages:
            recover_bag(path, tmp_path / str(number))
            saved, _ = read(tmp_path / str(number))
            assert [m for m in saved if m in messages] == saved, path.name
            assert len(saved) >= (0 if 'truncated' in path.name else len(messages)), path.name
