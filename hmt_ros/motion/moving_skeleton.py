"""A motion of a body as nodes that carry each other, and as BVH and glTF for other programs.

A node is a joint at which a segment starts, or a joint at the end of one. Unturned nodes, which all
have the axes of the room, make up the pose of zeros: upright, facing +z, y up. With G the rotation
of a segment and A the change of axes, a node that carries a segment is turned in the room by

    B(t) = A G(t) (A_rest G(rest))'        and in its parent by        B_parent(t)' B(t)
"""

from __future__ import annotations

import base64
import json
import struct
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.inference.arrays import Array

# From the optical frame of a level camera, y down and z forward, to y up and z to the camera.
CAMERA_TO_ROOM = np.diag([1.0, -1.0, -1.0])
MOST_FRAMES = 1_000_000
# A bone of the picture: where it is thickest, and how thick it is there, over its length.
_BULGE, _THICKNESS = 0.15, 0.08
_FACES = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [5, 1, 2], [5, 2, 3], [5, 3, 4], [5, 4, 1]]
_FLOAT, _BYTE, _SHORT = 5126, 5121, 5123  # types of numbers in glTF


@dataclass(frozen=True, eq=False)
class MovingSkeleton:
    """N nodes at T times; y up, m.

    Attributes:
        times: (T,) s, increasing.
        names, parents: (N,) name and parent of each node, which stands before it; -1: the root.
        offsets: (N, 3) from the parent, in its axes; of the root 0.
        rotations: (T, N, 3, 3) from the axes of the node to those of its parent.
        places: (T, 3) of the root.
    """

    times: Array
    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Array
    rotations: Array
    places: Array

    @staticmethod
    def of_body(
        body: Body, poses: Array, times: Array, room: Array = CAMERA_TO_ROOM, height: float = 0.0
    ) -> MovingSkeleton:
        """The motion of a body at its present lengths.

        Args:
            body: whose root alone moves along axes.
            poses: (T, d).
            times: (T,) s, increasing.
            room: (3, 3) rotation from the frame of the camera to axes with y up.
            height: of the camera in the room, m.

        Raises:
            ValueError: another segment moves along axes, or there are several roots.
        """
        skeleton = body.skeleton
        moved = skeleton.dof_segments[~skeleton.dof_is_rotation]
        if moved.any() or skeleton.parents.count(-1) != 1:
            raise ValueError(f'{body.name}: wanted one root, which alone moves along axes')
        frames, rest = forward(skeleton, poses), forward(skeleton, np.zeros((1, body.dimension)))
        upright = CAMERA_TO_ROOM @ rest.rotations()[0]
        turned = room @ frames.rotations() @ upright.transpose(0, 2, 1)
        carried = list(skeleton.parents)
        offsets = [upright[p] @ x for p, x in zip(carried, skeleton.offsets, strict=True)]
        offsets[0] = np.zeros(3)
        names, tips = list(skeleton.segment_names), []
        for j, s in enumerate(skeleton.joint_segments):
            if np.any(skeleton.joint_offsets[j]):
                tips.append(skeleton.joint_names[j])
                carried.append(int(s))
                offsets.append(upright[s] @ skeleton.joint_offsets[j])
            else:
                names[s] = skeleton.joint_names[j]
        local = np.tile(np.eye(3), (len(poses), len(carried), 1, 1))
        local[:, 0] = turned[:, 0]
        parents = list(skeleton.parents[1:])
        local[:, 1 : len(names)] = turned[:, parents].swapaxes(-1, -2) @ turned[:, 1:]
        names = [f'{name}_segment' if name in tips else name for name in names]
        places = frames.by_pose()[1][:, 0] @ room.T + [0.0, height, 0.0]
        return MovingSkeleton(
            np.asarray(times), (*names, *tips), tuple(carried), np.array(offsets), local, places
        )

    def at_rate(self, rate: float) -> MovingSkeleton:
        """The same at even times, `rate` a second; between its times motions are interpolated.

        Raises:
            ValueError: too many times.
        """
        count = 1 + int((self.times[-1] - self.times[0]) * rate + 0.01)
        if count > MOST_FRAMES:
            raise ValueError(f'{count} frames, wanted {MOST_FRAMES} at most: a lower --fps')
        times = self.times[0] + np.arange(count) / rate
        inside = np.minimum(times, self.times[-1])
        rotations, places = self.rotations[[0] * count], self.places[[0] * count]
        if len(self.times) > 1:
            for n in range(len(self.names)):
                between = Slerp(self.times, Rotation.from_matrix(self.rotations[:, n]))
                rotations[:, n] = between(inside).as_matrix()
            columns = [np.interp(inside, self.times, column) for column in self.places.T]
            places = np.stack(columns, axis=-1)
        return replace(self, times=times, rotations=rotations, places=places)


def bvh_text(moving: MovingSkeleton, rate: float) -> str:
    """BVH of a skeleton at even times, m and degrees; the same text for the same motion."""
    lines, order = ['HIERARCHY'], []

    def add(node: int, indent: str) -> None:
        order.append(node)
        children = [child for child, parent in enumerate(moving.parents) if parent == node]
        lines.append(f'{indent}{"JOINT" if indent else "ROOT"} {moving.names[node]}')
        shifts = '' if indent else 'Xposition Yposition Zposition '
        lines.append(f'{indent}{{')
        lines.append(f'{indent}  OFFSET {_text(moving.offsets[node])}')
        lines.append(
            f'{indent}  CHANNELS {3 if indent else 6} {shifts}Zrotation Xrotation Yrotation'
        )
        for child in children:
            add(child, indent + '  ')
        if not children:
            end = 0.25 * moving.offsets[node]
            lines.extend([f'{indent}  End Site', f'{indent}  {{'])
            lines.extend([f'{indent}    OFFSET {_text(end)}', f'{indent}  }}'])
        lines.append(f'{indent}}}')

    add(0, '')
    angles = _angles(moving.rotations[:, order])
    rows = np.concatenate([moving.places, angles.reshape(len(angles), -1)], axis=1)
    lines += ['MOTION', f'Frames: {len(rows)}', f'Frame Time: {1.0 / rate:.9f}']
    return '\n'.join([*lines, *(_text(row) for row in rows), ''])


def _text(values: Array) -> str:
    # A zero may have a sign, which would be seen.
    return ' '.join(f'{x:.6f}' for x in np.round(values, 6) + 0.0)


def _angles(rotations: Array) -> Array:
    """Angles (T, N, 3) about z, x and y of rotations (T, N, 3, 3), degrees, without needless jumps.

    Of the two triples for a rotation, and of their whole turns, those that are nearest to the ones
    of the time before: programs interpolate angle by angle.
    """
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # at 90 degrees about x, where one angle is free
        flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_euler('ZXY', degrees=True)
    angles: Array = flat.reshape(*rotations.shape[:2], 3)
    for t in range(1, len(angles)):
        other = angles[t] * [1, -1, 1] + 180.0
        both = np.stack([angles[t], other])
        both += 360.0 * np.round((angles[t - 1] - both) / 360.0)
        farther = np.abs(both - angles[t - 1]).sum(axis=-1)
        angles[t] = np.where((farther[1] < farther[0])[:, None], both[1], both[0])
    return angles


def gltf_bytes(moving: MovingSkeleton, *, binary: bool) -> bytes:
    """glTF 2.0 of a skeleton that moves, with a bone from each node to the next to look at.

    Args:
        moving: the motion; its times stay as they are, from 0 on.
        binary: whether it is one binary file, .glb, instead of .gltf.
    """
    data, views, accessors = bytearray(), [], []

    def add(values: NDArray[Any], kind: str, number: int, **more: Any) -> int:
        views.append({'buffer': 0, 'byteOffset': len(data), 'byteLength': values.nbytes})
        data.extend(values.tobytes())
        described = {'bufferView': len(views) - 1, 'componentType': number, 'type': kind}
        accessors.append({**described, 'count': len(values), **more})
        return len(accessors) - 1

    def floats(values: Array, kind: str) -> int:
        stored = np.ascontiguousarray(values, dtype='<f4')
        ends = stored.reshape(len(stored), -1)
        return add(
            stored, kind, _FLOAT, min=ends.min(axis=0).tolist(), max=ends.max(axis=0).tolist()
        )

    nodes: list[dict[str, Any]] = [
        {'name': name, 'translation': offset.tolist()}
        for name, offset in zip(moving.names, moving.offsets, strict=True)
    ]
    for node, parent in enumerate(moving.parents[1:], 1):
        nodes[parent].setdefault('children', []).append(node)
    nodes.append({'name': 'body', 'mesh': 0, 'skin': 0})
    times = floats(moving.times - moving.times[0], 'SCALAR')
    outputs = [(0, 'translation', floats(moving.places, 'VEC3'))]
    for node in sorted(set(moving.parents) - {-1}):
        turns = Rotation.from_matrix(moving.rotations[:, node]).as_quat()
        back = np.sum(turns[1:] * turns[:-1], axis=1) < 0
        turns[1:] *= np.where(np.cumsum(back) % 2, -1.0, 1.0)[:, None]
        outputs.append((node, 'rotation', floats(turns, 'VEC4')))
    bind, points, bones, faces = _bones(moving)
    joints = np.zeros((len(bones), 4), dtype='u1')
    joints[:, 0] = bones
    attributes = {
        'POSITION': floats(points, 'VEC3'),
        'JOINTS_0': add(joints, 'VEC4', _BYTE),
        'WEIGHTS_0': floats(np.tile([1.0, 0.0, 0.0, 0.0], (len(bones), 1)), 'VEC4'),
    }
    indices = add(faces.astype('<u2').reshape(-1), 'SCALAR', _SHORT)
    content = {
        'asset': {'version': '2.0', 'generator': 'hmt_ros'},
        'scene': 0,
        'scenes': [{'nodes': [0, len(nodes) - 1]}],
        'nodes': nodes,
        'meshes': [{'primitives': [{'attributes': attributes, 'indices': indices}]}],
        'skins': [
            {
                'joints': list(range(len(moving.names))),
                'inverseBindMatrices': floats(bind, 'MAT4'),
                'skeleton': 0,
            }
        ],
        'animations': [
            {
                'name': 'motion',
                'samplers': [{'input': times, 'output': output} for _, _, output in outputs],
                'channels': [
                    {'sampler': i, 'target': {'node': node, 'path': path}}
                    for i, (node, path, _) in enumerate(outputs)
                ],
            }
        ],
        'accessors': accessors,
        'bufferViews': views,
        'buffers': [{'byteLength': len(data)}],
    }
    if not binary:
        text = base64.b64encode(data).decode('ascii')
        content['buffers'] = [
            {'byteLength': len(data), 'uri': f'data:application/octet-stream;base64,{text}'}
        ]
        return json.dumps(content, indent=1).encode('utf-8')
    head = json.dumps(content, separators=(',', ':')).encode('utf-8')
    head += b' ' * (-len(head) % 4)
    size = 28 + len(head) + len(data)
    parts = struct.pack('<4sIII4s', b'glTF', 2, size, len(head), b'JSON'), head
    return b''.join([*parts, struct.pack('<I4s', len(data), b'BIN\0'), data])


def _bones(moving: MovingSkeleton) -> tuple[Array, Array, NDArray[np.intp], NDArray[np.intp]]:
    """Double pyramids from nodes to those that they carry, at rest.

    Returns:
        Matrices (N, 16) from the room to each node, by columns; points (P, 3); the node (P,) that
        carries each; corners (F, 3) of triangles.
    """
    places = np.zeros((len(moving.names), 3))
    points: list[Array] = []
    nodes: list[int] = []
    faces: list[NDArray[np.intp]] = []
    for node, parent in enumerate(moving.parents[1:], 1):
        along = moving.offsets[node]
        start = places[parent]
        places[node] = start + along
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            continue
        side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        side *= _THICKNESS * length / np.linalg.norm(side)
        other = np.cross(along, side) / length
        middle = start + _BULGE * along
        ring = [middle + x for x in (side, other, -side, -other)]
        faces.append(np.array(_FACES) + len(points))
        points += [start, *ring, places[node]]
        nodes += [parent] * 6
    bind = np.tile(np.eye(4), (len(places), 1, 1))
    bind[:, 3, :3] = -places
    return bind.reshape(-1, 16), np.array(points), np.array(nodes), np.concatenate(faces)
