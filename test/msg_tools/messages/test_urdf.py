"""The URDF of a body against Pinocchio."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pytest

from hmt_ros.body import load_body
from msg_tools import MessageError
from msg_tools.messages.urdf import Freedom, Segment, body_urdf, roll_pitch_yaw, segments_of

AXES = np.eye(3)


def rotation(axis: np.ndarray[Any, Any], angle: float) -> np.ndarray[Any, Any]:
    """Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def random_rotation(rng: np.random.Generator) -> np.ndarray[Any, Any]:
    axis = rng.normal(size=3)
    return rotation(axis / np.linalg.norm(axis), rng.uniform(-np.pi, np.pi))


def random_body(seed: int) -> list[Segment]:
    rng = np.random.default_rng(seed)
    segments = []
    for index in range(9):
        freedoms: list[Freedom] = []
        for kind, count in (('prismatic', rng.integers(0, 3)), ('revolute', rng.integers(0, 4))):
            for axis in rng.permutation(list('xyz'))[:count]:
                name = f'{index}_{kind}_{axis}'
                freedoms.append(Freedom(name, axis, kind, -np.inf, 2.0))  # type: ignore[arg-type]
        mount = random_rotation(rng)
        if index % 3 == 0:  # at the pole of roll, pitch and yaw
            mount = rotation(AXES[2], 0.3) @ rotation(AXES[1], np.pi / 2) @ rotation(AXES[0], 0.5)
        segments.append(
            Segment(
                f'segment {index}',
                int(rng.integers(-1, index)) if index else -1,
                rng.normal(size=3),
                mount,
                freedoms,
                rng.normal(size=(2, 3)),
            )
        )
    return segments


def forward(segments: list[Segment], pose: dict[str, float]) -> list[np.ndarray[Any, Any]]:
    """Trans(offset + translations) * mount * rotations, one matrix after the other."""
    frames: list[np.ndarray[Any, Any]] = []
    for segment in segments:
        frame = np.eye(4) if segment.parent == -1 else frames[segment.parent].copy()
        place = np.array(segment.offset, dtype=float)
        for freedom in segment.freedoms:
            if freedom.kind == 'prismatic':
                place += pose[freedom.name] * AXES['xyz'.index(freedom.axis)]
        step = np.eye(4)
        step[:3, 3] = place
        step[:3, :3] = segment.mount
        frame = frame @ step
        for freedom in segment.freedoms:
            if freedom.kind == 'revolute':
                turn = np.eye(4)
                turn[:3, :3] = rotation(AXES['xyz'.index(freedom.axis)], pose[freedom.name])
                frame = frame @ turn
        frames.append(frame)
    return frames


@pytest.mark.parametrize('seed', range(6))
def test_forward_kinematics_of_pinocchio(seed: int) -> None:
    pinocchio = pytest.importorskip('pinocchio', reason='Pinocchio (pin) is not installed')
    segments = random_body(seed)
    model = pinocchio.buildModelFromXML(body_urdf('body', segments, 'camera'))
    data = model.createData()
    names = [freedom.name for segment in segments for freedom in segment.freedoms]
    assert sorted(list(model.names)[1:]) == sorted(names)
    assert model.nq == len(names)
    rng = np.random.default_rng(100 + seed)
    for _ in range(20):
        pose = dict(zip(names, rng.uniform(-3, 3, len(names)), strict=True))
        q = np.zeros(model.nq)
        for name, value in pose.items():
            q[model.joints[model.getJointId(name)].idx_q] = value
        pinocchio.framesForwardKinematics(model, data, q)
        for segment, wanted in zip(segments, forward(segments, pose), strict=True):
            found = data.oMf[model.getFrameId(segment.name)].homogeneous
            np.testing.assert_allclose(found, wanted, atol=1e-9)
    upper = model.upperPositionLimit
    assert (upper == 2.0).all()
    assert (model.lowerPositionLimit == -1000.0).all()


@pytest.mark.parametrize('name', ['human32', 'human34', 'human37'])
def test_joints_of_a_body(name: str) -> None:
    pinocchio = pytest.importorskip('pinocchio', reason='Pinocchio (pin) is not installed')
    body = load_body(name)
    skeleton = body.skeleton
    model = pinocchio.buildModelFromXML(body_urdf(name, segments_of(skeleton), 'camera'))
    data = model.createData()
    poses = np.random.default_rng(0).uniform(-1, 1, (5, body.dimension))
    for pose, wanted in zip(poses, body.joint_positions(poses), strict=True):
        q = np.zeros(model.nq)
        for dof, value in zip(body.dof_names, pose, strict=True):
            q[model.joints[model.getJointId(dof)].idx_q] = value
        pinocchio.framesForwardKinematics(model, data, q)
        for joint, segment in enumerate(skeleton.joint_segments):
            frame = data.oMf[model.getFrameId(skeleton.segment_names[segment])]
            found = frame.act(skeleton.joint_offsets[joint])
            np.testing.assert_allclose(found, wanted[joint], atol=1e-9)


def test_roll_pitch_yaw_gives_back_the_rotation() -> None:
    rng = np.random.default_rng(0)
    for pitch in (0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-8, -np.pi / 2 + 1e-10, 2.0):
        for _ in range(20):
            roll, yaw = rng.uniform(-np.pi, np.pi, 2)
            parts = [rotation(AXES[i], a) for i, a in ((2, yaw), (1, pitch), (0, roll))]
            wanted = parts[0] @ parts[1] @ parts[2]
            r, p, y = roll_pitch_yaw(wanted)
            again = rotation(AXES[2], y) @ rotation(AXES[1], p) @ rotation(AXES[0], r)
            np.testing.assert_allclose(again, wanted, atol=1e-14)


def test_rods_reach_from_the_origin_to_the_points() -> None:
    segments = [
        Segment('a', -1, np.zeros(3), np.eye(3), (), [[0.1, -0.2, 0.3], [0, 0, -1], [0, 0, 0]])
    ]
    robot = ET.fromstring(body_urdf('body', segments, 'camera'))
    visuals = robot.findall("./link[@name='a']/visual")
    assert len(visuals) == 2
    for visual, point in zip(visuals, np.array(segments[0].points), strict=False):
        origin = visual.find('origin')
        cylinder = visual.find('geometry/cylinder')
        assert origin is not None
        assert cylinder is not None
        r, p, y = map(float, origin.attrib['rpy'].split())
        turn = rotation(AXES[2], y) @ rotation(AXES[1], p) @ rotation(AXES[0], r)
        centre = np.array(list(map(float, origin.attrib['xyz'].split())))
        half = turn @ AXES[2] * float(cylinder.attrib['length']) / 2
        np.testing.assert_allclose(centre - half, 0, atol=1e-12)
        np.testing.assert_allclose(centre + half, point, atol=1e-12)


def test_text_is_the_same_every_time_and_escaped() -> None:
    segments = [Segment('a<b>&"c', -1, -np.zeros(3), np.eye(3))]
    text = body_urdf('body', segments, 'camera')
    assert text == body_urdf('body', segments, 'camera')
    assert '-0.0' not in text
    robot = ET.fromstring(text)
    assert [link.attrib['name'] for link in robot.findall('link')] == ['camera', 'a<b>&"c']
    assert robot.find('joint').attrib['type'] == 'fixed'  # type: ignore[union-attr]


def test_defects() -> None:
    turn = Freedom('turn', 'x', 'revolute', -1, 1)
    slide = Freedom('slide', 'x', 'prismatic', -1, 1)
    zero, one = np.zeros(3), np.eye(3)
    for segments, error in (
        ([Segment('a', 0, zero, one)], 'segment a has parent 0, wanted one before it'),
        ([Segment('a', -1, zero, one), Segment('a', 0, zero, one)], "the link 'a' is there twice"),
        ([Segment('camera', -1, zero, one)], "the link 'camera' is there twice"),
        (
            [Segment('a', -1, zero, one, [turn, turn])],
            "the joint 'turn' is there twice",
        ),
        ([Segment('a', -1, zero, one, [turn, slide])], 'is translated after it is rotated'),
        ([Segment('a', -1, zero, -one)], 'the mount of segment a is no rotation'),
        ([Segment('a', -1, zero, 2 * one)], 'the mount of segment a is no rotation'),
        ([Segment('a', -1, np.zeros(2), one)], r'has offset \(2,\) and mount \(3, 3\)'),
    ):
        with pytest.raises(MessageError, match=error):
            body_urdf('body', segments, 'camera')
