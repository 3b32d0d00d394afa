"""The `ros2 bag` commands in the documentation, by the rule by which rosbag2 finds topics.

There is no wheel of rosbag2. Its player expands the names that it is given, as every node does,
and compares them with the names in the bag; overrides of the quality of service and the recorder
compare them as they are.
"""

import re
import shlex
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader

from hmt_ros.sessions import smoothed_messages, track_messages
from msg_tools.bags.bag_metadata import absolute_name

ROOT = Path(__file__).parent.parent
PAGES = ('README.md', 'docs/bags.md', 'docs/views.md')
# The topics in a bag of `replay`; a test of the command compares them.
REPLAYED = {absolute_name(x) for x in (*track_messages.TOPICS, *smoothed_messages.TOPICS)}


def lines(verb):
    """Words after `ros2 bag <verb>` in the commands of the documentation."""
    text = '\n'.join((ROOT / page).read_text('utf-8') for page in PAGES)
    found = re.findall(rf'(?:^|`)ros2 bag {verb} ([^`\n]*)', text, re.MULTILINE)
    return [shlex.split(line) for line in found]


def arguments(words, option):
    """The words after an option, up to the next option."""
    rest = words[words.index(option) + 1 :] if option in words else []
    end = next((i for i, word in enumerate(rest) if word.startswith('-')), len(rest))
    return rest[:end]


def recorded(bag):
    """Names of a bag's topics, which must be the same in its metadata and in its file."""
    if bag == 'tracked':
        return REPLAYED
    folder = ROOT / bag
    content = yaml.safe_load((folder / 'metadata.yaml').read_text('utf-8'))
    topics = content['rosbag2_bagfile_information']['topics_with_message_count']
    names = {one['topic_metadata']['name'] for one in topics}
    with next(folder.glob('*.mcap')).open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert names == {channel.topic for channel in summary.channels.values()}
    return names


def expanded(name):
    """A name as rclcpp expands it for the player, whose node is in the root."""
    return name if name.startswith('/') else f'/{name}'


@pytest.mark.parametrize('words', lines('play'), ids=' '.join)
def test_played_topics_are_in_the_bag(words):
    there = recorded(words[0])
    for option in ('--topics', '--exclude-topics'):
        for name in arguments(words, option):
            assert expanded(name) in there
    for rule in arguments(words, '--remap'):
        old, _, new = rule.partition(':=')
        assert {old, new} & there == {old}


def test_lines_for_playing_and_recording_are_there():
    played, stored = lines('play'), lines('record')
    for option in ('--topics', '--exclude-topics', '--remap'):
        assert any(option in words for words in played)
    names = [name for words in stored for name in arguments(words, '--topics')]
    assert names
    assert all(name.startswith('/') for name in names)
    (pattern,) = (rule for words in stored for rule in arguments(words, '--regex'))
    # The recorder matches parts of the name, the player the whole name.
    for topic in track_messages.TOPICS.keys() - {'/tf'}:
        assert re.fullmatch(pattern, f'/humans/bodies/p1/{topic}')
    assert not re.search(pattern, '/camera/image_raw')
