"""Skeletons as BVH and glTF: other readers find the joints where the body has them."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from hmt_ros.body import load_body
from hmt_ros.motion.motion_file import read_motion
from hmt_ros.motion.moving_skeleton import (
    CAMERA_TO_ROOM,
    MovingSkeleton,
    bvh_text,
    gltf_bytes,
)

BODY = load_body('human37').with_stature(1.8)
FRAMES, RATE = 12, 25.0
TIMES = np.arange(FRAMES) / RATE
# A tenth of a millimetre.
CLOSE = 1e-4


def some_poses(frames=FRAMES, seed=0):
    """Poses (T, d) anywhere within the limits."""
    rng = np.random.default_rng(seed)
    lower, upper = (np.clip(x, -3.0, 3.0) for x in (BODY.lower, BODY.upper))
    poses = rng.uniform(lower, upper, (frames, BODY.dimension))
    poses[:, 2] = rng.uniform(2.0, 5.0, frames)
    return poses


def joints_of(poses):
    """Joints (T, J, 3) of poses in axes with y up, m."""
    return BODY.joint_positions(poses) @ CAMERA_TO_ROOM.T


def test_a_bvh_has_the_joints_where_they_are(tmp_path):
    poses = some_poses()
    path = tmp_path / 'some.bvh'
    path.write_text(bvh_text(MovingSkeleton.of_body(BODY, poses, TIMES), RATE))
    motion = read_motion(path, unit_to_m=1.0, up_axis='y')
    assert motion.fps == pytest.approx(RATE)
    wanted = joints_of(poses)
    # The world of read_motion has z up.
    wanted = np.stack([wanted[..., 0], -wanted[..., 2], wanted[..., 1]], axis=-1)
    assert np.abs(motion.joint_positions(BODY.joint_names) - wanted).max() < CLOSE


def test_the_pose_of_zeros_stands_upright_and_unturned():
    moving = MovingSkeleton.of_body(BODY, np.zeros((1, BODY.dimension)), np.zeros(1))
    unturned = np.tile(np.eye(3), (len(moving.names), 1, 1))
    np.testing.assert_allclose(moving.rotations[0], unturned, atol=1e-12)
    at = dict(zip(moving.names, moving.offsets, strict=True))
    assert at['left_knee'][1] < -0.3
    assert at['head'][1] > 0.1
    assert at['left_hip'][0] > 0 > at['right_hip'][0]
    assert at['left_toe'][2] > 0.05


def test_one_skeleton_has_the_names_of_its_joints():
    names = MovingSkeleton.of_body(BODY, some_poses(), TIMES).names
    assert set(BODY.joint_names) <= set(names)
    assert len(set(names)) == len(names)


def root_angles(name, low, high, count=60):
    """Angles (T, 3) of the root in a BVH while one of its degrees of freedom moves evenly."""
    poses = np.zeros((count, BODY.dimension))
    poses[:, 2] = 4.0
    poses[:, BODY.dof_names.index(name)] = np.linspace(low, high, count)
    moving = MovingSkeleton.of_body(BODY, poses, np.arange(count) / 30.0)
    rows = bvh_text(moving, 30.0).partition('Frame Time:')[2].splitlines()[1:]
    return np.array([row.split() for row in rows], dtype=float)[:, 3:6]


@pytest.mark.parametrize(
    ('name', 'low', 'high'), [('root_z', 0.0, 6.0 * np.pi), ('root_x', -2.9, 2.9)]
)
def test_angles_go_on_where_a_person_turns(name, low, high):
    """Programs interpolate angle by angle: none leaps by half a turn or a whole one."""
    angles = root_angles(name, low, high)
    steps = np.abs(np.diff(angles, axis=0))
    assert steps.max() < 1.01 * np.degrees((high - low) / 59)
    assert np.ptp(angles, axis=0).max() == pytest.approx(np.degrees(high - low), abs=0.01)


def test_gaps_and_other_rates_are_interpolated():
    poses = np.zeros((4, BODY.dimension))
    poses[:, 2] = 4.0
    elbow = BODY.dof_names.index('left_elbow')
    poses[:, elbow] = [0.0, 0.2, 1.0, 1.1]
    poses[:, 0] = [0.0, 0.1, 0.5, 0.55]
    moving = MovingSkeleton.of_body(BODY, poses, np.array([0.0, 0.1, 0.5, 0.55]))
    even = moving.at_rate(20.0)
    np.testing.assert_allclose(even.times, np.arange(12) / 20.0)
    np.testing.assert_allclose(even.places[:, 0], np.arange(12) / 20.0, atol=1e-12)
    turns = Rotation.from_matrix(even.rotations[:, even.names.index('left_elbow')]).magnitude()
    np.testing.assert_allclose(turns, 2.0 * np.arange(12) / 20.0, atol=1e-9)
    alone = MovingSkeleton.of_body(BODY, poses[:1], np.zeros(1)).at_rate(30.0)
    assert len(alone.times) == 1
    with pytest.raises(ValueError, match='wanted 1000000 at most: a lower --fps'):
        MovingSkeleton.of_body(BODY, poses[:2], np.array([0.0, 1e6])).at_rate(30.0)


def test_bodies_whose_segments_move_along_axes_are_refused(tmp_path):
    path = tmp_path / 'long_neck.yaml'
    path.write_text(
        'name: long_neck\nlengths: {trunk: [0.5, 0.1]}\nstature: [trunk]\nstature_extra: 0.1\n'
        'stature_spread: 0.1\nsegments:\n'
        '  - {name: pelvis, diffusion: [0.2, 1.0], dofs: [[root_tz, tz, 0.3, 50]]}\n'
        '  - {name: head, parent: pelvis, length: trunk, diffusion: [0.2, 1.0],\n'
        '     dofs: [[neck_tx, tx, -1, 1]]}\n'
        'joints: {pelvis: [pelvis, start], head: [head, end]}\n'
    )
    body = load_body(path)
    with pytest.raises(ValueError, match='long_neck: wanted one root, which alone moves'):
        MovingSkeleton.of_body(body, np.zeros((1, 2)), np.zeros(1))


@dataclass(frozen=True)
class Scene:
    """What a reader of glTF knows: its JSON and its one buffer."""

    content: dict
    data: bytes

    @staticmethod
    def read(stored: bytes) -> Scene:
        if not stored.startswith(b'glTF'):
            content = json.loads(stored)
            head, _, text = content['buffers'][0]['uri'].partition(',')
            assert head == 'data:application/octet-stream;base64'
            return Scene(content, base64.b64decode(text))
        _, version, size, length, kind = struct.unpack_from('<4sIII4s', stored)
        assert (version, size, kind, length % 4) == (2, len(stored), b'JSON', 0)
        count, kind = struct.unpack_from('<I4s', stored, 20 + length)
        assert (kind, count % 4, 28 + length + count) == (b'BIN\0', 0, size)
        return Scene(json.loads(stored[20 : 20 + length]), stored[28 + length :])

    def values(self, accessor):
        """The numbers (count, width) of an accessor, which tells their range."""
        described = self.content['accessors'][accessor]
        view = self.content['bufferViews'][described['bufferView']]
        assert view['byteOffset'] % 4 == 0
        kind = {5126: '<f4', 5121: 'u1', 5123: '<u2'}[described['componentType']]
        width = {'SCALAR': 1, 'VEC3': 3, 'VEC4': 4, 'MAT4': 16}[described['type']]
        count = described['count'] * width
        assert view['byteLength'] == count * np.dtype(kind).itemsize
        result = np.frombuffer(self.data, kind, count, view['byteOffset']).reshape(-1, width)
        if 'min' in described:
            np.testing.assert_array_equal(result.min(axis=0), described['min'])
            np.testing.assert_array_equal(result.max(axis=0), described['max'])
        return result.astype(np.float64)

    def places(self, time):
        """Places of the nodes by name, when the animation has played for a time, s."""
        nodes = [dict(node) for node in self.content['nodes']]
        (animation,) = self.content['animations']
        for channel in animation['channels']:
            sampler = animation['samplers'][channel['sampler']]
            times = self.values(sampler['input'])[:, 0]
            values = self.values(sampler['output'])
            target = channel['target']
            if target['path'] == 'rotation':
                now = Slerp(times, Rotation.from_quat(values))(time)
            else:
                now = [np.interp(time, times, column) for column in values.T]
            nodes[target['node']][target['path']] = now
        found = {}

        def go(node, turn, place):
            own = nodes[node]
            here = place + turn.apply(own.get('translation', [0.0, 0.0, 0.0]))
            found[own['name']] = here
            for child in own.get('children', []):
                go(child, turn * own.get('rotation', Rotation.identity()), here)

        for root in self.content['scenes'][self.content['scene']]['nodes']:
            go(root, Rotation.identity(), np.zeros(3))
        return found


@pytest.mark.parametrize('binary', [False, True], ids=['gltf', 'glb'])
def test_a_gltf_plays_back_to_the_joints(binary):
    poses = some_poses()
    times = 1.7e9 + np.sort(np.random.default_rng(1).uniform(0.0, 3.0, FRAMES))
    scene = Scene.read(gltf_bytes(MovingSkeleton.of_body(BODY, poses, times), binary=binary))
    assert scene.content['asset']['version'] == '2.0'
    wanted = joints_of(poses)
    for t, time in enumerate(scene.values(0)[:, 0]):
        assert time == pytest.approx(times[t] - times[0], abs=1e-6)
        found = scene.places(time)
        away = [found[name] - wanted[t, j] for j, name in enumerate(BODY.joint_names)]
        assert np.abs(away).max() < CLOSE
    # Between two times the shorter way is meant, also by readers that do not look for it.
    outputs = [sampler['output'] for sampler in scene.content['animations'][0]['samplers'][1:]]
    turns = np.array([scene.values(output) for output in outputs])
    assert np.sum(turns[:, 1:] * turns[:, :-1], axis=-1).min() >= 0.0


def test_a_gltf_has_bones_to_look_at():
    moving = MovingSkeleton.of_body(BODY, some_poses(), TIMES)
    scene = Scene.read(gltf_bytes(moving, binary=True))
    (mesh,), (skin,) = scene.content['meshes'], scene.content['skins']
    attributes = mesh['primitives'][0]['attributes']
    points = scene.values(attributes['POSITION'])
    carriers = scene.values(attributes['JOINTS_0']).astype(int)[:, 0]
    np.testing.assert_array_equal(scene.values(attributes['WEIGHTS_0']).sum(axis=1), 1.0)
    rest = np.zeros((len(moving.names), 3))
    for node, parent in enumerate(moving.parents[1:], 1):
        rest[node] = rest[parent] + moving.offsets[node]
    assert skin['joints'] == list(range(len(moving.names)))
    matrices = scene.values(skin['inverseBindMatrices']).reshape(-1, 4, 4).swapaxes(1, 2)
    placed = np.einsum('nij,nj->ni', matrices[:, :3, :3], rest) + matrices[:, :3, 3]
    assert np.abs(placed).max() < 1e-6
    # Each bone starts at the node that carries it, and ends at one that this node carries.
    starts, ends = points[::6], points[5::6]
    assert np.abs(starts - rest[carriers[::6]]).max() < 1e-6
    away = np.linalg.norm(ends[:, None] - rest, axis=-1)
    assert away.min(axis=1).max() < 1e-6
    # All triangles face outwards.
    corners = points[scene.values(mesh['primitives'][0]['indices']).astype(int).reshape(-1, 3)]
    bones = np.repeat(np.arange(len(starts)), 8)
    middles = 0.5 * (starts + ends)[bones]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum('fi,fi->f', normals, corners.mean(axis=1) - middles) > 0).all()


def test_the_same_motion_gives_the_same_bytes():
    moving = MovingSkeleton.of_body(BODY, some_poses(), TIMES)
    again = MovingSkeleton.of_body(BODY, some_poses(), TIMES)
    assert gltf_bytes(moving, binary=True) == gltf_bytes(again, binary=True)
    assert bvh_text(moving, RATE) == bvh_text(again, RATE)
