"""visualization_msgs/MarkerArray: the modes of a mixture as skeletons, the lighter the fainter.

A mode of rank k (0: the heaviest) has the namespace `mode_k` with two markers, 0 the bones and 1
the joints. So a viewer replaces the markers of the last time, and ranks that are not used any more
are deleted: every array speaks about all ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msg_tools.headers import header_message
from msg_tools.message_error import MessageError
from msg_tools.message_factory import MessageFactory

_ADD, _DELETE = 0, 2
_LINE_LIST, _SPHERE_LIST = 5, 7
_BONES, _JOINTS = 0, 1

# The heaviest mode is orange, the others are blue: both are told apart by colour-blind people.
_FIRST = (0.90, 0.45, 0.05)
_OTHERS = (0.10, 0.45, 0.80)
_FAINTEST = 0.12


def skeleton_markers(
    messages: MessageFactory,
    joint_positions: ArrayLike,
    joint_names: Sequence[str],
    edges: Sequence[tuple[str, str]],
    weights: ArrayLike,
    stamp_ns: int,
    frame_id: str,
    *,
    ranks: int,
    namespace: str = 'mode',
    bone_width: float = 0.02,
    joint_diameter: float = 0.05,
) -> Any:
    """visualization_msgs/MarkerArray of K modes.

    Args:
        messages: factory of messages.
        joint_positions: (K, J, 3) m.
        joint_names: (J,).
        edges: bones, as the names of the joints that they join.
        weights: (K,) of the modes, in any order.
        stamp_ns, frame_id: of the header.
        ranks: most modes that ever are shown; the lightest beyond are left out.
        namespace: first part of the namespaces.
        bone_width, joint_diameter: m.

    Raises:
        MessageError: arrays whose lengths contradict each other, an edge of an unknown joint.
    """
    positions = np.asarray(joint_positions, dtype=np.float64)
    heavy = np.asarray(weights, dtype=np.float64)
    if positions.shape != (len(heavy), len(joint_names), 3):
        raise MessageError(
            f'markers: joint_positions has shape {positions.shape}, wanted '
            f'({len(heavy)}, {len(joint_names)}, 3)'
        )
    index = {name: i for i, name in enumerate(joint_names)}
    for edge in edges:
        for name in edge:
            if name not in index:
                raise MessageError(f'markers: edge {edge} has the unknown joint {name!r}')
    ends = [index[name] for edge in edges for name in edge]
    order = np.argsort(-heavy, kind='stable')[:ranks]
    header = header_message(messages, stamp_ns, frame_id)

    def marker(rank: int, key: int, **fields: Any) -> Any:
        return messages.create(
            'visualization_msgs/msg/Marker',
            header=header,
            ns=f'{namespace}_{rank}',
            id=key,
            # Viewers complain about an orientation of zero length.
            pose=messages.create('geometry_msgs/msg/Pose'),
            **fields,
        )

    markers = []
    for rank, mode in enumerate(order):
        points = [
            messages.create('geometry_msgs/msg/Point', x=x, y=y, z=z)
            for x, y, z in positions[mode].tolist()
        ]
        red, green, blue = _OTHERS if rank else _FIRST
        share = float(heavy[mode] / heavy[order[0]]) if heavy[order[0]] > 0 else 1.0
        color = messages.create(
            'std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=_FAINTEST + (1 - _FAINTEST) * share
        )
        markers.append(
            marker(
                rank,
                _BONES,
                type=_LINE_LIST,
                action=_ADD,
                scale=messages.create('geometry_msgs/msg/Vector3', x=bone_width),
                color=color,
                points=[points[i] for i in ends],
            )
        )
        markers.append(
            marker(
                rank,
                _JOINTS,
                type=_SPHERE_LIST,
                action=_ADD,
                scale=messages.create(
                    'geometry_msgs/msg/Vector3',
                    x=joint_diameter,
                    y=joint_diameter,
                    z=joint_diameter,
                ),
                color=color,
                points=points,
            )
        )
    for rank in range(len(order), ranks):
        markers.extend(marker(rank, key, action=_DELETE) for key in (_BONES, _JOINTS))
    return messages.create('visualization_msgs/msg/MarkerArray', markers=markers)
