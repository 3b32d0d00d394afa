"""The URDF of a body, compared with Pinocchio."""

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pytest

from hmt_ros.body.skeleton import Skeleton
from msg_tools import MessageError
from msg_tools.messages.urdf import body_urdf, roll_pitch_yaw

AXES = np.eye(3)


def rotation(axis, angle):
    """Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def random_rotation(rng):
    axis = rng.normal(size=3)
    return rotation(axis / np.linalg.norm(axis), rng.uniform(-np.pi, np.pi))


def skeleton_of(segments, offsets, mounts, dofs=(), joints=()):
    """A skeleton of segments (name, parent), dofs (name, segment, axis, turns), joints of 0."""
    names, parents = zip(*segments, strict=True)
    s, j, columns = len(segments), len(joints), list(zip(*dofs, strict=True)) or [()] * 4
    return Skeleton(
        'body', names, parents, np.array(mounts), np.array(offsets), np.zeros((s, 3, 1)),
        columns[0], np.array(columns[1], dtype=int), np.array(columns[2], dtype=int),
        np.array(columns[3], dtype=bool), np.full(len(dofs), -np.inf), np.full(len(dofs), 2.0),
        tuple(f'joint {i}' for i in range(j)), np.zeros(j, dtype=int),
        np.reshape(joints, (j, 3, 1)), ('scale',), np.ones(1),
    )  # fmt: skip


def random_body(seed):
    rng = np.random.default_rng(seed)
    segments: list[tuple[str, int]] = []
    mounts, dofs = [], []
    for index in range(9):
        for turns, count in ((False, rng.integers(0, 3)), (True, rng.integers(0, 4))):
            axes = rng.permutation(3)[:count].tolist()
            dofs += [(f'{index}_{turns}_{axis}', index, axis, turns) for axis in axes]
        mount = random_rotation(rng)
        if index % 3 == 0:  # at the pole of roll, pitch and yaw
            mount = rotation(AXES[2], 0.3) @ rotation(AXES[1], np.pi / 2) @ rotation(AXES[0], 0.5)
        segments.append((f'segment {index}', int(rng.integers(-1, index)) if index else -1))
        mounts.append(mount)
    return skeleton_of(segments, rng.normal(size=(9, 3)), mounts, dofs, rng.normal(size=(2, 3)))


def forward(skeleton, pose):
    """Trans(offset + translations) * mount * rotations, one matrix after the other."""
    frames: list[np.ndarray[Any, Any]] = []
    for index, parent in enumerate(skeleton.parents):
        frame = np.eye(4) if parent == -1 else frames[parent].copy()
        step = np.eye(4)
        step[:3, 3], step[:3, :3] = skeleton.offsets[index], skeleton.mounts[index]
        for dof in skeleton.segment_dofs[index]:
            axis = AXES[skeleton.dof_axes[dof]]
            if not skeleton.dof_is_rotation[dof]:
                step[:3, 3] += pose[skeleton.dof_names[dof]] * axis
        frame = frame @ step
        for dof in skeleton.segment_dofs[index]:
            if skeleton.dof_is_rotation[dof]:
                turn = np.eye(4)
                axis = AXES[skeleton.dof_axes[dof]]
                turn[:3, :3] = rotation(axis, pose[skeleton.dof_names[dof]])
                frame = frame @ turn
        frames.append(frame)
    return frames


@pytest.mark.parametrize('seed', range(6))
def test_forward_kinematics_of_pinocchio(seed):
    pinocchio = pytest.importorskip('pinocchio', reason='Pinocchio (pin) is not installed')
    skeleton = random_body(seed)
    model = pinocchio.buildModelFromXML(body_urdf(skeleton, 'camera'))
    data = model.createData()
    names = skeleton.dof_names
    assert sorted(list(model.names)[1:]) == sorted(names)
    assert model.nq == len(names)
    rng = np.random.default_rng(100 + seed)
    for _ in range(20):
        pose = dict(zip(names, rng.uniform(-3, 3, len(names)), strict=True))
        q = np.zeros(model.nq)
        for name, value in pose.items():
            q[model.joints[model.getJointId(name)].idx_q] = value
        pinocchio.framesForwardKinematics(model, data, q)
        segments = skeleton.segment_names
        for segment, wanted in zip(segments, forward(skeleton, pose), strict=True):
            found = data.oMf[model.getFrameId(segment)].homogeneous
            np.testing.assert_allclose(found, wanted, atol=1e-9)
    upper = model.upperPositionLimit
    assert (upper == 2.0).all()
    assert (model.lowerPositionLimit == -1000.0).all()


def test_roll_pitch_yaw_gives_back_the_rotation():
    rng = np.random.default_rng(0)
    for pitch in (0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-8, -np.pi / 2 + 1e-10, 2.0):
        for _ in range(20):
            roll, yaw = rng.uniform(-np.pi, np.pi, 2)
            parts = [rotation(AXES[i], a) for i, a in ((2, yaw), (1, pitch), (0, roll))]
            wanted = parts[0] @ parts[1] @ parts[2]
            r, p, y = roll_pitch_yaw(wanted)
            again = rotation(AXES[2], y) @ rotation(AXES[1], p) @ rotation(AXES[0], r)
            np.testing.assert_allclose(again, wanted, atol=1e-14)


def test_text_is_the_same_every_time_and_escaped():
    skeleton = skeleton_of([('a<b>&"c', -1)], [-np.zeros(3)], [np.eye(3)])
    text = body_urdf(skeleton, 'camera')
    assert text == body_urdf(skeleton, 'camera')
    assert '-0.0' not in text
    robot = ET.fromstring(text)
    assert [link.attrib['name'] for link in robot.findall('link')] == ['camera', 'a<b>&"c']
    assert robot.find('joint').attrib['type'] == 'fixed'


def test_a_segment_with_the_name_of_the_camera():
    skeleton = skeleton_of([('camera', -1)], [np.zeros(3)], [np.eye(3)])
    with pytest.raises(MessageError, match="the link 'camera' is there twice"):
        body_urdf(skeleton, 'camera')
