"""`metadata.yaml`, which makes a folder a bag of rosbag2: reads and writes it."""

from __future__ import annotations

from enum import Enum
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability

from msg_tools.bags.contents import BagError, reason
from msg_tools.files.bounded_file import read_bytes

FILE_NAME = 'metadata.yaml'
# Suffixes of the other files of a bag.
MCAP_SUFFIXES = ('.mcap', '.mcap.zstd')
DATABASE_SUFFIXES = ('.db3', '.db3.zstd')
SUFFIXES = (*MCAP_SUFFIXES, *DATABASE_SUFFIXES)
VERSION = 9
MAX_BYTES = 2**24

# No deadline, no lifespan: rmw writes this for an infinite duration.
_INFINITE = {'sec': 9223372036, 'nsec': 854775807}

_POLICIES: dict[str, type[Enum]] = {
    'history': QosHistory,
    'reliability': QosReliability,
    'durability': QosDurability,
    'liveliness': QosLiveliness,
}


def read_file_names(folder: Path) -> list[str]:
    """Names of the files of a bag, in order.

    Raises:
        BagError: no metadata, or not that of a bag.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        raise BagError(
            f'{folder} is no bag: it has no {FILE_NAME}; give the .mcap file itself, or write '
            'the metadata anew with `ros2 bag reindex`'
        )
    try:
        content = read_bytes(path, MAX_BYTES)
    except ValueError as error:
        raise BagError(f'{path}: {error}') from error
    try:
        document = yaml.safe_load(content.decode('utf-8'))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BagError(f'{path} is not YAML: {reason(error)}') from error
    information = None
    if isinstance(document, dict):
        information = document.get('rosbag2_bagfile_information')
    if not isinstance(information, dict):
        raise BagError(f'{path} has no rosbag2_bagfile_information: it is not that of a bag')
    names = information.get('relative_file_paths')
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BagError(f'{path} has no list relative_file_paths; `ros2 bag reindex` writes it anew')
    if not names:
        raise BagError(f'{path} names no file: the bag is empty')
    # The first versions wrote the paths relative to the parent of the folder.
    return [PurePosixPath(name).name for name in names]


def quality_of_service(latched: bool) -> list[dict[str, Any]]:
    """Offered QoS of a topic: reliable, all kept; latched topics are for late joiners too."""
    return [
        {
            'history': 'keep_last',
            'depth': 1 if latched else 10,
            'reliability': 'reliable',
            'durability': 'transient_local' if latched else 'volatile',
            'deadline': dict(_INFINITE),
            'lifespan': dict(_INFINITE),
            'liveliness': 'automatic',
            'liveliness_lease_duration': dict(_INFINITE),
            'avoid_ros_namespace_conventions': False,
        }
    ]


def recorded_quality_of_service(text: str) -> list[dict[str, Any]]:
    """Offered QoS as a bag of any version has it, with the names that the present version wants.

    Args:
        text: YAML, with numbers in bags of ROS 2 Iron and before.

    Returns:
        An empty list if the text can not be understood: players then offer the usual QoS.
    """
    try:
        profiles = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return []
    if not isinstance(profiles, list) or not all(isinstance(x, dict) for x in profiles):
        return []
    found = []
    for recorded in profiles:
        profile = dict(quality_of_service(False)[0])
        for name, usual in profile.items():
            value = recorded.get(name, usual)
            if name in _POLICIES and isinstance(value, int):
                numbers = {policy.value: policy.name.lower() for policy in _POLICIES[name]}
                value = numbers.get(value, 'unknown')
            if isinstance(value, type(usual)):
                profile[name] = value
        found.append(profile)
    return found


def as_yaml(document: Any) -> str:
    """YAML text, the same for the same document."""
    text: str = yaml.dump(
        document, Dumper=_PlainDumper, sort_keys=False, default_flow_style=False, width=2**31
    )
    return text


class _PlainDumper(yaml.SafeDumper):
    """Writes a value out wherever it occurs, without anchors."""

    def ignore_aliases(self, data: object) -> bool:
        return True
