"""Writing bags: readable by other tools, reproducible, and complete or not at all."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from msg_tools import BagError, BagReader, BagWriter
from msg_tools.bags import bag_writer
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import typestore
from test.msg_tools.conftest import limited_file_size

STRING = 'std_msgs/msg/String'


def write_bag(path, messages, count=20, **options):
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


def test_same_calls_write_the_same_bytes(tmp_path, messages):
    for folder in ('a', 'b'):
        write_bag(tmp_path / folder / 'bag', messages)
    for name in ('bag.mcap', 'metadata.yaml'):
        first = (tmp_path / 'a' / 'bag' / name).read_bytes()
        assert first == (tmp_path / 'b' / 'bag' / name).read_bytes()
    assert sorted(path.name for path in (tmp_path / 'a').iterdir()) == ['bag']


def test_topics_have_absolute_names(tmp_path, messages):
    """rosbag2 makes names given by a user absolute, and compares them with these."""
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


def test_metadata_is_that_of_rosbag2(tmp_path, messages):
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


def test_rosbags_reads_it(tmp_path, messages):
    write_bag(tmp_path / 'bag', messages)
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 41
        by_topic = {connection.topic: connection for connection in reader.connections}
        (offered,) = by_topic['/body'].ext.offered_qos_profiles
        assert offered.durability == QosDurability.TRANSIENT_LOCAL
        assert offered.reliability == QosReliability.RELIABLE
        assert [time for _, time, _ in reader.messages([by_topic['/text']])] == [
            10**18 + i * 33_333_333 for i in range(20)
        ]
    # With only the definitions in the bag.
    with AnyReader([tmp_path / 'bag']) as reader:
        connections = [
            connection for connection in reader.connections if connection.topic == '/body'
        ]
        ((connection, _, data),) = reader.messages(connections)
        assert reader.deserialize(data, connection.msgtype).name == 'human37'


def test_every_type_of_the_project_has_its_definition_in_the_bag(tmp_path, messages):
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


def test_a_bag_without_messages(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/text', STRING)
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.topics['/text'].message_count == 0
        assert list(reader.messages()) == []
    with Reader(tmp_path / 'bag') as other:
        assert other.message_count == 0


# Whole or not at all


def test_an_error_leaves_nothing(tmp_path, messages):
    def fail():
        with BagWriter(tmp_path / 'bag') as bag:
            bag.write('/text', 1, messages.create(STRING, data='text'))
            assert not (tmp_path / 'bag').exists()
            assert len(list(tmp_path.iterdir())) == 1
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_close_and_abort_are_final(tmp_path, messages):
    bag = BagWriter(tmp_path / 'bag')
    bag.write('/text', 1, messages.create(STRING, data='text'))
    bag.close()
    bag.close()
    bag.abort()
    with pytest.raises(BagError, match='is closed'):
        bag.write('/text', 2, messages.create(STRING, data='text'))
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 1


def test_overwrite_replaces_at_the_end(tmp_path, messages):
    write_bag(tmp_path / 'bag', messages, count=1)
    with BagWriter(tmp_path / 'bag', overwrite=True) as bag:
        bag.write('/text', 1, messages.create(STRING, data='new'))
        with BagReader(tmp_path / 'bag') as reader:
            assert reader.message_count() == 3
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 1
    assert [path.name for path in tmp_path.iterdir()] == ['bag']

    def fail():
        with BagWriter(tmp_path / 'bag', overwrite=True) as bag:
            raise RuntimeError(bag.path.name)

    with pytest.raises(RuntimeError, match='bag'):
        fail()
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.message_count() == 1


def test_overwrite_never_touches_anything_but_a_bag(tmp_path, messages):
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
def test_full_disk(tmp_path, messages, limit):
    with (
        pytest.raises(BagError, match=r'bag can not be written: File too large'),
        limited_file_size(limit),
    ):
        write_bag(tmp_path / 'bag', messages)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('step', ['fsync', 'rename'])
def test_failure_while_closing(tmp_path, messages, monkeypatch, step):
    write_bag(tmp_path / 'bag', messages, count=1)

    def refuse(*arguments):
        raise OSError(28, 'No space left on device')

    def refuse_the_new_folder(path, target, rename):
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


# Wrong calls


def test_wrong_calls(tmp_path, messages):
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
