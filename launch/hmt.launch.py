"""Starts the nodes for one person, in a namespace of its own, and REP 155 for all if asked to.

    ros2 launch hmt_ros hmt.launch.py image:=/camera/image_raw
    ros2 launch hmt_ros hmt.launch.py body_id:=anna image:=/left/image image_transport:=compressed
    ros2 launch hmt_ros hmt.launch.py bag:=my_recording rviz:=true
    ros2 launch hmt_ros hmt.launch.py --show-args

Parameters come from the files in config/, from the arguments here, and from the file that
params_file names; the later ones take precedence.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = 'hmt_ros'
USUAL_NODES = ('filter_node', 'smoother_node', 'bme_node')
DETECTOR = 'keypoints_node'
# Several people: its topics are in the root namespace.
PEOPLE = 'people_node'
NODES = (*USUAL_NODES, DETECTOR, PEOPLE)
# Layouts of RViz for one person, and for several.
LAYOUTS = 'hmt.rviz', 'people.rviz'
# Runs nodes of one person in one process.
TOGETHER = 'person_node'
# Default frame of images in the nodes; and the frame for views, which need z up.
OPTICAL, UPRIGHT = 'camera_optical_frame', 'camera_upright'
# Rotation from (x right, y down, z forward) to (x forward, y left, z up).
TURN = {'qx': 0.5, 'qy': -0.5, 'qz': 0.5, 'qw': 0.5}
TRUTH = {'true': True, 'false': False}
# Interval between two predictions of bme_node while filter_node tracks the person, s.
TRACKED_INTERVAL = 0.2
# Time after which a process that has ended is started again, s.
RESPAWN_DELAY = 1.0
# Environment variables that name a file with settings of Fast DDS.
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')

# Name, default, description.
ARGUMENTS = (
    (
        'body_id',
        'p1',
        'identity of the person: letters, digits and underscores, starting with a letter; the '
        'topics are /humans/bodies/<body_id>/..., the frames body_<body_id>/...',
    ),
    ('namespace', '', 'namespace of the topics; empty: /humans/bodies/<body_id>'),
    (
        'nodes',
        ' '.join(USUAL_NODES),
        f'nodes to start, separated by blanks; besides these {DETECTOR}, whose keypoints the '
        f'filter then uses; {PEOPLE}, alone or with {DETECTOR}, tracks several people',
    ),
    (
        'one_process',
        'true',
        f"'false': each node has a process of its own, which takes twice the memory and is faster "
        f'with three cores or more; {PEOPLE} always has one',
    ),
    (
        'people',
        '4',
        f'maximum number of people, with {PEOPLE}; more than 1 start it in camera.launch.py',
    ),
    ('image', '/camera/image_raw', 'topic of the images, without /compressed'),
    ('camera_info', '', 'topic of the calibration; empty: camera_info beside the images'),
    ('image_transport', 'raw', "'raw', or 'compressed' for images on <image>/compressed"),
    ('keypoints', '', 'topic of the keypoints of a 2D detector; empty: none'),
    (
        'detections',
        'detections',
        'topic of another detector, with detections_source or people_node',
    ),
    (
        'detections_source',
        '',
        "their type: 'skeleton2d', 'yolo' or 'floats', whose keypoints the filter then uses; for "
        "people_node 'people' (in place of nothing), 'yolo', 'boxes' or 'floats'; empty: none",
    ),
    ('mask', '', 'topic of the masks of a segmenter, without /compressed; empty: none'),
    ('depth', '', 'topic of depth images that are registered to the images; empty: none'),
    (
        'gravity_frame',
        '',
        'frame with z up, such as odom, from which /tf leads to the camera; empty: none',
    ),
    (
        'fixed_frame',
        '',
        'frame that stands still, such as odom, in which /tf moves the camera; empty: none',
    ),
    ('subject_file', '', 'file with the joints in one image; empty: a prediction starts the track'),
    ('background_file', '', 'image of the empty scene; empty: learned from the first images'),
    ('model_file', '', 'model written by train; empty: the one that comes with the package'),
    (
        'focal_length_sigma',
        '',
        'relative standard deviation of the focal length in camera_info, 0 to 1, where it was '
        'guessed; empty: 0',
    ),
    ('params_file', '', 'parameter file for one or several nodes, with precedence over all else'),
    ('bag', '', 'bag to play once the nodes run; empty: none'),
    ('use_sim_time', '', "'true' or 'false'; empty: true while a bag is played"),
    ('autostart', 'true', "'false': the nodes wait for their lifecycle services"),
    ('respawn', 'false', "'true': a process of the nodes that ends is started again"),
    (
        'camera_frame',
        '',
        f'optical frame of the images; if given, or with rviz, a frame {UPRIGHT} for views is '
        'published, which has the same direction of view, and z up',
    ),
    (
        'hri',
        'false',
        "'true': also start hri_node, for the topics and frames of REP 155 of all people; it needs "
        'the package hri_msgs',
    ),
    ('rviz', 'false', "'true': also start RViz"),
    ('log_level', 'info', 'log level of the nodes: debug, info, warn, error or fatal'),
)


def generate_launch_description() -> LaunchDescription:
    """The entry point of `ros2 launch`."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=what)
                for name, default, what in ARGUMENTS
            ),
            OpaqueFunction(function=_actions),
        ]
    )


def _actions(context: Any) -> list[Any]:
    """The processes for the arguments of a launch."""
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    return actions_of(given, Path(get_package_share_directory(PACKAGE)))


def actions_of(given: Mapping[str, str], share: Path) -> list[Any]:
    """The processes for arguments.

    Args:
        given: all arguments, by name.
        share: folder with config/ and rviz/.

    Raises:
        ValueError: an argument that can not be used.
    """
    namespace = _namespace(given)
    names = given['nodes'].replace(',', ' ').split()
    unknown = [name for name in names if name not in NODES]
    if unknown or not names:
        raise ValueError(f'nodes: wanted some of {" ".join(NODES)}, saw {given["nodes"]!r}')
    transport = given['image_transport']
    if transport not in ('raw', 'compressed'):
        raise ValueError(f"image_transport: wanted 'raw' or 'compressed', saw {transport!r}")
    bag = given['bag']
    sim_time = _truth(given, 'use_sim_time') if given['use_sim_time'] else bool(bag)
    image = given['image'].removesuffix('/compressed')
    info = given['camera_info'] or f'{image.rpartition("/")[0]}/camera_info'
    remappings = [('image', image), ('image/compressed', f'{image}/compressed')]
    remappings.append(('camera_info', info))
    if PEOPLE in names and not {PEOPLE, DETECTOR}.issuperset(names):
        raise ValueError(
            f'nodes: {PEOPLE} stands alone, or with {DETECTOR}, saw {given["nodes"]!r}'
        )
    if PEOPLE in names:
        namespace = given['namespace']
    source = given['detections_source']
    if source or PEOPLE in names:
        remappings.append(('detections', given['detections']))
    if given['keypoints']:
        remappings.append(('keypoints', given['keypoints']))
    mask = given['mask'].removesuffix('/compressed')
    if mask:
        remappings += [('mask', mask), ('mask/compressed', f'{mask}/compressed')]

    if given['depth']:
        remappings.append(('depth', given['depth']))

    common = {'use_sim_time': sim_time, 'autostart': _truth(given, 'autostart')}
    if sim_time:
        # As nodes do where no file in config/ says otherwise.
        common['reset_on_time_jump'] = True
    camera = {
        **common,
        'image_transport': transport,
        'use_mask': bool(mask),
        **_named(given, 'background_file'),
    }
    sigma = given['focal_length_sigma']
    lens = {'focal_length_sigma': _fraction(given, 'focal_length_sigma')} if sigma else {}
    values: dict[str, dict[str, Any]] = {
        'filter_node': {
            **camera,
            **lens,
            **_named(given, 'subject_file'),
            **_named(given, 'gravity_frame'),
            **_named(given, 'fixed_frame'),
            'use_predictions': 'bme_node' in names,
            'use_depth': bool(given['depth']),
            'use_keypoints': bool(given['keypoints'] or source) or DETECTOR in names,
            **({'source': source} if source else {}),
            **({'use_keypoints_3d': True} if DETECTOR in names else {}),
            'frame_prefix': f'{_frame(namespace)}/',
        },
        'smoother_node': common,
        'bme_node': {
            **camera,
            **_named(given, 'model_file'),
            **({'source': source} if source else {}),
            # While the person is tracked the filter needs the processor more.
            'tracked_interval': TRACKED_INTERVAL if 'filter_node' in names else 0.0,
        },
        DETECTOR: {
            **common,
            'image_transport': transport,
            **({'people': _count(given, 'people')} if PEOPLE in names else {}),
        },
        PEOPLE: {
            **camera,
            **lens,
            **_named(given, 'gravity_frame'),
            **_named(given, 'fixed_frame'),
            'source': source or 'people',
            'max_people': _count(given, 'people'),
        },
    }
    own = [given['params_file']] if given['params_file'] else []
    env = _room_for_images(share) if transport == 'raw' else {}
    files = {
        name: [str(share / 'config' / f'{name}.yaml'), _file(name, values[name])] for name in names
    }
    levels = {name: f'{_logger(namespace, name)}:={given["log_level"]}' for name in names}
    respawn = _truth(given, 'respawn')
    if _truth(given, 'one_process') and PEOPLE not in names:
        actions: list[Any] = [
            Node(
                package=PACKAGE,
                executable=TOGETHER,
                namespace=namespace,
                arguments=names,
                parameters=[file for name in names for file in files[name]] + own,
                remappings=remappings,
                ros_arguments=[x for name in names for x in ('--log-level', levels[name])],
                output='both',
                respawn=respawn,
                respawn_delay=RESPAWN_DELAY,
                additional_env=env,
            )
        ]
    else:
        actions = [
            Node(
                package=PACKAGE,
                executable=name,
                name=name,
                namespace=namespace,
                parameters=[*files[name], *own],
                remappings=[] if name == 'smoother_node' else remappings,
                ros_arguments=['--log-level', levels[name]],
                output='both',
                respawn=respawn,
                respawn_delay=RESPAWN_DELAY,
                additional_env=env,
            )
            for name in names
        ]
    if _truth(given, 'hri'):
        _installed('hri_msgs', 'hri')
        actions.append(_hri_node(given, share, namespace, common, remappings, env))
    rviz = _truth(given, 'rviz')
    if rviz or given['camera_frame']:
        frames = {'frame-id': given['camera_frame'] or OPTICAL, 'child-frame-id': UPRIGHT}
        options = [str(x) for key, value in {**frames, **TURN}.items() for x in (f'--{key}', value)]
        actions.append(
            Node(
                package=_installed('tf2_ros', 'rviz' if rviz else 'camera_frame'),
                executable='static_transform_publisher',
                name=UPRIGHT,
                namespace=namespace,
                arguments=options,
                output='log',
            )
        )
    if rviz:
        # Its topics are relative: the namespace selects the person.
        actions.append(
            Node(
                package=_installed('rviz2', 'rviz'),
                executable='rviz2',
                name='rviz2',
                namespace=namespace,
                arguments=['-d', str(share / 'rviz' / LAYOUTS[PEOPLE in names])],
                parameters=[{'use_sim_time': sim_time}],
                output='log',
            )
        )
    if bag:
        # The bag waits for the nodes: late subscribers would miss the first images.
        command = ['ros2', 'bag', 'play', bag, '--clock', '--delay', '5']
        actions.append(ExecuteProcess(cmd=command, output='both', additional_env=env))
    return actions


def _hri_node(
    given: Mapping[str, str],
    share: Path,
    namespace: str,
    common: Mapping[str, Any],
    remappings: list[tuple[str, str]],
    env: dict[str, str],
) -> Any:
    """The node that speaks REP 155 about all people below /humans/bodies, or about this one."""
    values = {**common, 'image_transport': given['image_transport']}
    if not namespace.startswith('/humans/bodies/'):
        values['namespaces'] = namespace
    own = [given['params_file']] if given['params_file'] else []
    return Node(
        package=PACKAGE,
        executable='hri_node',
        name='hri_node',
        namespace=namespace,
        parameters=[str(share / 'config' / 'hri_node.yaml'), _file('hri_node', values), *own],
        remappings=remappings,
        ros_arguments=['--log-level', f'{_logger(namespace, "hri_node")}:={given["log_level"]}'],
        output='both',
        additional_env=env,
    )


def _room_for_images(share: Path) -> dict[str, str]:
    """Settings of Fast DDS with buffers for raw images; empty if there are settings already."""
    if any(name in os.environ for name in PROFILES):
        return {}
    return {PROFILES[0]: str(share / 'config' / 'fastdds.xml')}


def _namespace(given: Mapping[str, str]) -> str:
    """Absolute namespace of the person."""
    body_id = given['body_id']
    if not re.fullmatch(r'[A-Za-z][A-Za-z0-9_]*', body_id):
        raise ValueError(
            f'body_id: wanted letters, digits and underscores, a letter first, saw {body_id!r}'
        )
    namespace = given['namespace'] or f'/humans/bodies/{body_id}'
    # The URDF of a person must not replace that of a robot.
    if not re.fullmatch(r'(/[A-Za-z_][A-Za-z0-9_]*)+', namespace):
        raise ValueError(
            f'namespace: wanted a name such as /humans/bodies/anna, saw {given["namespace"]!r}'
        )
    return namespace


def _named(given: Mapping[str, str], name: str) -> dict[str, str]:
    """The file or frame that an argument names, as a parameter; empty without a name."""
    return {name: given[name]} if given[name] else {}


def _file(name: str, values: Mapping[str, Any]) -> str:
    """Writes values for a node into a parameter file, in the same section as the files in config/.

    launch_ros would write a section with the full name of the node, over which only such a section
    of params_file would take precedence: ROS merges sections of one name at the first of them.
    """
    prefix, section = f'{name}_', {f'/**/{name}': {'ros__parameters': values}}
    with NamedTemporaryFile(
        'w', encoding='utf-8', prefix=prefix, suffix='.yaml', delete=False
    ) as file:
        # JSON is YAML in which all text is quoted: a file named 12 stays text.
        json.dump(section, file, ensure_ascii=False)
    return file.name


def _installed(package: str, argument: str) -> str:
    """The name of an installed package.

    Raises:
        ValueError: it is not installed. launch itself would notice only after it has started nodes.
    """
    try:
        get_package_share_directory(package)
    except LookupError:
        raise ValueError(
            f'{argument}: package {package} is not installed; run "sudo apt install '
            f'ros-jazzy-{package.replace("_", "-")}", or start without {argument}'
        ) from None
    return package


def _frame(namespace: str) -> str:
    """Prefix of the frames of a person, from the last part of its namespace."""
    return f'body_{namespace.rpartition("/")[2]}'


def _logger(namespace: str, name: str) -> str:
    """Name of a node's logger."""
    return f'{namespace}/{name}'.strip('/').replace('/', '.')


def _count(given: Mapping[str, str], name: str) -> int:
    text = given[name]
    if not (re.fullmatch(r'\d+', text) and 1 <= int(text) <= 20):
        raise ValueError(f'{name}: wanted a number from 1 to 20, saw {text!r}')
    return int(text)


def _fraction(given: Mapping[str, str], name: str) -> float:
    text = given[name]
    value = float(text) if re.fullmatch(r'\d*\.?\d+', text) else 2.0
    if value > 1.0:
        raise ValueError(f'{name}: wanted a number from 0 to 1, saw {text!r}')
    return value


def _truth(given: Mapping[str, str], name: str) -> bool:
    text = given[name].lower()
    if text not in TRUTH:
        raise ValueError(f"{name}: wanted 'true' or 'false', saw {given[name]!r}")
    return TRUTH[text]
