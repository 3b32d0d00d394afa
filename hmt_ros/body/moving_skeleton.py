"""Motion of a body as a tree of rotating nodes, and its export as BVH.

A node is a joint at the start or the end of a segment. In the zero pose all nodes have the axes of
the room: the person stands upright and faces +z, with y up. With G the rotation
of a segment and A the change of axes, a node that carries a segment is turned in the room by

    B(t) = A G(t) (A_rest G(rest))'        and in its parent by        B_parent(t)' B(t)
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product

# From the optical frame of a level camera, y down and z forward, to y up and z towards the camera.
CAMERA_TO_ROOM = np.diag([1.0, -1.0, -1.0])
MAX_FRAMES = 1_000_000


@dataclass(frozen=True, eq=False)
class MovingSkeleton:
    """N nodes at T times; y up, m.

    Attributes:
        times: (T,) s, increasing.
        names, parents: (N,) name of each node and index of its parent, -1 for the root; parents
            come before their children.
        offsets: (N, 3) offset from the parent, in the parent's axes, m; 0 for the root.
        rotations: (T, N, 3, 3) from the axes of the node to the axes of its parent.
        places: (T, 3) positions of the root, m.
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
            body: body with translations at the root only.
            poses: (T, d) poses of the body.
            times: (T,) s, increasing.
            room: (3, 3) rotation from the frame of the camera to axes with y up.
            height: height of the camera in the room, m.

        Raises:
            ValueError: a segment other than the root has translations, or there are several roots.
        """
        skeleton = body.skeleton
        moved = skeleton.dof_segments[~skeleton.dof_is_rotation]
        if moved.any() or skeleton.parents.count(-1) != 1:
            raise ValueError(f'{body.name}: wanted one root, which alone moves along axes')
        frames, rest = forward(skeleton, poses), forward(skeleton, np.zeros((1, body.dimension)))
        upright = product(CAMERA_TO_ROOM, rest.rotations()[0])
        turned = product(product(room, frames.rotations()), upright.transpose(0, 2, 1))
        carried = list(skeleton.parents)
        offsets = [product(upright[p], x) for p, x in zip(carried, skeleton.offsets, strict=True)]
        offsets[0] = np.zeros(3)
        names, tips = list(skeleton.segment_names), []
        for j, s in enumerate(skeleton.joint_segments):
            if np.any(skeleton.joint_offsets[j]):
                tips.append(skeleton.joint_names[j])
                carried.append(int(s))
                offsets.append(product(upright[s], skeleton.joint_offsets[j]))
            else:
                names[s] = skeleton.joint_names[j]
        local = np.tile(np.eye(3), (len(poses), len(carried), 1, 1))
        local[:, 0] = turned[:, 0]
        parents = list(skeleton.parents[1:])
        local[:, 1 : len(names)] = product(turned[:, parents].swapaxes(-1, -2), turned[:, 1:])
        names = [f'{name}_segment' if name in tips else name for name in names]
        places = product(frames.by_pose()[1][:, 0], room.T) + np.array([0.0, height, 0.0])
        return MovingSkeleton(
            np.asarray(times), (*names, *tips), tuple(carried), np.array(offsets), local, places
        )

    def at_rate(self, rate: float) -> MovingSkeleton:
        """Resample the motion by interpolation to regular times, `rate` per second.

        Raises:
            ValueError: the result would have too many times.
        """
        count = 1 + int((self.times[-1] - self.times[0]) * rate + 0.01)
        if count > MAX_FRAMES:
            raise ValueError(f'{count} frames, wanted {MAX_FRAMES} at most: a lower --fps')
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
    """BVH text of a motion at regular times, m and degrees; equal motions give equal texts."""
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
    # Remove the sign of negative zeros in the text.
    return ' '.join(f'{x:.6f}' for x in np.round(values, 6) + 0.0)


def _angles(rotations: Array) -> Array:
    """Angles (T, N, 3) about z, x and y of rotations (T, N, 3, 3), degrees, without needless jumps.

    Two triples of angles give the same rotation, and whole turns can be added to both. The result
    is the triple nearest to the angles at the previous time, because programs interpolate each
    angle separately.
    """
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # at 90 degrees about x, one angle is free
        flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_euler('ZXY', degrees=True)
    angles: Array = flat.reshape(*rotations.shape[:2], 3)
    for t in range(1, len(angles)):
        other = angles[t] * [1, -1, 1] + 180.0
        both = np.stack([angles[t], other])
        both += 360.0 * np.round((angles[t - 1] - both) / 360.0)
        farther = np.abs(both - angles[t - 1]).sum(axis=-1)
        angles[t] = np.where((farther[1] < farther[0])[:, None], both[1], both[0])
    return angles
