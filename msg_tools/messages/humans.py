"""Messages of REP 155 about a body: its region and landmarks in the image, its reference model.

The types of hri_msgs are read from the installed package (`register_definitions`). Image
coordinates are in units of width and height, from the upper left corner.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.body.reference_human import ReferenceHuman
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.inference.linear_algebra import product
from msg_tools.messages.detections import SKELETON_2D
from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.images import decode_image, image_message
from msg_tools.messages.message_error import Array
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.states import joint_state_message, transforms_message
from msg_tools.messages.urdf import add_limit, add_rod, xml_numbers

IDS = 'hri_msgs/msg/IdsList'
REGION = 'hri_msgs/msg/NormalizedRegionOfInterest2D'
_LANDMARK = 'hri_msgs/msg/NormalizedPointOfInterest2D'

# Extent of the body around a joint (flesh, skull, fingers), m.
REACH = 0.12
# Rotation from the axes of the head's landmarks (x to the person's right, y backwards, z down) to
# the axes of the reference model.
_LANDMARKS_TO_HEAD = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Maximum distance of landmarks, or of sides of regions, at which two modes agree, in heights of the
# region.
_AGREEMENT_DISTANCE = 0.1


def ids_message(messages: MessageFactory, ids: Sequence[str], stamp_ns: int) -> Any:
    """hri_msgs/IdsList of the tracked bodies."""
    return messages.create(IDS, header=header_message(messages, stamp_ns, ''), ids=list(ids))


def region_in_image(camera: Camera, positions: Array) -> Array | None:
    """Left, top, right and bottom (4,) of a person, px from the upper left corner of the image.

    Args:
        positions: (J, 3) positions of the joints in the frame of the camera, m.

    Returns:
        The region; None if no part of the person is in the image.
    """
    pixels = camera.project(positions)
    seen = np.isfinite(pixels).all(1)
    if not seen.any():
        return None
    reach = np.array([REACH * camera.magnification(float(z)) for z in positions[seen, 2]])[:, None]
    # (0, 0) is the centre of the first pixel.
    low, high = (pixels[seen] - reach).min(0) + 0.5, (pixels[seen] + reach).max(0) + 0.5
    size = np.array([camera.width, camera.height])
    box = np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)])
    return box if (box[2:] - box[:2] >= 1.0).all() else None


def region_message(
    messages: MessageFactory,
    camera: Camera,
    region: Array,
    others: Sequence[Array | None],
    weights: Array,
    stamp_ns: int,
    frame_id: str,
) -> Any:
    """Makes an hri_msgs/NormalizedRegionOfInterest2D.

    Args:
        region: (4,) region of the shown mode, see `region_in_image`.
        others: regions of all K modes.
        weights: (K,) weights of the modes. The confidence is the total weight of the modes whose
            region agrees with the shown region: no side differs by more than a tenth of its height.
    """
    near = _AGREEMENT_DISTANCE * (region[3] - region[1])
    agree = [other is not None and np.abs(other - region).max() <= near for other in others]
    corners = region / np.tile([camera.width, camera.height], 2)
    return messages.create(
        REGION,
        header=header_message(messages, stamp_ns, frame_id),
        **dict(zip(('xmin', 'ymin', 'xmax', 'ymax'), corners.tolist(), strict=True)),
        c=float(min(weights[agree].sum(), 1.0)),
    )


def skeleton_message(
    messages: MessageFactory,
    camera: Camera,
    landmarks: Array,
    shown: int,
    weights: Array,
    stamp_ns: int,
    frame_id: str,
) -> Any:
    """Makes an hri_msgs/Skeleton2D.

    Landmarks that are unknown or outside of the image are at (0, 0) with confidence 0. The
    confidence of any other landmark is the probability that it is near its shown position, within a
    tenth of the height of the whole skeleton in the image.

    Args:
        landmarks: (K, 18, 3) landmarks in all modes, see `landmarks_in_space`.
        shown: index of the mode whose landmarks are sent.
        weights: (K,) weights of the modes.
    """
    # (0, 0) is the centre of the first pixel.
    pixels = camera.project(landmarks) + 0.5
    rows = pixels[shown, :, 1]
    near = (
        _AGREEMENT_DISTANCE * float(np.ptp(rows[np.isfinite(rows)]))
        if np.isfinite(rows).any()
        else 0.0
    )
    apart = np.nan_to_num(np.linalg.norm(pixels - pixels[shown], axis=2), nan=np.inf)
    places = pixels[shown] / (camera.width, camera.height)
    confidences = np.minimum(product(weights, apart <= near), 1.0)
    inside = ((places >= 0) & (places <= 1)).all(1)
    values = np.where(inside[:, None], np.column_stack([places, confidences]), 0.0)
    return messages.create(
        SKELETON_2D,
        header=header_message(messages, stamp_ns, frame_id),
        skeleton=[messages.create(_LANDMARK, x=x, y=y, c=c) for x, y, c in values.tolist()],
    )


def landmarks_in_space(
    joint_names: Sequence[str], positions: Array, human: ReferenceHuman
) -> Array:
    """Landmarks (K, 18, 3) of Skeleton2D in the frame of the joint positions (K, J, 3), m.

    Landmarks of limbs are at the joints. Nose and ears are at fixed offsets from the joint of the
    head, rotated like the head of the reference model. Eyes are unknown, NaN.
    """
    marks = schemes()['skeleton2d'].landmarks
    names, rotations, _ = human.links()
    head = product(product(human.rotation, rotations[names.index('head')]), _LANDMARKS_TO_HEAD)
    result = np.full((len(positions), len(marks), 3), np.nan)
    for i, mark in enumerate(marks):
        if mark.joint in joint_names:
            result[:, i] = positions[:, list(joint_names).index(mark.joint)]
            if mark.joint == 'head':
                result[:, i] += product(head, mark.offset)
    return result


def cropped_message(messages: MessageFactory, image: Any, region: Array) -> Any:
    """sensor_msgs/Image with the part of an image within a region (4,), px.

    Raises:
        ImageError: the image can not be decoded.
    """
    left, top = np.floor(region[:2]).astype(int)
    right, bottom = np.ceil(region[2:]).astype(int)
    picture = decode_image(image)[top:bottom, left:right]
    stamp, frame_id = time_ns(image.header.stamp), str(image.header.frame_id)
    return image_message(messages, np.ascontiguousarray(picture), stamp, frame_id)


def human_joint_states(
    messages: MessageFactory, human: ReferenceHuman, body_id: str, stamp_ns: int
) -> Any:
    """sensor_msgs/JointState of the reference model; names end with the identity of the body."""
    names = [f'{name}_{body_id}' for name in human.angles]
    return joint_state_message(
        messages, names, list(human.angles.values()), stamp_ns, f'body_{body_id}'
    )


def human_transforms(
    messages: MessageFactory,
    human: ReferenceHuman,
    body_id: str,
    stamp_ns: int,
    frame_id: str,
    *,
    links: bool,
) -> Any:
    """tf2_msgs/TFMessage with the body relative to the camera, and the links relative to the body.

    Args:
        links: whether to include the links, not only the body.
    """
    root = f'body_{body_id}'
    names, rotations, places = (
        human.links() if links else ([], np.empty((0, 3, 3)), np.empty((0, 3)))
    )
    return transforms_message(
        messages,
        [frame_id, *[root] * len(names)],
        [root, *(f'{name}_{body_id}' for name in names)],
        np.concatenate([human.rotation[None], rotations]),
        np.concatenate([human.origin[None], places]),
        stamp_ns,
    )


def human_urdf(human: ReferenceHuman, body_id: str, rod_radius: float = 0.03) -> str:
    """URDF of the reference model with the lengths of a person; names end with the identity.

    All angles have the range [-pi, pi], because people exceed the narrower ranges of the reference.
    """
    robot = ET.Element('robot', name=f'human_{body_id}')
    links = {'body': ET.SubElement(robot, 'link', name=f'body_{body_id}')}
    for joint in human.joints:
        links[joint.child] = ET.SubElement(robot, 'link', name=f'{joint.child}_{body_id}')
        add_rod(links[joint.parent], joint.origin, rod_radius)
    for joint in human.joints:
        kind = 'fixed' if joint.axis is None else 'revolute'
        element = ET.SubElement(robot, 'joint', name=f'{joint.name}_{body_id}', type=kind)
        ET.SubElement(element, 'parent', link=f'{joint.parent}_{body_id}')
        ET.SubElement(element, 'child', link=f'{joint.child}_{body_id}')
        ET.SubElement(element, 'origin', xyz=xml_numbers(joint.origin), rpy='0 0 0')
        if joint.axis is not None:
            ET.SubElement(element, 'axis', xyz=xml_numbers(joint.axis))
            add_limit(element, -np.pi, np.pi)
    ET.indent(robot)
    return ET.tostring(robot, encoding='unicode', xml_declaration=False) + '\n'
