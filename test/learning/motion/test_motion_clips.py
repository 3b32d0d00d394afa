"""Every development motion, compared with a plain evaluation of its file and the index."""

import csv
import re

import numpy as np
import pytest

from hmt_learning.motion.motion_file import read_motion

FRAMES = 6  # number of frames of each clip for the plain evaluation


@pytest.fixture(scope='module')
def clips(mocap):
    """Row of the index and motion of every clip."""
    with (mocap / 'index.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40
    return {
        row['file']: (row, read_motion(mocap / row['file'], unit_to_m=float(row['unit_to_m'])))
        for row in rows
    }


def turn(letter, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rows = {
        'X': [[1, 0, 0], [0, c, -s], [0, s, c]],
        'Y': [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        'Z': [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    result = np.eye(4)
    result[:3, :3] = rows[letter]
    return result


def shift(v):
    result = np.eye(4)
    result[:3, 3] = v
    return result


def plain_bvh(path, frames):
    """Joint positions by name, file units, by nested 4 x 4 products along the hierarchy."""
    header, motion = path.read_text().split('MOTION')
    rows = motion.strip().splitlines()[2:]
    values = np.array([[float(x) for x in rows[f].split()] for f in frames])
    places: dict[str, list] = {}
    tokens = iter(header.split())
    column = 0

    def joint(name, above):
        nonlocal column
        assert next(tokens) == '{'
        assert next(tokens) == 'OFFSET'
        offset = [float(next(tokens)) for _ in range(3)]
        own = [t @ shift(offset) for t in above]
        while (word := next(tokens)) != '}':
            if word == 'CHANNELS':
                for _ in range(int(next(tokens))):
                    channel = next(tokens)
                    for i, row in enumerate(values):
                        if channel.endswith('position'):
                            step = np.zeros(3)
                            step['XYZ'.index(channel[0])] = row[column]
                            own[i] = own[i] @ shift(step)
                        else:
                            own[i] = own[i] @ turn(channel[0], row[column])
                    column += 1
            elif word == 'JOINT':
                joint(next(tokens), own)
            else:  # End Site
                assert next(tokens) == 'Site'
                joint(f'{name}_end', own)
        places[name] = [t[:3, 3] for t in own]

    assert next(tokens) == 'HIERARCHY'
    assert next(tokens) == 'ROOT'
    joint(next(tokens), [np.eye(4)] * len(frames))
    assert column == values.shape[1]
    return {name: np.array(place) for name, place in places.items()}


def plain_amc(path, frames):
    """Joint positions by name of the bone that starts at each, file units."""
    text = path.with_suffix('.asf').read_text()
    bones = {}
    for block in re.findall(r'begin\s+id(.*?)end', text, re.DOTALL):
        name = re.search(r'name (\S+)', block)[1]
        direction, axis = (
            np.array(re.search(rf'{key} (\S+) (\S+) (\S+)', block).groups(), dtype=float)
            for key in ('direction', 'axis')
        )
        length = float(re.search(r'length (\S+)', block)[1])
        dof = re.search(r'dof (.*)', block)
        bones[name] = (direction * length, axis, dof[1].split() if dof else [])
    children = {}
    for line in text.split(':hierarchy')[1].splitlines():
        words = line.split()
        if len(words) > 1:
            children[words[0]] = words[1:]
    blocks = re.split(r'\n\d+\s*\n', path.read_text())[1:]
    places: dict[str, list] = {}
    for f in frames:
        values = {w[0]: [float(x) for x in w[1:]] for w in map(str.split, blocks[f].splitlines())}
        x = values['root']
        root = shift(x[:3]) @ turn('Z', x[5]) @ turn('Y', x[4]) @ turn('X', x[3])

        def bone(name, above, values=values):
            span, axis, dof = bones[name]
            places.setdefault(name, []).append(above[:3, 3])
            c = turn('Z', axis[2]) @ turn('Y', axis[1]) @ turn('X', axis[0])
            angles = dict(zip(dof, values.get(name, [])))
            m = np.eye(4)
            for letter in 'XYZ':
                m = turn(letter, angles.get(f'r{letter.lower()}', 0.0)) @ m
            own = above @ c @ m @ np.linalg.inv(c) @ shift(span)
            for child in children.get(name, []):
                bone(child, own)
            if name not in children:
                places.setdefault(f'{name}_end', []).append(own[:3, 3])

        places.setdefault('root', []).append(root[:3, 3])
        for child in children['root']:
            bone(child, root)
    return {name: np.array(place) for name, place in places.items()}


def test_forward_kinematics_equal_a_plain_evaluation_of_the_file(clips, mocap):
    for name, (row, motion) in clips.items():
        assert len(motion) == int(row['frames'])
        frames = np.linspace(0, len(motion) - 1, FRAMES).astype(int)
        plain = (plain_bvh if name.endswith('.bvh') else plain_amc)(mocap / name, frames)
        joints = motion.body.joint_positions(motion.poses[frames])
        skeleton = motion.body.skeleton
        starts = len(skeleton.segment_names)
        assert len(plain) == joints.shape[1]
        for j, segment in enumerate(skeleton.joint_segments):
            own = skeleton.segment_names[segment] + ('' if j < starts else '_end')
            expected = plain[own] * motion.unit_to_m
            np.testing.assert_allclose(joints[:, j], expected, atol=1e-9, err_msg=f'{name} {own}')


def test_every_clip_has_the_standard_joints_and_limbs(clips):
    standard = {'pelvis', 'neck', 'head'} | {
        f'{s}_{j}'
        for s in ('left', 'right')
        for j in ('hip', 'knee', 'ankle', 'toe', 'shoulder', 'elbow', 'wrist', 'hand')
    }
    for name, (_, motion) in clips.items():
        assert standard <= set(motion.body.joint_names), name
        assert set(motion.body.chains) == {
            'neck', 'left_arm', 'right_arm', 'left_leg', 'right_leg',
        }  # fmt: skip
        place = dict(zip(sorted(standard), motion.joint_positions(sorted(standard)).mean(0)))
        assert place['head'][2] > place['neck'][2] > place['pelvis'][2] > place['left_knee'][2]
        # Facing: with z up, the left side is to the left of the toes' direction.
        for side in ('left', 'right'):
            ahead = place[f'{side}_toe'] - place[f'{side}_ankle']
            across = place[f'{side}_hip'] - place['pelvis']
            towards_left = ahead[0] * across[1] - ahead[1] * across[0]
            if name != 'train/cmu_60_12_salsa.bvh':  # turns about twice: no mean heading
                assert (towards_left > 0) == (side == 'left'), name
