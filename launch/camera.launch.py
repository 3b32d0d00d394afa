"""Starts everything for one person before a webcam, or in a video file: camera, detector, nodes.

    ros2 launch hmt_ros camera.launch.py
    ros2 launch hmt_ros camera.launch.py video:=walk.mp4 fov:=70 rviz:=true
    ros2 launch hmt_ros camera.launch.py video:=/dev/video2 calibration:=camera.yaml
    ros2 launch hmt_ros camera.launch.py --show-args

What else hmt.launch.py takes can be given, too, but for image and nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from hmt_ros.detectors.blazepose_models import has_networks, has_runtime

PACKAGE = 'hmt_ros'
CAMERA = 'camera'
WITH_DETECTOR = 'filter_node smoother_node keypoints_node'
WITHOUT_DETECTOR = 'filter_node smoother_node bme_node'

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
    (
        'detector',
        'auto',
        "'true': keypoints of MediaPipe; 'false': none, silhouettes start the track, which needs "
        "background_file or an empty scene at first; 'auto': where MediaPipe Pose is installed",
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
    return actions_of(given, Path(get_package_share_directory(PACKAGE)))


def actions_of(given: Mapping[str, str], share: Path) -> list[Any]:
    """The camera, and what hmt.launch.py starts.

    Args:
        given: all arguments, by name.
        share: folder with launch/.

    Raises:
        ValueError: an argument that can not be used.
    """
    if given['fov'] and given['calibration']:
        raise ValueError('fov and calibration: wanted one of them, saw both')
    options = [given['device'] or given['video']]
    for name in ('fov', 'calibration'):
        if given[name]:
            options += [f'--{name}', given[name]]
    camera = Node(
        package=PACKAGE,
        executable='camera_node',
        namespace=CAMERA,
        arguments=options,
        output='both',
    )
    nodes = WITH_DETECTOR if _has_detector(given['detector']) else WITHOUT_DETECTOR
    person = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / 'launch' / 'hmt.launch.py')),
        launch_arguments={'image': f'/{CAMERA}/image_raw', 'nodes': nodes}.items(),
    )
    return [camera, person]


def _has_detector(wanted: str) -> bool:
    if wanted not in ('auto', 'true', 'false'):
        raise ValueError(f"detector: wanted 'auto', 'true' or 'false', saw {wanted!r}")
    if wanted != 'auto':
        return wanted == 'true'
    return has_runtime() and has_networks()
