"""Moves the avatar through the scenes, driven by a body model with the avatar's lengths.

    python move.py MPFB2 OUT.npz

OUT contains the vertices of all images in the world, z up, the true joints, the camera, and the
poses of the body model.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from avatar import Avatar
from scenes import DESK, SCENES, SEAT, SECONDS, STOOL, demonstration
from scipy.spatial.transform import Rotation

from hmt_learning.motion.procedural_motion import poses_of
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import load_body
from hmt_ros.body.kinematics import forward

FPS = 10.0
SOLE = 0.012  # thickness of a shoe's sole, m
WIDTH, HEIGHT = 480, 360
HALF_ANGLE = np.radians(24.0)  # half the horizontal field of view, rad
VIEWPOINT = Viewpoint(distance=3.7, height=1.3, pitch=np.radians(5.0))
SIDES = (('left', 'Left'), ('right', 'Right'))
# Bone of the avatar whose head is at each joint of the body model.
BONES = {
    'pelvis': 'LowerBack', 'head': 'Head',
    **{
        f'{side}_{joint}': big + bone
        for side, big in SIDES
        for joint, bone in (
            ('hip', 'UpLeg'), ('knee', 'Leg'), ('ankle', 'Foot'), ('toe', 'ToeBase'),
            ('shoulder', 'Arm'), ('elbow', 'ForeArm'), ('wrist', 'Hand'), ('hand', 'HandFinger1'),
        )
    },
}  # fmt: skip


def main(argv: list[str]) -> int:
    """Writes the motion of the avatar."""
    avatar = Avatar(Path(argv[0]))
    body = load_body('human37').with_segment_lengths(lengths_of(avatar))
    rng = np.random.default_rng(0)
    poses = poses_of(demonstration, body, SECONDS, FPS, rng, viewpoint=VIEWPOINT)
    turns = turns_of(avatar, body.skeleton.segment_names, body, poses)
    heads = heads_of(avatar, turns)
    hips = VIEWPOINT.to_world(body.joint_positions(poses))[
        :, body.skeleton.joint_index(('left_hip', 'right_hip'))
    ].mean(1)
    shift = hips - 0.5 * (heads['LeftUpLeg'] + heads['RightUpLeg'])
    heads = {name: place + shift for name, place in heads.items()}
    vertices = np.zeros((len(poses), *avatar.rest.shape))
    for column, name in enumerate(avatar.bones):
        own = avatar.weights[:, column]
        moved = np.flatnonzero(own)
        local = avatar.rest[moved] - avatar.heads[name]
        placed = np.einsum('tij,vj->tvi', turns[name], local) + heads[name][:, None]
        vertices[:, moved] += own[moved, None] * placed
    skin = np.unique(avatar.part('body'))
    up = [0.0, 0.0, SOLE - np.median(vertices[:, skin, 2].min(1))]
    joints = {joint: heads[bone] for joint, bone in BONES.items()}
    joints['neck'] = 0.5 * (heads['LeftShoulder'] + heads['RightShoulder'])
    np.savez_compressed(
        argv[1],
        vertices=(vertices + up).astype(np.float32),
        joint_names=np.array(body.joint_names),
        joints=np.stack([joints[name] for name in body.joint_names], axis=1) + up,
        poses=poses,
        lengths=np.array([body.segment_lengths[x] for x in body.skeleton.length_names]),
        motion='demonstration',
        fps=FPS,
        scenes=[*SCENES],
        until=[*SCENES.values()],
        desk=DESK,
        stool=[*STOOL, SEAT],
        size=[WIDTH, HEIGHT],
        half_angle=HALF_ANGLE,
        rotation=VIEWPOINT.rotation,
        place=[VIEWPOINT.distance, VIEWPOINT.height, VIEWPOINT.pitch],
    )
    return 0


def lengths_of(avatar: Avatar) -> dict[str, float]:
    """Segment lengths of the avatar, m."""
    heads = avatar.heads
    chain = ('LeftUpLeg', 'LeftLeg', 'LeftFoot', 'LeftToeBase')
    arm = ('LeftArm', 'LeftForeArm', 'LeftHand', 'LeftHandFinger1')
    names = ('thigh', 'shin', 'foot', 'upper_arm', 'forearm', 'hand')
    pairs = [*pairwise(chain), *pairwise(arm)]
    result = {
        name: float(np.linalg.norm(heads[a] - heads[b])) for name, (a, b) in zip(names, pairs)
    }
    height = {name: float(place[2]) for name, place in heads.items()}
    return result | {
        'hip_width': 2.0 * float(heads['LeftUpLeg'][0]),
        'shoulder_width': 2.0 * float(heads['LeftArm'][0]),
        'hip_drop': height['LowerBack'] - height['LeftUpLeg'],
        'trunk': height['LeftShoulder'] - height['LowerBack'],
        'shoulder_rise': height['LeftArm'] - height['LeftShoulder'],
        'neck_to_head': height['Head'] - height['LeftShoulder'],
    }


def turns_of(avatar, segments, body, poses) -> dict[str, np.ndarray]:
    """Rotations (T, 3, 3) of each bone from its rest, in the world frame, by name."""
    own = np.einsum('ji,tsjk->tsik', VIEWPOINT.rotation, forward(body.skeleton, poses).rotations())
    up, sideways, right = np.eye(3)[2], np.eye(3)[0], -np.eye(3)[0]
    heads, tails = avatar.heads, avatar.tails
    # Axis of each segment in its own frame, and two directions of the avatar at rest.
    pairs = {
        'pelvis': (up, up, right),
        'left_clavicle': (up, up, right),
        'right_clavicle': (up, up, right),
        'trunk': (-up, up, right),
        'head': (-up, up, right),
    }
    for side, big in SIDES:
        upper, lower = (tails[big + x] - heads[big + x] for x in ('Arm', 'ForeArm'))
        hinge = np.cross(upper, lower)
        pairs[f'{side}_upper_arm'] = (-up, upper, hinge)
        pairs[f'{side}_forearm'] = (-up, lower, hinge)
        pairs[f'{side}_hand'] = (-up, heads[big + 'HandFinger1'] - heads[big + 'Hand'], hinge)
        pairs[f'{side}_thigh'] = (-up, tails[big + 'UpLeg'] - heads[big + 'UpLeg'], right)
        pairs[f'{side}_shin'] = (-up, tails[big + 'Leg'] - heads[big + 'Leg'], right)
        foot = (heads[big + 'ToeBase'] - heads[big + 'Foot']) * [1.0, 1.0, 0.0]
        pairs[f'{side}_foot'] = (-up, foot, right)
    segment = {
        name: own[:, segments.index(name)] @ (_basis(local, sideways) @ _basis(first, second).T)
        for name, (local, first, second) in pairs.items()
    }

    def between(a: str, b: str, share: float) -> np.ndarray:
        step = Rotation.from_matrix(segment[a].transpose(0, 2, 1) @ segment[b]).as_rotvec()
        return segment[a] @ Rotation.from_rotvec(share * step).as_matrix()

    result = dict.fromkeys(('Hips', 'LHipJoint', 'RHipJoint'), segment['pelvis'])
    result |= {
        'LowerBack': between('pelvis', 'trunk', 0.5),
        'Spine': between('pelvis', 'trunk', 0.8),
        'Spine1': segment['trunk'],
        'Neck': between('trunk', 'head', 0.5),
        'Neck1': between('trunk', 'head', 0.8),
        'Head': segment['head'],
    }
    for side, big in SIDES:
        for bones, name in (
            (('Shoulder',), 'clavicle'), (('Arm',), 'upper_arm'), (('ForeArm',), 'forearm'),
            (('Hand', 'FingerBase', 'HandFinger1'), 'hand'), (('UpLeg',), 'thigh'),
            (('Leg',), 'shin'), (('Foot', 'ToeBase'), 'foot'),
        ):  # fmt: skip
            result |= {big + bone: segment[f'{side}_{name}'] for bone in bones}
        result[big[0] + 'Thumb'] = segment[f'{side}_hand']
    return result


def heads_of(avatar: Avatar, turns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Positions (T, 3) of the heads of the bones, relative to the first."""
    result: dict[str, np.ndarray] = {}
    for name in avatar.bones:
        if parent := avatar.parents[name]:
            step = avatar.heads[name] - avatar.heads[parent]
            result[name] = result[parent] + turns[parent] @ step
        else:
            result[name] = np.zeros((len(turns[name]), 3))
    return result


def _basis(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Orthonormal axes (3, 3) in columns, from two directions."""
    a = first / np.linalg.norm(first)
    b = second - a * (a @ second)
    b /= np.linalg.norm(b)
    return np.stack([a, b, np.cross(a, b)], axis=1)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
