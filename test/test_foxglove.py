"""The layouts for Lichtblick and Foxglove: every panel shows a topic and fields that exist.

A panel that names another topic stays empty without an error.
"""

import json
import re
from pathlib import Path
from typing import Any

from hmt_ros.app.replay.command import main
from hmt_ros.sessions import bme_session, smoothed_messages, track_messages
from hmt_ros.sessions.people_session import PeopleSession
from msg_tools import BagReader
from msg_tools.messages.message_types import typestore
from test.app.replay.test_command import PERSON, recorded, still, write

__all__ = ['still']

ROOT = Path(__file__).parent.parent
LIVE, OF_BAGS, OF_PEOPLE = 'hmt.json', 'hmt_bag.json', 'people.json'
PERSON_1 = '/humans/bodies/p1'
# Types of the messages that panels show, by the name of the panel.
SHOWN = {
    'Image': 'sensor_msgs/msg/CompressedImage',
    'DiagnosticSummary': 'diagnostic_msgs/msg/DiagnosticArray',
    'RosOut': 'rcl_interfaces/msg/Log',
}
NODE_TOPICS = {
    **track_messages.TOPICS,
    **smoothed_messages.TOPICS,
    **bme_session.TOPICS,
}


def read(name):
    layout: dict[str, Any] = json.loads((ROOT / 'foxglove' / name).read_text('utf-8'))
    return layout


def panels(layout):
    """The panels in the tree of a layout."""
    if isinstance(layout, str):
        return {layout}
    assert layout['direction'] in ('row', 'column')
    return panels(layout['first']) | panels(layout['second'])


def topics_of(name, settings):
    """Topics of a panel, each with the type it requires and the fields it plots."""
    kind = name.partition('!')[0]
    if kind == '3D':
        found = dict.fromkeys(settings['topics'], 'visualization_msgs/msg/MarkerArray')
        urdfs = (x for x in settings['layers'].values() if x['layerId'] == 'foxglove.Urdf')
        return found | {layer['topic']: 'std_msgs/msg/String' for layer in urdfs}
    if kind == 'Image':
        return {settings['imageMode']['imageTopic']: SHOWN[kind]}
    if kind == 'Plot':
        paths = (path['value'].partition('.') for path in settings['paths'])
        return {topic: field for topic, _, field in paths}
    if kind == 'DiagnosticSummary':
        return {settings['topicToRender']: SHOWN[kind]}
    assert kind == 'RosOut', f'{name}: a panel whose topic this test does not know'
    return {'/rosout': SHOWN[kind]}


def check_field(msgtype, path):
    """Asserts that a type has the field that a plot shows."""
    definitions = typestore().fielddefs
    for part in re.sub(r'\[-?\d+\]', '', path).split('.'):
        fields = dict(definitions[msgtype][1])
        assert part in fields, f'{msgtype} has no field {part}'
        described = str(fields[part])
        inner = re.search(r'[a-z_]+/msg/\w+', described)
        msgtype = inner.group() if inner else ''


def check_layout(name, there, frames):
    """Asserts that no panel of a layout stays empty.

    Args:
        name: name of the layout.
        there: type of each topic that has messages.
        frames: coordinate frames that exist.
    """
    layout = read(name)
    assert panels(layout['layout']) == layout['configById'].keys()
    for panel, settings in layout['configById'].items():
        wanted = topics_of(panel, settings)
        assert wanted, panel
        for topic, kind in wanted.items():
            assert topic in there, f'{name}: {panel} shows {topic}, which is not there'
            if panel.startswith('Plot!'):
                check_field(there[topic], kind)
            else:
                assert there[topic] == kind, f'{name}: {panel} can not show {topic}'
        if 'followTf' in settings:
            assert {settings['followTf'], settings['layers']['grid']['frameId']} <= frames


def test_live_layout_shows_topics_of_the_nodes():
    there = {
        topic if topic.startswith('/') else f'{PERSON_1}/{topic}': published.msgtype
        for topic, published in NODE_TOPICS.items()
    }
    there |= {'/diagnostics': SHOWN['DiagnosticSummary'], '/rosout': SHOWN['RosOut']}
    assert len(there) > len(NODE_TOPICS)
    check_layout(LIVE, there, {'camera_upright'})


def test_layout_of_people_shows_topics_of_people_node():
    there = {f'/{topic.lstrip("/")}': x.msgtype for topic, x in PeopleSession.TOPICS.items()}
    there |= {'/diagnostics': SHOWN['DiagnosticSummary'], '/rosout': SHOWN['RosOut']}
    check_layout(OF_PEOPLE, there, {'camera_upright'})


def test_layout_of_bags_shows_what_replay_writes(still, tmp_path):
    bag = write(tmp_path / 'bag', recorded())
    assert main([str(bag), '-o', str(tmp_path / 'out'), *PERSON, '--quiet']) == 0
    with BagReader(tmp_path / 'out') as reader:
        there = {x.name: x.msgtype for x in reader.topics.values() if x.message_count}
        transforms = next(reader.messages(['/tf'])).message.transforms
    check_layout(OF_BAGS, there, {str(one.header.frame_id) for one in transforms})
