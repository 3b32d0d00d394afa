"""person_node: filter, smoother, experts and a detector in one process.

The nodes have the same names, parameters, topics, services and messages as in separate processes.
One thread calls detector, experts and filter, in the order in which they use each other's results,
and another calls the smoother when no image waits (`hmt_ros.nodes.estimating_thread`). Images are
received once, and the libraries are loaded once. Names on the command line select the nodes; by
default they use each other's results.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from hmt_ros.nodes.bme_node import BmeNode
from hmt_ros.nodes.filter_node import FilterNode
from hmt_ros.nodes.keypoints_node import KeypointsNode
from hmt_ros.nodes.run_node import run_together, wants_help
from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.nodes.smoother_node import SmootherNode

NAME = 'person_node'
NODES: Mapping[str, type[SessionNode[Any, Any]]] = {
    node.NAME: node for node in (FilterNode, SmootherNode, BmeNode, KeypointsNode)
}
# Nodes in the order in which they take turns.
_TURN_ORDER = (KeypointsNode.NAME, BmeNode.NAME, FilterNode.NAME, SmootherNode.NAME)
USUAL_NODES = (FilterNode.NAME, SmootherNode.NAME, BmeNode.NAME)
# Interval between two predictions while the filter tracks the person, s.
TRACKED_INTERVAL = 0.2
_RENAMING_RULES = ('__node:=', '__name:=')
_USAGE = f"""usage: ros2 run hmt_ros {NAME} [NODE ...] [--ros-args ...]

Filter, smoother, experts and a detector in one process.

Each NODE is one of {', '.join(NODES)};
by default these run: {', '.join(USUAL_NODES)}. Their names, parameters, topics and
services are the same as in separate processes: see "ros2 run hmt_ros NODE --help".
The filter uses the predictions of bme_node, and the keypoints of a detector, if these run.
"""


def used_of_each_other(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Parameter values, by node, that make nodes in one process use each other's results."""
    values: dict[str, dict[str, Any]] = {name: {} for name in names}
    if FilterNode.NAME in names:
        used = {
            'use_predictions': BmeNode.NAME in names,
            'use_keypoints': KeypointsNode.NAME in names,
            'use_keypoints_3d': KeypointsNode.NAME in names,
        }
        values[FilterNode.NAME] = {name: use for name, use in used.items() if use}
        if BmeNode.NAME in names:
            # While the person is tracked, the filter needs more processor time.
            values[BmeNode.NAME] = {'tracked_interval': TRACKED_INTERVAL}
    return values


def nodes_together(names: Sequence[str], **options: Any) -> list[SessionNode[Any, Any]]:
    """Nodes that share threads and messages, in the order of their turns.

    Args:
        options: keyword arguments of all nodes, see `SessionNode`.
    """
    values = used_of_each_other(names)
    nodes: list[SessionNode[Any, Any]] = []
    for name in sorted(names, key=_TURN_ORDER.index):
        defaults = replace(NODES[name].DEFAULTS, **values[name])
        nodes.append(NODES[name](defaults, nodes[0] if nodes else None, **options))
    return nodes


def main(args: list[str] | None = None) -> int:
    """Runs the nodes until a signal; returns 0, 1 if a node can not start, 2 on wrong arguments."""
    arguments = sys.argv[1:] if args is None else args
    if wants_help(arguments):
        sys.stdout.write(_USAGE)
        return 0
    own = arguments[: arguments.index('--ros-args')] if '--ros-args' in arguments else arguments
    names = tuple(dict.fromkeys(own)) or USUAL_NODES
    unknown = [name for name in names if name not in NODES]
    if unknown:
        sys.stderr.write(f'{NAME}: wanted some of {", ".join(NODES)}, saw {unknown[0]!r}\n')
        return 2
    renamed = [word for word in arguments if word.startswith(_RENAMING_RULES)]
    if renamed:
        sys.stderr.write(
            f'{NAME}: {renamed[0]} would give all nodes one name; wanted none, or '
            f'{names[0]}:{renamed[0]} for one of them\n'
        )
        return 2
    return run_together(NAME, lambda: nodes_together(names), arguments)


if __name__ == '__main__':
    sys.exit(main())
