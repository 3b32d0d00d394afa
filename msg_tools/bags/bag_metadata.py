"""The `metadata.yaml` of a rosbag2 bag, names of topics, and `BagError`."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from msg_tools.files.error_line import error_line, one_line
from msg_tools.files.plain_yaml import read_plain_yaml

FILE_NAME = 'metadata.yaml'
# Suffixes of the data files of a bag.
SUFFIXES = ('.mcap', '.mcap.zstd', '.db3', '.db3.zstd')
VERSION = 9
MAX_BYTES = 2**19

# Infinite duration in the notation of rmw: no deadline and no lifespan.
_INFINITE_DURATION = {'sec': 9223372036, 'nsec': 854775807}


class BagError(ValueError):
    """A bag can not be read or written; the message, one line, names fault and remedy."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


def reason(error: BaseException) -> str:
    """Message of a library's exception, as one line of at most 160 characters."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return error_line(error, 160)


def absolute_name(topic: str, namespace: str = '') -> str:
    """Absolute name of a topic, as in rosbag2 files: with its namespace and a leading slash.

    Args:
        topic: name; a relative name is in the namespace, an absolute name stays unchanged.
        namespace: '/humans/bodies/p1' for example; '' for the root.
    """
    if topic.startswith('/'):
        return topic
    inside = namespace.strip('/')
    return f'/{inside}/{topic}' if inside else f'/{topic}'


def read_file_names(folder: Path) -> list[str]:
    """Names of the files of a bag, in order.

    Raises:
        BagError: the metadata file is missing, or does not describe a bag.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        raise BagError(
            f'{folder} is no bag: it has no {FILE_NAME}; give the .mcap file itself, or write '
            'the metadata again with `ros2 bag reindex`'
        )
    try:
        document = read_plain_yaml(path, MAX_BYTES)
    except ValueError as error:
        raise BagError(f'{path}: {reason(error)}') from error
    try:
        names = document['rosbag2_bagfile_information']['relative_file_paths']
    except (TypeError, LookupError):
        names = None
    if not names or not isinstance(names, list) or not all(isinstance(x, str) for x in names):
        raise BagError(f'{path} names no files of a bag; `ros2 bag reindex` writes it again')
    # The first versions of rosbag2 wrote paths relative to the parent of the folder.
    names = [PurePosixPath(name).name for name in names]
    if len(set(names)) < len(names):
        raise BagError(f'{path} names a file twice')
    return names


def quality_of_service(latched: bool) -> list[dict[str, Any]]:
    """QoS offered for a topic: reliable, and transient local if the topic is latched."""
    return [
        {
            'history': 'keep_last',
            'depth': 1 if latched else 10,
            'reliability': 'reliable',
            'durability': 'transient_local' if latched else 'volatile',
            'deadline': dict(_INFINITE_DURATION),
            'lifespan': dict(_INFINITE_DURATION),
            'liveliness': 'automatic',
            'liveliness_lease_duration': dict(_INFINITE_DURATION),
            'avoid_ros_namespace_conventions': False,
        }
    ]


def as_yaml(document: Any) -> str:
    """YAML text of a document; equal documents give equal text."""
    text: str = yaml.safe_dump(document, sort_keys=False, default_flow_style=False, width=2**31)
    return text
