"""A body as a URDF, so that any ROS viewer can show it and move it by joint states.

Joints in a URDF have one degree of freedom, so a segment with several degrees of freedom becomes a
chain of links; the last link has the name of the segment. The joints have the names of the degrees
of freedom. The transform from a segment to its parent is

    Trans(offset + translations) * mount * Rot(axis_1, q_1) * ... * Rot(axis_n, q_n)

as in `hmt_ros.body.skeleton`. Links have no inertia, because the URDF is only for viewers.
`link_frames` gives the frames of all links, including links within a chain, because viewers warn
about links without a frame.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.kinematics import Frames
from hmt_ros.body.rotations import rotations_of
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import elementary
from hmt_ros.inference.linear_algebra import product
from msg_tools.messages.message_error import Array, MessageError

# Limit of unlimited joints, m or rad, because URDF requires a limit.
_MAX_LIMIT = 1000.0
_AXES = ('1 0 0', '0 1 0', '0 0 1')


def body_urdf(
    skeleton: Skeleton, root_link: str, rod_radius: float = 0.025, link_prefix: str = ''
) -> str:
    """The URDF of a skeleton with its current lengths; equal bodies give equal text.

    Args:
        skeleton: skeleton whose segments are shown as rods to their ends.
        root_link: link of the camera, the parent of segments without a parent.
        rod_radius: radius of the rods, m.
        link_prefix: prefix of the names of all links except the root.

    Raises:
        MessageError: a name that occurs twice.
    """
    robot = ET.Element('robot', name=skeleton.name)
    ET.SubElement(robot, 'link', name=root_link)
    joints: list[ET.Element] = []
    for index, parent in enumerate(skeleton.parents):
        above = root_link if parent == -1 else f'{link_prefix}{skeleton.segment_names[parent]}'
        _add_segment(robot, joints, skeleton, index, above, rod_radius, link_prefix)
    robot.extend(joints)
    for kind in ('link', 'joint'):
        names = Counter(element.attrib['name'] for element in robot.iter(kind))
        ((name, count),) = names.most_common(1)
        if count > 1:
            raise MessageError(f'urdf: the {kind} {name!r} is there twice')
    ET.indent(robot)
    return ET.tostring(robot, encoding='unicode', xml_declaration=False) + '\n'


def _add_segment(
    robot: ET.Element,
    joints: list[ET.Element],
    skeleton: Skeleton,
    index: int,
    parent: str,
    rod_radius: float,
    link_prefix: str,
) -> None:
    """Adds the links and joints between a parent link and a segment."""
    name, offset = skeleton.segment_names[index], skeleton.offsets[index]
    # Degrees of freedom, or None for a fixed joint. The mount precedes the first rotation.
    steps: list[int | None] = list(skeleton.segment_dofs[index])
    if not any(skeleton.dof_is_rotation[i] for i in skeleton.segment_dofs[index]):
        steps.append(None)
    mount: Array | None = skeleton.mounts[index]
    for number, dof in enumerate(steps, 1):
        last, turns = number == len(steps), dof is None or bool(skeleton.dof_is_rotation[dof])
        step = 'mount' if dof is None else skeleton.dof_names[dof]
        link = f'{link_prefix}{name}' if last else f'{link_prefix}{name}.{step}'
        joint = ET.Element(
            'joint', name=f'{name}.mount' if dof is None else step, type=_kind(skeleton, dof)
        )
        angles = roll_pitch_yaw(mount) if turns and mount is not None else np.zeros(3)
        ET.SubElement(joint, 'origin', xyz=xml_numbers(offset), rpy=xml_numbers(angles))
        ET.SubElement(joint, 'parent', link=parent)
        ET.SubElement(joint, 'child', link=link)
        if dof is not None:
            ET.SubElement(joint, 'axis', xyz=_AXES[int(skeleton.dof_axes[dof])])
            lower = max(float(skeleton.lower[dof]), -_MAX_LIMIT)
            upper = min(float(skeleton.upper[dof]), _MAX_LIMIT)
            add_limit(joint, lower, upper)
        joints.append(joint)
        element = ET.SubElement(robot, 'link', name=link)
        offset, mount, parent = np.zeros(3), None if turns else mount, link
    children = [child for child, above in enumerate(skeleton.parents) if above == index]
    own = skeleton.joint_offsets[skeleton.joint_segments == index]
    for point in np.unique(np.concatenate([skeleton.offsets[children], own]), axis=0):
        add_rod(element, point, rod_radius)


def _kind(skeleton: Skeleton, dof: int | None) -> str:
    if dof is None:
        return 'fixed'
    return 'revolute' if skeleton.dof_is_rotation[dof] else 'prismatic'


def link_frames(
    skeleton: Skeleton, frames: Frames, pose: ArrayLike, index: int = 0
) -> tuple[list[str], Array, Array]:
    """Computes the frames of the links of `body_urdf` except the root, which is the camera.

    Args:
        pose: (d,) pose of the body.
        index: index of the pose in `frames`.

    Returns:
        Names of the links (L), as in `body_urdf` without a prefix; rotations (L, 3, 3) and origins
        (L, 3), m, in the frame of the camera.
    """
    q = np.asarray(pose, dtype=np.float64)
    turned = frames.rotations()[index]
    origins = np.ascontiguousarray(frames.origins[:, :, index])
    # The inverse of each rotation is a rotation by -q about the same axis.
    back = rotations_of(-q[:, None] * frames.axes[:, :, index])
    names: list[str] = []
    rotations: list[Array] = []
    places: list[Array] = []
    for segment, name in enumerate(skeleton.segment_names):
        own = skeleton.segment_dofs[segment]
        chain = [(name, turned[segment], origins[segment])]
        # Go from the segment to its parent; links of translations have the parent's rotation.
        rotation, place = turned[segment], origins[segment]
        parent = skeleton.parents[segment]
        unturned = np.eye(3) if parent == -1 else turned[parent]
        turns = any(skeleton.dof_is_rotation[i] for i in own)
        for position in reversed(range(len(own))):
            dof = own[position]
            if position == len(own) - 1 and turns:
                # The link of the last rotation is the segment itself.
                rotation = product(back[dof], rotation)
                continue
            link = f'{name}.{skeleton.dof_names[dof]}'
            if skeleton.dof_is_rotation[dof]:
                chain.append((link, rotation, place))
                rotation = product(back[dof], rotation)
            else:
                chain.append((link, unturned, place))
                place = place - q[dof] * frames.axes[dof, :, index]
        for link, r, t in reversed(chain):
            names.append(link)
            rotations.append(r)
            places.append(t)
    return names, np.array(rotations), np.array(places)


def add_limit(joint: ET.Element, lower: float, upper: float) -> None:
    """Adds the limits of a joint, m or rad."""
    bounds = {'lower': repr(lower), 'upper': repr(upper)}
    ET.SubElement(joint, 'limit', bounds | {'effort': '1000.0', 'velocity': '100.0'})


def add_rod(link: ET.Element, end: Array, radius: float) -> None:
    """Adds a rod from the origin of a link to an end (3,), m, unless both are equal."""
    length = float(np.linalg.norm(end, axis=0))
    if length < 1e-6:
        return
    # A cylinder in URDF is along z; pitch and yaw rotate z to the direction of the rod.
    x, y, z = (end / length).tolist()
    angles = [0.0, float(elementary.arctan2(math.hypot(x, y), z)), float(elementary.arctan2(y, x))]
    visual = ET.SubElement(link, 'visual')
    ET.SubElement(visual, 'origin', xyz=xml_numbers(end / 2), rpy=xml_numbers(angles))
    geometry = ET.SubElement(visual, 'geometry')
    ET.SubElement(geometry, 'cylinder', radius=repr(float(radius)), length=repr(length))


def roll_pitch_yaw(rotation: ArrayLike) -> Array:
    """Angles (3,) of R = Rz(yaw) Ry(pitch) Rx(roll), exact even if pitch is a right angle."""
    r = np.asarray(rotation, dtype=np.float64)
    yaw = float(elementary.arctan2(r[1, 0], r[0, 0]))
    s, c = float(elementary.sin(yaw)), float(elementary.cos(yaw))
    pitch = float(elementary.arctan2(-r[2, 0], c * r[0, 0] + s * r[1, 0]))
    roll = float(elementary.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1]))
    return np.array([roll, pitch, yaw])


def xml_numbers(values: Iterable[float]) -> str:
    """Numbers as the value of an XML attribute, without loss of precision."""
    # Adding 0.0 turns -0.0 into 0.0, so that equal numbers have equal text.
    return ' '.join(repr(float(value) + 0.0) for value in values)
