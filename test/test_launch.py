"""The launch file, the views, and the nodes started as in the launch file.

`launch` and `launch_ros` are not available as wheels. If they are not installed, stand-ins record
their arguments; the nodes are then started as launch_ros would.
"""

import re
import runpy
import subprocess
import sys
import tempfile
import time
import types
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.sessions import bme_session, keypoints_session, smoothed_messages, track_messages
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.hri_parameters import HriParameters
from hmt_ros.sessions.keypoints_session import KeypointsParameters
from hmt_ros.sessions.parameter_file import read_parameter_file
from hmt_ros.sessions.people_session import PeopleSession
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from msg_tools import BagReader

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / 'launch' / 'hmt.launch.py'
CAMERA_FILE = ROOT / 'launch' / 'camera.launch.py'
REACH = ROOT / 'bags' / 'reach'
NAMESPACE = '/humans/bodies/p1'
# Time limit for each answer and state of a node, on a loaded machine.
PATIENCE = 180.0  # s
# Time without an answer after which a service is called again, s.
ASK_AGAIN = 5.0
# Services and topics of every lifecycle node in rclpy.
OF_ALL_NODES = (
    r'/(get_type_description|describe_parameters|get_parameter_types|get_parameters|'
    r'list_parameters|set_parameters|set_parameters_atomically|change_state|get_state|'
    r'get_available_states|get_available_transitions|get_transition_graph|transition_event)$'
)
TOPICS = {**track_messages.TOPICS_OF_NODE, **smoothed_messages.TOPICS, **bme_session.TOPICS}
SETTINGS = {
    'filter_node': FilterParameters(),
    'smoother_node': SmootherParameters(),
    'bme_node': BmeParameters(),
}


class Kept:
    """Any action or substitution; records its arguments."""

    def __init__(self, *arguments, **options):
        self.arguments, self.options = arguments, options


class Configuration(Kept):
    def perform(self, context):
        return str(context[self.arguments[0]])


STAND_INS = {
    'launch': {'LaunchDescription': Kept},
    'launch.actions': {
        'DeclareLaunchArgument': Kept,
        'ExecuteProcess': type('ExecuteProcess', (Kept,), {}),
        'IncludeLaunchDescription': type('IncludeLaunchDescription', (Kept,), {}),
        'OpaqueFunction': Kept,
    },
    'launch.launch_description_sources': {'PythonLaunchDescriptionSource': Kept},
    'launch.substitutions': {'LaunchConfiguration': Configuration},
    'launch_ros': {},
    'launch_ros.actions': {'Node': type('Node', (Kept,), {})},
    'ament_index_python': {},
    'ament_index_python.packages': {
        'get_package_share_directory': lambda package: str(ROOT / package)
    },
}


def with_stand_ins(file):
    """The names in a launch file, executed with stand-ins."""
    with pytest.MonkeyPatch.context() as patch:
        for name, content in STAND_INS.items():
            module = types.ModuleType(name)
            module.__dict__.update(content)
            patch.setitem(sys.modules, name, module)
        return runpy.run_path(str(file))


def detector(installed):
    """Pretends that the default detector is installed, or not."""
    return replace(DETECTORS[USUAL_DETECTOR], is_installed=lambda: installed)


@pytest.fixture(scope='module')
def description():
    return with_stand_ins(FILE)


def defaults(description):
    """All arguments of a launch file, by name."""
    *declared, _ = description['generate_launch_description']().arguments[0]
    return {one.arguments[0]: one.options['default_value'] for one in declared}


@pytest.fixture
def actions(description, tmp_path, monkeypatch):
    """Function that returns the options of all actions, by executable."""
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))

    def make(**given):
        function = description['generate_launch_description']().arguments[0][-1]
        context = defaults(description)
        assert given.keys() <= context.keys()
        # In separate processes, unless a test is about the common process.
        made = function.options['function']({**context, 'one_process': 'false', **given})
        return {one.options.get('executable', 'bag'): one.options for one in made}

    return make


def parameters(options):
    """Parameters of a node in addition to its file in config/."""
    file, values, *_ = options['parameters']
    assert file == str(ROOT / 'hmt_ros' / 'config' / f'{options["name"]}.yaml')
    return read_parameter_file(values, options['name'])


def test_three_nodes_in_the_namespace_of_a_person(actions):
    made = actions()
    assert list(made) == ['filter_node', 'smoother_node', 'bme_node']
    for name, options in made.items():
        assert options['package'] == 'hmt_ros'
        assert options['name'] == name
        assert options['namespace'] == '/humans/bodies/p1'
        assert Path(options['parameters'][0]).is_file()
        # Every name must be a parameter of the node, with a valid value.
        own = parameters(options)
        sim_time = own.pop('use_sim_time')
        assert sim_time is False
        with_values(SETTINGS[name], own)
    assert parameters(made['filter_node']) == {
        'use_sim_time': False,
        'autostart': True,
        'image_transport': 'raw',
        'use_mask': False,
        'use_predictions': True,
        'use_depth': False,
        'use_keypoints': False,
        'frame_prefix': 'body_p1/',
    }
    wanted = {
        ('image', '/camera/image_raw'),
        ('image/compressed', '/camera/image_raw/compressed'),
        ('camera_info', '/camera/camera_info'),
    }
    assert set(made['filter_node']['remappings']) == wanted
    assert set(made['bme_node']['remappings']) == wanted
    # With the filter predictions can be rare; without it they are the only output.
    assert parameters(made['bme_node'])['tracked_interval'] == 0.2
    alone = parameters(actions(nodes='bme_node')['bme_node'])
    assert alone['tracked_interval'] == 0.0
    assert made['smoother_node']['remappings'] == []


def test_one_process_for_all(actions, description):
    defaults = {name: default for name, default, _ in description['ARGUMENTS']}
    assert defaults['one_process'] == 'true'
    made = actions(
        one_process='true', nodes='bme_node filter_node', params_file='own.yaml', hri='true',
        keypoints='/pose2d',
    )  # fmt: skip
    assert list(made) == ['person_node', 'hri_node']
    one, apart = made['person_node'], actions(nodes='bme_node filter_node', keypoints='/pose2d')
    # Nodes keep the names used in parameter files; a name would apply to all of them.
    assert 'name' not in one
    assert one['arguments'] == ['bme_node', 'filter_node']
    assert one['namespace'] == NAMESPACE
    assert one['remappings'] == apart['filter_node']['remappings']
    *files, own = one['parameters']
    assert own == 'own.yaml'
    for number, name in enumerate(one['arguments']):
        config, values = files[2 * number : 2 * number + 2]
        assert config == str(ROOT / 'hmt_ros' / 'config' / f'{name}.yaml')
        assert read_parameter_file(values, name) == parameters(apart[name])
    assert one['ros_arguments'] == [
        word
        for name in one['arguments']
        for word in ('--log-level', f'humans.bodies.p1.{name}:=info')
    ]
    assert one['respawn'] is False
    again = actions(one_process='true', respawn='true')['person_node']
    assert (again['respawn'], again['respawn_delay']) == (True, 1.0)
    # The node for several people has its own process.
    assert list(actions(one_process='true', nodes='people_node')) == ['people_node']


def test_nodes_that_find_keypoints(actions):
    made = actions(nodes='filter_node keypoints_node', image_transport='compressed')
    assert parameters(made['filter_node'])['use_keypoints'] is True
    assert parameters(made['filter_node'])['use_keypoints_3d'] is True
    own = parameters(made['keypoints_node'])
    del own['use_sim_time']
    assert with_values(KeypointsParameters(), own).image_transport == 'compressed'
    made = actions(nodes='filter_node bme_node', detections='/yolo', detections_source='yolo')
    tracks = made['filter_node']
    own = parameters(tracks)
    assert (own['source'], own['use_keypoints']) == ('yolo', True)
    assert 'use_keypoints_3d' not in own
    assert parameters(made['bme_node'])['source'] == 'yolo'
    assert dict(tracks['remappings'])['detections'] == '/yolo'
    allowed = policy()
    assert allowed['keypoints_node']['publish'] >= {
        f'{NAMESPACE}/{topic}' for topic in keypoints_session.TOPICS
    }
    assert f'{NAMESPACE}/keypoints_3d' in allowed['filter_node']['subscribe']


def test_several_people(actions):
    made = actions(nodes='people_node', detections='/yolo', detections_source='yolo')
    (node,) = made.values()
    assert (node['executable'], node['namespace']) == ('people_node', '')
    own = parameters(node)
    assert own.pop('use_sim_time') is False
    assert with_values(PeopleParameters(), own).source == 'yolo'
    assert dict(node['remappings'])['detections'] == '/yolo'
    own = parameters(actions(nodes='people_node', namespace='/lab')['people_node'])
    assert own['source'] == 'people'
    with pytest.raises(ValueError, match='people_node stands alone, or with keypoints_node'):
        actions(nodes='filter_node people_node')
    made = actions(nodes='people_node keypoints_node', people='3')
    assert {node['namespace'] for node in made.values()} == {''}
    assert parameters(made['keypoints_node'])['people'] == 3
    assert parameters(made['people_node'])['max_people'] == 3
    for wrong in ('0', '21', 'all', '-1', ''):
        with pytest.raises(ValueError, match='people: wanted a number from 1 to 20'):
            actions(nodes='people_node', people=wrong)


def test_rep_155(actions):
    made = actions(hri='true', image_transport='compressed', bag='walk')
    assert list(made) == ['filter_node', 'smoother_node', 'bme_node', 'hri_node', 'bag']
    bridge = made['hri_node']
    assert bridge['namespace'] == NAMESPACE
    assert dict(bridge['remappings'])['camera_info'] == '/camera/camera_info'
    own = parameters(bridge)
    assert own.pop('use_sim_time') is True
    settings = with_values(HriParameters(), own)
    # All detected people.
    assert (settings.named, settings.image_transport) == ((), 'compressed')
    elsewhere = parameters(actions(hri='true', namespace='/lab/anna')['hri_node'])
    assert elsewhere['namespaces'] == '/lab/anna'


def test_arguments(actions, tmp_path):
    made = actions(
        body_id='anna',
        nodes='bme_node,filter_node',
        image='/left/rect/compressed',
        image_transport='compressed',
        keypoints='/pose2d',
        mask='/segmented/compressed',
        depth='/aligned/image_raw',
        subject_file='12',
        background_file='wall.png',
        model_file='m.npz',
        params_file='own.yaml',
        bag='walk',
        autostart='False',
        log_level='debug',
    )
    assert list(made) == ['bme_node', 'filter_node', 'bag']
    tracks, predicts = made['filter_node'], made['bme_node']
    assert tracks['namespace'] == '/humans/bodies/anna'
    assert parameters(tracks) == {
        'use_sim_time': True,
        'reset_on_time_jump': True,
        'autostart': False,
        'image_transport': 'compressed',
        'use_mask': True,
        'background_file': 'wall.png',
        'subject_file': '12',
        'use_predictions': True,
        'use_depth': True,
        'use_keypoints': True,
        'frame_prefix': 'body_anna/',
    }
    assert parameters(predicts)['model_file'] == 'm.npz'
    assert parameters(predicts)['use_mask'] is True
    assert dict(tracks['remappings']) == {
        'image': '/left/rect',
        'image/compressed': '/left/rect/compressed',
        'camera_info': '/left/camera_info',
        'keypoints': '/pose2d',
        'mask': '/segmented',
        'mask/compressed': '/segmented/compressed',
        'depth': '/aligned/image_raw',
    }
    # The user's own file has priority.
    assert tracks['parameters'][-1] == 'own.yaml'
    assert tracks['ros_arguments'] == ['--log-level', 'humans.bodies.anna.filter_node:=debug']
    assert made['bag']['cmd'][:4] == ['ros2', 'bag', 'play', 'walk']
    assert not parameters(actions(nodes='filter_node')['filter_node'])['use_predictions']
    other = actions(namespace='/lab/bob', use_sim_time='true')['smoother_node']
    assert other['namespace'] == '/lab/bob'
    assert parameters(other)['use_sim_time'] is True


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'body_id': '1'}, "a letter first, saw '1'"),
        ({'body_id': 'a/b'}, "saw 'a/b'"),
        ({'namespace': '/'}, "wanted a name such as /humans/bodies/anna, saw '/'"),
        ({'namespace': 'lab'}, "saw 'lab'"),
        (
            {'nodes': 'filter_node smother'},
            "nodes: wanted some of filter_node .*, saw 'filter_node",
        ),
        ({'nodes': ''}, 'nodes: wanted some of'),
        ({'image_transport': 'theora'}, "image_transport: wanted 'raw' or 'compressed'"),
        ({'rviz': 'yes'}, "rviz: wanted 'true' or 'false', saw 'yes'"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(actions, given, message):
    with pytest.raises(ValueError, match=message) as caught:
        actions(**given)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('given', 'options', 'nodes'),
    [
        ({'detector': 'false'}, ['/dev/video0'], 'filter_node smoother_node bme_node'),
        (
            {'video': 'a.mp4', 'fov': '70', 'detector': 'true'},
            ['a.mp4', '--fov', '70'],
            'filter_node smoother_node keypoints_node',
        ),
        (
            {'device': '/dev/video2', 'calibration': 'c.yaml'},
            ['/dev/video2', '--calibration', 'c.yaml'],
            'filter_node smoother_node bme_node',
        ),
    ],
)
def test_one_line_from_a_webcam_to_a_person(given, options, nodes, monkeypatch):
    camera_file = with_stand_ins(CAMERA_FILE)
    monkeypatch.setitem(camera_file['actions_of'].__globals__, 'DETECTOR', detector(False))
    *declared, function = camera_file['generate_launch_description']().arguments[0]
    context = {one.arguments[0]: one.options['default_value'] for one in declared}
    assert given.keys() <= context.keys()
    camera, person = function.options['function']({**context, **given})
    assert (camera.options['executable'], camera.options['namespace']) == ('camera_node', 'camera')
    assert camera.options['arguments'] == options
    # A file begins when all nodes of the person are active.
    names = ' '.join(f'{NAMESPACE}/{name}' for name in nodes.split())
    assert camera.options['parameters'] == [{'wait_for': names, 'loop': False, 'rate': 1.0}]
    handed = dict(person.options['launch_arguments'])
    # An assumed field of view makes depths uncertain.
    assumed = '0.2' if len(options) == 1 else None
    assert handed.pop('focal_length_sigma', None) == assumed
    assert handed == {'image': '/camera/image_raw', 'nodes': nodes}
    (source,) = person.arguments
    assert source.arguments == (str(ROOT / 'hmt_ros' / 'launch' / 'hmt.launch.py'),)
    # No argument has the same name in both files.
    assert not context.keys() & {name for name, _, _ in with_stand_ins(FILE)['ARGUMENTS']}


def test_several_people_before_a_webcam(monkeypatch):
    camera_file = with_stand_ins(CAMERA_FILE)
    made, names = camera_file['actions_of'], camera_file['actions_of'].__globals__
    given = {name: default for name, default, _ in camera_file['ARGUMENTS']}
    monkeypatch.setitem(names, 'DETECTOR', detector(True))
    camera, people = made(given, ROOT / 'hmt_ros', {'people': '3'})
    assert camera.options['parameters'][0]['wait_for'] == '/people_node /keypoints_node'
    assert dict(people.options['launch_arguments'])['nodes'] == 'people_node keypoints_node'
    _, one = made(given, ROOT / 'hmt_ros', {'people': '1'})
    assert 'filter_node' in dict(one.options['launch_arguments'])['nodes']
    monkeypatch.setitem(names, 'DETECTOR', detector(False))
    with pytest.raises(ValueError, match=r'people: 3 people need .*; run "ros2 run hmt_ros '):
        made(given, ROOT / 'hmt_ros', {'people': '3'})


def test_what_is_not_installed_is_named_with_the_command_that_installs_it(description, monkeypatch):
    def missing(package):
        raise LookupError(package)

    names = description['_installed'].__globals__
    monkeypatch.setitem(names, 'get_package_share_directory', missing)
    wanted = 'rviz: package tf2_ros is not installed; run "sudo apt install ros-jazzy-tf2-ros"'
    with pytest.raises(ValueError, match=re.escape(wanted)):
        description['actions_of'](defaults(description) | {'rviz': 'true'}, ROOT)


def test_rviz_shows_topics_of_the_nodes_relative_to_a_namespace():
    text = (ROOT / 'rviz' / 'hmt.rviz').read_text('utf-8')
    displays = yaml.safe_load(text)['Visualization Manager']['Displays']
    shown = {
        (one.get('Topic') or one['Description Topic'])['Value']: one
        for one in displays
        if 'Topic' in one or 'Description Topic' in one
    }
    kinds = {
        'MarkerArray': 'visualization_msgs/msg/MarkerArray',
        'RobotModel': 'std_msgs/msg/String',
        'Image': 'sensor_msgs/msg/CompressedImage',
    }
    for topic, one in shown.items():
        assert not topic.startswith('/')
        assert TOPICS[topic].msgtype == kinds[one['Class'].rpartition('/')[2]]
        policy = (one.get('Topic') or one['Description Topic'])['Durability Policy']
        assert policy == ('Transient Local' if TOPICS[topic].latched else 'Volatile')
    assert shown.keys() == {
        'markers',
        'trajectory_markers',
        'human_description',
        'overlay/compressed',
    }
    assert any(one['Class'].endswith('/TF') for one in displays)
    assert 'robot_description' not in text


def test_rviz_shows_everybody(actions):
    made = actions(nodes='people_node keypoints_node', rviz='true')
    assert made['rviz2']['arguments'][1].endswith('rviz/people.rviz')
    assert actions(rviz='true')['rviz2']['arguments'][1].endswith('rviz/hmt.rviz')
    text = (ROOT / 'rviz' / 'people.rviz').read_text('utf-8')
    displays = yaml.safe_load(text)['Visualization Manager']['Displays']
    shown = {one['Topic']['Value'] for one in displays if 'Topic' in one}
    assert shown == {'markers', 'overlay/compressed'}
    assert shown <= PeopleSession.TOPICS.keys()


def test_page_lists_the_arguments(description):
    page = (ROOT / 'docs' / 'views.md').read_text('utf-8')
    table = page.partition('| argument |')[2].partition('\n\n')[0]
    cells = [line.split('|')[1] for line in table.splitlines()[2:]]
    listed = [name for cell in cells for name in re.findall('`([a-z_]+)`', cell)]
    assert sorted(listed) == sorted(name for name, _, _ in description['ARGUMENTS'])
    pages = [*(ROOT / 'docs').glob('*.md'), ROOT / 'README.md']
    commands = re.findall(
        r'^ros2 launch hmt_ros hmt.launch.py((?:.|\\\n)*)$',
        '\n'.join(path.read_text('utf-8') for path in pages),
        re.MULTILINE,
    )
    given = re.findall(r'([a-z_]+):=', ' '.join(commands))
    assert len(given) > 10
    assert set(given) <= set(listed)
    of_camera = re.findall(
        r'^ros2 launch hmt_ros camera.launch.py(.*)$',
        '\n'.join(path.read_text('utf-8') for path in pages),
        re.MULTILINE,
    )
    given = re.findall(r'([a-z_]+):=', ' '.join(of_camera))
    own = {name for name, _, _ in with_stand_ins(CAMERA_FILE)['ARGUMENTS']}
    assert own & set(given)
    assert set(given) <= own | set(listed) - {'image', 'nodes'}


# The nodes, started with what the launch file gives launch_ros.


def command(options):
    """Arguments of a node as launch_ros makes them."""
    name, namespace = options['name'], options['namespace']
    words = ['--ros-args', '-r', f'__node:={name}', '-r', f'__ns:={namespace}']
    for file in options['parameters']:
        words += ['--params-file', file]
    for source, target in options['remappings']:
        words += ['-r', f'{source}:={target}']
    return [sys.executable, '-m', f'hmt_ros.nodes.{name}', *words, *options['ros_arguments']]


class Running:
    """Nodes in their own processes, and a node that inspects them.

    Args:
        node: inspecting node.
        context: context of the inspecting node.
        processes: processes by the name of their node.
        folder: folder with the output of the processes.
    """

    def __init__(self, node, context, processes, folder):
        from rclpy.executors import SingleThreadedExecutor

        self.node, self.processes, self.folder = node, processes, folder
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(node)

    def spin_until(self, done, what):
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end, f'waited in vain for {what}: {self.said()}'
            self.executor.spin_once(timeout_sec=0.05)

    def said(self):
        return [path.read_text('utf-8') for path in sorted(self.folder.glob('*.output'))]

    def call(self, kind, name, service, **fields):
        client = self.node.create_client(kind, f'{NAMESPACE}/{name}/{service}')
        self.spin_until(client.service_is_ready, f'{service} of {name}')
        # The middleware drops an answer to a client that the node has not discovered yet.
        asked = {}

        def is_answered():
            if not asked or time.monotonic() - max(asked) > ASK_AGAIN:
                asked[time.monotonic()] = client.call_async(kind.Request(**fields))
            return any(future.done() for future in asked.values())

        self.spin_until(is_answered, f'an answer of {service} of {name}')
        self.node.destroy_client(client)
        return next(future for future in asked.values() if future.done()).result()

    def wait_until_active(self, name):
        from lifecycle_msgs.srv import GetState

        self.spin_until(
            lambda: self.call(GetState, name, 'get_state').current_state.label == 'active', name
        )

    def graph(self, name):
        """Types, by name, of a node's publishers, subscriptions and services."""
        node = self.node
        return {
            'publish': self._types(node.get_publisher_names_and_types_by_node, name),
            'subscribe': self._types(node.get_subscriber_names_and_types_by_node, name),
            'reply': self._types(node.get_service_names_and_types_by_node, name),
        }

    @staticmethod
    def _types(ask, name):
        return {topic: kind for topic, (kind,) in ask(name, NAMESPACE)}

    @staticmethod
    def resolved(name, topic):
        """The full name that the launch file gives a topic or service of a node."""
        camera = {'image': '/image_raw', 'image/compressed': '/image_raw/compressed'}
        if topic in (*camera, 'camera_info'):
            return f'/camera{camera.get(topic, "/camera_info")}'
        if topic.startswith('~'):
            return f'{NAMESPACE}/{name}{topic[1:]}'
        return topic if topic.startswith('/') else f'{NAMESPACE}/{topic}'


def policy():
    """Names that the SROS 2 policy allows, resolved as in sros2, by node and action."""
    root = ET.parse(ROOT / 'security' / 'sros2_policy.xml').getroot()
    assert (root.tag, root.attrib) == ('policy', {'version': '0.2.0'})
    result = {}
    *apart, together = root.findall('./enclaves/enclave')
    # With all nodes in one process the profiles are those of the other enclaves.
    (included,) = together.findall('./profiles/*')
    assert together.attrib['path'] == f'{NAMESPACE}/person_node'
    assert included.tag == '{http://www.w3.org/2001/XInclude}include'
    assert included.attrib == {
        'href': '',
        'xpointer': 'xpointer(/policy/enclaves/enclave[position() < last()]/profiles/profile)',
    }
    for enclave in apart:
        (profile,) = enclave.findall('./profiles/profile')
        name = profile.attrib['node']
        assert profile.attrib['ns'] == NAMESPACE
        assert enclave.attrib['path'] == f'{NAMESPACE}/{name}'
        result[name] = {}
        for group in profile:
            ((verb, value),) = group.attrib.items()
            assert value == 'ALLOW'
            assert (group.tag, verb) in (
                ('topics', 'publish'),
                ('topics', 'subscribe'),
                ('services', 'reply'),
            )
            assert {element.tag for element in group} == {group.tag.removesuffix('s')}
            result[name][verb] = {
                text
                if text.startswith('/')
                else f'{NAMESPACE}/{name}{text[1:]}'
                if text.startswith('~')
                else f'{NAMESPACE}/{text}'
                for text in (str(element.text) for element in group)
            }
    return result


def opened(pid):
    """Number of a process's sockets that accept connections or datagrams, by kind."""
    process = Path('/proc') / str(pid)
    links = [str(link.readlink()) for link in (process / 'fd').iterdir()]
    inodes = {link[8:-1] for link in links if link.startswith('socket:[')}
    counts = {}
    for kind in ('tcp', 'tcp6', 'udp', 'udp6', 'raw', 'raw6', 'unix'):
        rows = [line.split() for line in (process / 'net' / kind).read_text().splitlines()[1:]]
        if kind == 'unix':
            # Unix sockets with the flag for accepting connections.
            rows = [row for row in rows if row[6] in inodes and int(row[3], 16) & 0x10000]
        else:
            # TCP sockets in the state LISTEN.
            rows = [row for row in rows if row[9] in inodes]
            rows = [row for row in rows if not kind.startswith('tcp') or row[3] == '0A']
        counts[kind] = len(rows)
    return counts


@pytest.fixture(scope='module')
def started(description, tmp_path_factory):
    """The three nodes for the bundled bag, running, with an inspecting node."""
    import rclpy

    folder = tmp_path_factory.mktemp('launched')
    own = folder / 'own.yaml'
    own.write_text(
        '/**/filter_node:\n  ros__parameters:\n    max_hypotheses: 5\n'
        f'    subject_file: {REACH / "subject.yaml"}\n',
        'utf-8',
    )
    entities = description['generate_launch_description']().arguments[0]
    context = {one.arguments[0]: one.options['default_value'] for one in entities[:-1]}
    context.update(
        params_file=str(own),
        image_transport='compressed',
        # The user's own file has priority over it.
        subject_file='12',
        background_file=str(REACH / 'background.png'),
        one_process='false',
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, 'tempdir', str(folder))
        made = entities[-1].options['function'](context)
    processes = []
    for one in made:
        output = (folder / f'{one.options["name"]}.output').open('wb')
        words = command(one.options)
        processes.append(subprocess.Popen(words, cwd=ROOT, stdout=output, stderr=output))
        output.close()
    ros = rclpy.Context()
    rclpy.init(context=ros)
    node = rclpy.create_node('looker', context=ros)
    try:
        yield Running(node, ros, dict(zip(SETTINGS, processes, strict=True)), folder)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=ros)
        for process in processes:
            process.terminate()
        codes = [process.wait(PATIENCE) for process in processes]
    assert codes == [0, 0, 0]


@pytest.mark.ros
def test_images_of_the_camera_become_a_person_in_the_namespace(started):
    """Remappings, parameters, frames and topics together, with the real tracker."""
    from importlib import import_module

    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import CameraInfo, CompressedImage

    for name in SETTINGS:
        started.wait_until_active(name)
    node, arrived = started.node, {}
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for topic in ('human_description', 'human_joint_states', '/tf', 'pose_prediction', 'markers'):
        package, _, kind = TOPICS[topic].msgtype.split('/')

        def keep(message, topic=topic):
            arrived.setdefault(topic, message)

        node.create_subscription(
            getattr(import_module(f'{package}.msg'), kind),
            topic if topic.startswith('/') else f'{NAMESPACE}/{topic}',
            keep,
            latched if TOPICS[topic].latched else 10,
        )
    kinds = {'image/compressed': CompressedImage, 'camera_info': CameraInfo}
    publishers = {
        topic: node.create_publisher(kind, started.resolved('filter_node', topic), 10)
        for topic, kind in kinds.items()
    }
    started.spin_until(
        lambda: all(one.get_subscription_count() == 2 for one in publishers.values()), 'listeners'
    )
    with BagReader(REACH) as bag:
        for stored in bag.messages(list(kinds)):
            topic = stored.topic.removeprefix('/')
            publishers[topic].publish(deserialize_message(bytes(stored.data), kinds[topic]))
            for _ in range(4):
                started.executor.spin_once(timeout_sec=0.05)
            if len(arrived) == 5:
                break
    started.spin_until(lambda: len(arrived) == 5, f'all topics, beside {list(arrived)}')
    robot = ET.fromstring(arrived['human_description'].data)
    links = [link.attrib['name'] for link in robot.findall('link')]
    camera = arrived['/tf'].transforms[0].header.frame_id
    assert links[0] == camera
    # The lines of the scene determine the vertical.
    frames = {*links[1:], 'body_p1/camera_upright'}
    assert {t.child_frame_id for t in arrived['/tf'].transforms} == frames
    assert all(link.startswith('body_p1/') for link in links[1:])
    movable = {one.attrib['name'] for one in robot.findall('joint') if one.get('type') != 'fixed'}
    assert set(arrived['human_joint_states'].name) == movable
    assert len(arrived['pose_prediction'].components) > 0


@pytest.mark.ros
@pytest.mark.parametrize('name', SETTINGS)
def test_policy_and_page_have_what_the_nodes_do_and_nothing_else(started, name):
    started.wait_until_active(name)
    allowed = policy()[name]
    found = started.graph(name)
    assert found.keys() == allowed.keys()
    # Time is subscribed to if it is simulated, images in one of two forms, and transforms with
    # gravity_frame.
    optional = {'/clock', '/camera/image_raw', '/tf', '/tf_static'}
    assert allowed['subscribe'] - optional == set(found['subscribe'])
    assert allowed['publish'] == set(found['publish'])
    assert allowed['reply'] == set(found['reply'])
    # The page of the node lists subscriptions, publishers and services with their types.
    page = (ROOT / 'docs' / f'{name}.md').read_text('utf-8')
    for heading, key, elsewhere in (
        ('## Subscribed topics', 'subscribe', ()),
        ('## Published topics', 'publish', ('/rosout', '/parameter_events')),
        ('## Services', 'reply', ()),
    ):
        text = re.split(r'\n#+ ', page.partition(f'\n{heading}\n')[2], maxsplit=1)[0]
        rows = re.findall(r'^\| `([^`]+)` \| ([\w/]+) \|', text, re.MULTILINE)
        listed = {started.resolved(name, topic): kind for topic, kind in rows}
        has = {
            topic: re.sub('/(msg|srv)/', '/', kind)
            for topic, kind in found[key].items()
            if topic not in elsewhere and not re.search(OF_ALL_NODES, topic)
        }
        if key == 'subscribe':
            assert listed.pop('/camera/image_raw', None) in (None, 'sensor_msgs/Image')
            if name == 'bme_node':
                # Only with `predict_from`.
                assert listed.pop('/humans/bodies/p1/keypoints') == 'hmt_msgs/Keypoints2D'
        assert listed == has


@pytest.mark.ros
def test_nodes_listen_to_nothing_but_dds(started):
    """No TCP port and no socket file; the same UDP ports as for any node with DDS."""
    program = 'import rclpy, sys; rclpy.init(); n = rclpy.create_node("plain"); print(flush=True)'
    plain = subprocess.Popen(
        [sys.executable, '-c', f'{program}; sys.stdin.read()'],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    plain.stdout.readline()
    wanted = opened(plain.pid)
    plain.communicate(timeout=PATIENCE)
    assert wanted['udp'] > 0
    assert {kind for kind, count in wanted.items() if count} <= {'udp', 'udp6'}
    for name, process in started.processes.items():
        started.wait_until_active(name)
        assert opened(process.pid) == wanted
