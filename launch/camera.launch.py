"""Starts everything for people before a webcam, or in a video file: camera, detector, nodes.

    ros2 launch hmt_ros camera.launch.py
    ros2 launch hmt_ros camera.launch.py video:=walk.mp4 fov:=70 rviz:=true
    ros2 launch hmt_ros camera.launch.py video:=/dev/video2 calibration:=camera.yaml
    ros2 launch hmt_ros camera.launch.py people:=3 rviz:=true
    ros2 launch hmt_ros camera.launch.py --show-args

What else hmt.launch.py takes can be given, too, but for image and nodes; with more than one of
people, people_node takes the place of the nodes for one.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.sessions.focal_length import USUAL_SIGMA

PACKAGE = 'hmt_ros'
CAMERA = 'camera'
WITH_DETECTOR = 'filter_node smoother_node keypoints_node'
WITHOUT_DETECTOR = 'filter_node smoother_node bme_node'
SEVERAL = 'people_node keypoints_node'
DETECTOR = DETECTORS[USUAL_DETECTOR]
# Arguments of hmt.launch.py that tell where the person is in place of the detector.
FINDERS = ('background_file', 'keypoints', 'detections_source', 'mask', 'depth', 'subject_file')
INSTALL = '"ros2 run hmt_ros install-detector" (in a clone: make detector)'

# Name, default, description.
ARGUMENTS = (
    ('video', '/dev/video0', 'webcam, as /dev/video0, or the path of a video file'),
    ('device', '', 'another name of the argument video'),
    ('fov', '', 'field of view of the camera from left to right, degrees; empty: see calibration'),
    (
        'calibration',
        '',
        'calibration file of camera_calibration or of OpenCV; if empty, and fov too, a field of '
        'view of 60 degrees is assumed, with a warning',
    ),
    ('loop', 'false', "'true': a video file begins again at its end"),
    ('rate', '1.0', 'factor on the speed of a video file'),
    (
        'detector',
        'auto',
        f"'true': keypoints of {DETECTOR.title}; 'false': none, silhouettes start the track, which "
        "needs background_file or an empty scene at first; 'auto': where "
        f'{DETECTOR.title} is installed',
    ),
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
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    handed = getattr(context, 'launch_configurations', context)
    missing = what_is_missing(given, handed)
    if missing:
        sys.stderr.write(f'camera.launch.py: {missing}\n')
    return actions_of(given, Path(get_package_share_directory(PACKAGE)), handed)


def what_is_missing(given: Mapping[str, str], handed: Mapping[str, str]) -> str:
    """What the nodes lack to find a person, and what to do; '' if nothing.

    Args:
        given, handed: as for `actions_of`.
    """
    if given['detector'] != 'false' and DETECTOR.is_installed():
        return ''
    unwanted = given['detector'] == 'false'
    text = 'no detector is wanted' if unwanted else f'{DETECTOR.title} is not installed'
    if any(handed.get(name) for name in FINDERS):
        return '' if unwanted else f'{text}: keypoints help most, run {INSTALL}'
    return (
        f'{text}, and no image of the empty scene is given: nothing tells where the person is. Run '
        f'{INSTALL}, or give background_file:=FILE, or let the camera see the scene without '
        'anybody first'
    )


def actions_of(
    given: Mapping[str, str], share: Path, handed: Mapping[str, str] = MappingProxyType({})
) -> list[Any]:
    """The camera, and what hmt.launch.py starts.

    Args:
        given: all arguments, by name.
        share: folder with launch/.
        handed: the arguments that hmt.launch.py takes, as far as they are given, and maybe others.

    Raises:
        ValueError: an argument that can not be used.
    """
    if given['fov'] and given['calibration']:
        raise ValueError('fov and calibration: wanted one of them, saw both')
    if given['loop'] not in ('true', 'false'):
        raise ValueError(f"loop: wanted 'true' or 'false', saw {given['loop']!r}")
    options = [given['device'] or given['video']]
    for name in ('fov', 'calibration'):
        if given[name]:
            options += [f'--{name}', given[name]]
    people = handed.get('people') or '1'
    several, detector = people != '1', _has_detector(given['detector'])
    if several and not detector:
        raise ValueError(f'people: {people} people need {DETECTOR.title}; run {INSTALL}')
    nodes = SEVERAL if several else WITH_DETECTOR if detector else WITHOUT_DETECTOR
    namespace = handed.get('namespace') or (
        '' if several else f'/humans/bodies/{handed.get("body_id") or "p1"}'
    )
    camera = Node(
        package=PACKAGE,
        executable='camera_node',
        namespace=CAMERA,
        arguments=options,
        parameters=[
            {
                'wait_for': ' '.join(f'{namespace}/{name}' for name in nodes.split()),
                'loop': given['loop'] == 'true',
                'rate': _speed(given['rate']),
            }
        ],
        output='both',
    )
    arguments = {'image': f'/{CAMERA}/image_raw', 'nodes': nodes}
    if not (given['fov'] or given['calibration'] or handed.get('focal_length_sigma')):
        arguments['focal_length_sigma'] = str(USUAL_SIGMA)
    person = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / 'launch' / 'hmt.launch.py')),
        launch_arguments=arguments.items(),
    )
    return [camera, person]


def _has_detector(wanted: str) -> bool:
    if wanted not in ('auto', 'true', 'false'):
        raise ValueError(f"detector: wanted 'auto', 'true' or 'false', saw {wanted!r}")
    return wanted == 'true' or (wanted == 'auto' and DETECTOR.is_installed())


def _speed(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f'rate: wanted a number such as 0.5, saw {text!r}') from None
