"""keypoints_adapter_node: messages of other detectors in, keypoints of one person out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from hmt_ros.nodes.run_node import run
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.subscribed_topic import CAMERA_INFO_TOPIC, SubscribedTopic, message_class
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.keypoints_adapter_parameters import SOURCES, KeypointsAdapterParameters
from hmt_ros.sessions.keypoints_adapter_session import DETECTIONS, KeypointsAdapterSession
from hmt_ros.sessions.session import everything
from msg_tools.messages.message_types import register_definitions


class InstalledAdapterSession(KeypointsAdapterSession):
    """An adapter of messages whose package is installed; see `KeypointsAdapterSession`.

    Raises:
        ValueError: the package of `source` is not installed.
    """

    def __init__(
        self,
        parameters: KeypointsAdapterParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        make_readable(parameters.source, SOURCES[parameters.source])
        super().__init__(parameters, publish, wanted)


def make_readable(source: str, msgtype: str) -> None:
    """Reads the definitions of the messages of a source, as they are installed.

    Args:
        source: value of the parameter, for messages.
        msgtype: for example 'yolo_msgs/msg/DetectionArray'.

    Raises:
        ValueError: their package is not installed.
    """
    package = msgtype.partition('/')[0]
    try:
        message_class(msgtype)
        folder = Path(get_package_share_directory(package)) / 'msg'
    except (ImportError, AttributeError, PackageNotFoundError) as error:
        raise ValueError(
            f'source {source} needs {msgtype.replace("/msg/", "/")}, but the package {package} is '
            'not installed: install it, or build and source its workspace'
        ) from error
    register_definitions(package, folder)


class KeypointsAdapterNode(SessionNode[KeypointsAdapterSession, KeypointsAdapterParameters]):
    """The node; its parameters are the fields of `KeypointsAdapterParameters`."""

    NAME = 'keypoints_adapter_node'
    SUBJECT = 'adapter'
    SESSION = InstalledAdapterSession
    DEFAULTS = KeypointsAdapterParameters()

    def _offered_services(self) -> Iterable[tuple[type, str, Callable[..., Any]]]:
        return ()

    def _wanted_inputs(self) -> Iterable[SubscribedTopic]:
        yield CAMERA_INFO_TOPIC
        yield SubscribedTopic(DETECTIONS, DETECTIONS, SOURCES[self._settings.source])


def main(args: list[str] | None = None) -> int:
    """Runs the node until a signal stops it; returns 0, or 1 if it could not start."""
    return run(KeypointsAdapterNode, args)


if __name__ == '__main__':
    sys.exit(main())
