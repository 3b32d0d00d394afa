"""A body as a URDF, so that any viewer of ROS shows it and moves it by joint states.

URDF knows joints of one degree of freedom only, so a segment with several becomes a chain of links,
of which the last bears the name of the segment. The joints are named as the degrees of freedom.
Seen from its parent a segment is

    Trans(offset + translations) * mount * Rot(axis_1, q_1) * ... * Rot(axis_n, q_n)

as in `hmt_ros.body.skeleton`. Links have no inertia: the URDF is for looking at. `link_frames`
gives the frames of all links, also of those within a chain: viewers complain of links without one.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.kinematics import Frames
from hmt_ros.body.skeleton import Skeleton
from msg_tools.messages.message_error import MessageError

Array = NDArray[np.float64]

# URDF wants limits with every joint that has a range; these stand for none.
_UNLIMITED = 1000.0
_LETTERS: tuple[Literal['x', 'y', 'z'], ...] = ('x', 'y', 'z')
_AXES = {'x': '1 0 0', 'y': '0 1 0', 'z': '0 0 1'}


@dataclass(frozen=True)
class Freedom:
    """A degree of freedom of a segment.

    Attributes:
        name: of the joint.
        axis: of the parent's frame for a translation, of the segment's moving frame for a rotation.
        kind: 'revolute' or 'prismatic'.
        lower, upper: rad or m; infinite where there is none.
    """

    name: str
    axis: Literal['x', 'y', 'z']
    kind: Literal['revolute', 'prismatic']
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Segment:
    """A rigid part of the body.

    Attributes:
        name: of the link.
        parent: index of the parent, which stands before the segment; -1: the root link.
        offset: (3,) of the origin in the frame of the parent, m.
        mount: (3, 3) rotation from the segment's frame at rest to its parent's.
        freedoms: translations first, then rotations, in the order in which they act.
        points: (P, 3) m, where a viewer shows the segment as rods from its origin.
    """

    name: str
    parent: int
    offset: ArrayLike
    mount: ArrayLike
    freedoms: Sequence[Freedom] = ()
    points: ArrayLike = ()


def segments_of(skeleton: Skeleton) -> list[Segment]:
    """The segments of a skeleton at its present lengths, shown as rods to their ends."""
    result = []
    for index, name in enumerate(skeleton.segment_names):
        freedoms = [
            Freedom(
                skeleton.dof_names[i],
                _LETTERS[int(skeleton.dof_axes[i])],
                'revolute' if skeleton.dof_is_rotation[i] else 'prismatic',
                float(skeleton.lower[i]),
                float(skeleton.upper[i]),
            )
            for i in skeleton.segment_dofs[index]
        ]
        children = [child for child, parent in enumerate(skeleton.parents) if parent == index]
        points = [
            *skeleton.offsets[children],
            *skeleton.joint_offsets[skeleton.joint_segments == index],
        ]
        result.append(
            Segment(
                name,
                skeleton.parents[index],
                skeleton.offsets[index],
                skeleton.mounts[index],
                freedoms,
                np.unique(np.reshape(points, (-1, 3)), axis=0),
            )
        )
    return result


def body_urdf(
    name: str,
    segments: Sequence[Segment],
    root_link: str,
    rod_radius: float = 0.025,
    link_prefix: str = '',
) -> str:
    """The URDF; the same text for the same body.

    Args:
        name: of the robot.
        segments: of the body, parents before their children.
        root_link: what the segments without parent hang on: the frame of the camera.
        rod_radius: of the rods that show a segment, m.
        link_prefix: stands before the names of all links but the root.

    Raises:
        MessageError: a parent that does not stand before its child, a translation after a rotation,
            a name that is there twice, a mount that is no rotation.
    """
    robot = ET.Element('robot', name=name)
    ET.SubElement(robot, 'link', name=root_link)
    joints: list[ET.Element] = []
    for index, segment in enumerate(segments):
        if not -1 <= segment.parent < index:
            raise MessageError(
                f'urdf: segment {segment.name} has parent {segment.parent}, wanted one before it'
            )
        parent = root_link
        if segment.parent != -1:
            parent = f'{link_prefix}{segments[segment.parent].name}'
        _add_segment(robot, joints, segment, parent, rod_radius, link_prefix)
    robot.extend(joints)
    for kind in ('link', 'joint'):
        seen: set[str] = set()
        for element in robot.iter(kind):
            if element.attrib['name'] in seen:
                raise MessageError(f'urdf: the {kind} {element.attrib["name"]!r} is there twice')
            seen.add(element.attrib['name'])
    ET.indent(robot)
    return ET.tostring(robot, encoding='unicode', xml_declaration=False) + '\n'


def _add_segment(
    robot: ET.Element,
    joints: list[ET.Element],
    segment: Segment,
    parent: str,
    rod_radius: float,
    link_prefix: str,
) -> None:
    offset = np.asarray(segment.offset, dtype=np.float64)
    mount = np.asarray(segment.mount, dtype=np.float64)
    if offset.shape != (3,) or mount.shape != (3, 3):
        raise MessageError(
            f'urdf: segment {segment.name} has offset {offset.shape} and mount {mount.shape}, '
            'wanted (3,) and (3, 3)'
        )
    if not np.allclose(mount @ mount.T, np.eye(3), atol=1e-6) or np.linalg.det(mount) < 0:
        raise MessageError(f'urdf: the mount of segment {segment.name} is no rotation')
    kinds = [freedom.kind for freedom in segment.freedoms]
    if kinds != sorted(kinds):
        raise MessageError(f'urdf: segment {segment.name} is translated after it is rotated')
    # The steps from the parent to the segment: the mount stands before the first rotation.
    steps: list[Freedom | None] = list(segment.freedoms)
    if 'revolute' not in kinds:
        steps.append(None)
    waiting_offset, waiting_mount = offset, mount
    for index, step in enumerate(steps):
        turns = step is None or step.kind == 'revolute'
        last = index == len(steps) - 1
        link = f'{link_prefix}{segment.name if last else _within(segment.name, step)}'
        joints.append(
            _joint(
                step, segment.name, parent, link, waiting_offset, waiting_mount if turns else None
            )
        )
        waiting_offset = np.zeros(3)
        if turns:
            waiting_mount = np.eye(3)
        element = ET.SubElement(robot, 'link', name=link)
        if last:
            for point in np.reshape(np.asarray(segment.points, dtype=np.float64), (-1, 3)):
                add_rod(element, point, rod_radius)
        parent = link


def _within(segment: str, step: Freedom | None) -> str:
    """Name of a link between a segment and its parent."""
    return f'{segment}.{step.name if step else "mount"}'


def link_frames(
    skeleton: Skeleton, frames: Frames, pose: ArrayLike, index: int = 0
) -> tuple[list[str], Array, Array]:
    """Where the links of `body_urdf` are, all but the root, which is the camera.

    Args:
        skeleton: of the body.
        frames: of its segments.
        pose: (d,) that they belong to.
        index: of the pose among those of the frames.

    Returns:
        Names of the links (L), as `body_urdf` gives them without a prefix; rotations (L, 3, 3) and
        origins (L, 3), m, in the frame of the camera.
    """
    q = np.asarray(pose, dtype=np.float64)
    turned = frames.rotations()[index]
    origins = np.ascontiguousarray(frames.origins[:, :, index])
    # What takes a rotation back: a turn by -q about its axis, which it does not move itself.
    back = _rotations(frames.axes[:, :, index], -q)
    names: list[str] = []
    rotations: list[Array] = []
    places: list[Array] = []
    for segment, name in enumerate(skeleton.segment_names):
        own = skeleton.segment_dofs[segment]
        chain = [(name, turned[segment], origins[segment])]
        # From the segment towards its parent; the links of its translations do not turn.
        rotation, place = turned[segment], origins[segment]
        parent = skeleton.parents[segment]
        unturned = np.eye(3) if parent == -1 else turned[parent]
        turns = any(skeleton.dof_is_rotation[i] for i in own)
        for position in reversed(range(len(own))):
            dof = own[position]
            if position == len(own) - 1 and turns:
                # The last rotation ends in the segment itself.
                rotation = back[dof] @ rotation
                continue
            link = f'{name}.{skeleton.dof_names[dof]}'
            if skeleton.dof_is_rotation[dof]:
                chain.append((link, rotation, place))
                rotation = back[dof] @ rotation
            else:
                chain.append((link, unturned, place))
                place = place - q[dof] * frames.axes[dof, :, index]
        for link, r, t in reversed(chain):
            names.append(link)
            rotations.append(r)
            places.append(t)
    return names, np.array(rotations), np.array(places)


def _rotations(axes: Array, angles: Array) -> Array:
    """Rotations (N, 3, 3) about unit vectors (N, 3) by angles (N,), rad; Rodrigues' formula."""
    x, y, z = axes.T
    zero = np.zeros(len(axes))
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    sine, versine = np.sin(angles)[:, None, None], (1 - np.cos(angles))[:, None, None]
    result: Array = np.eye(3) + sine * cross + versine * (cross @ cross)
    return result


def _joint(
    step: Freedom | None, segment: str, parent: str, child: str, offset: Array, mount: Array | None
) -> ET.Element:
    joint = ET.Element(
        'joint', name=step.name if step else f'{segment}.mount', type=step.kind if step else 'fixed'
    )
    angles = np.zeros(3) if mount is None else roll_pitch_yaw(mount)
    ET.SubElement(joint, 'origin', xyz=xml_numbers(offset), rpy=xml_numbers(angles))
    ET.SubElement(joint, 'parent', link=parent)
    ET.SubElement(joint, 'child', link=child)
    if step is not None:
        ET.SubElement(joint, 'axis', xyz=_AXES[step.axis])
        lower = max(float(step.lower), -_UNLIMITED)
        upper = min(float(step.upper), _UNLIMITED)
        ET.SubElement(
            joint, 'limit', lower=repr(lower), upper=repr(upper), effort='1000.0', velocity='100.0'
        )
    return joint


def add_rod(link: ET.Element, end: Array, radius: float) -> None:
    """Shows a rod in a link, from its origin to an end (3,), m; none where they are one point."""
    length = float(np.linalg.norm(end))
    if length < 1e-6:
        return
    # A cylinder of URDF lies along z: pitch and yaw turn z into the direction of the rod.
    x, y, z = (end / length).tolist()
    angles = [0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x)]
    visual = ET.SubElement(link, 'visual')
    ET.SubElement(visual, 'origin', xyz=xml_numbers(end / 2), rpy=xml_numbers(angles))
    geometry = ET.SubElement(visual, 'geometry')
    ET.SubElement(geometry, 'cylinder', radius=repr(float(radius)), length=repr(length))


def roll_pitch_yaw(rotation: ArrayLike) -> Array:
    """Angles (3,) of R = Rz(yaw) Ry(pitch) Rx(roll), exact also where pitch is a right angle."""
    r = np.asarray(rotation, dtype=np.float64)
    yaw = math.atan2(r[1, 0], r[0, 0])
    s, c = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-r[2, 0], c * r[0, 0] + s * r[1, 0])
    roll = math.atan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, pitch, yaw])


def xml_numbers(values: Iterable[float]) -> str:
    """Numbers as the value of an attribute, without a loss."""
    # -0.0 would be another text for the same number.
    return ' '.join(repr(float(value) + 0.0) for value in values)
